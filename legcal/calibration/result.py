"""The result folder: what a controller and a script read (formats, section 4)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.joint_fit import (
    BOARD_SCALE,
    HeldOut,
    PlatformAccuracy,
    PlatformError,
    known_parameters,
)
from legcal.calibration.verdict import Calibration
from legcal.data import (
    CORNERS_NAME,
    OBSERVATIONS_NAME,
    Measurements,
    write_corners,
    write_observations,
)
from legcal.errors import DidNotConverge
from legcal.files import motion_to_xyz_quat, result_folder
from legcal.machine import (
    LegGeometry,
    LegKind,
    describe_direction,
    geometries,
    home_with,
    nominal_axes,
    parametrization_of,
    reload_and_check,
    vector_of,
    write_calibrated_yaml,
    write_urdf,
)
from legcal.vision import camera_numbers, shared_cameras


def board_document(calibration: Calibration) -> dict[str, Any]:
    """Return where the board stands and how well its corners fit; nothing where there is none.

    R_b is laid on the nominal one, so that ``T_base_board`` differs from what the dataset says of
    it by where R_b really stands.
    """
    solution, found = calibration.solution, _place(calibration)
    if found is None:
        return {}
    given = calibration.dataset.T_base_board
    return {
        "board": {
            "T_base_board": motion_to_xyz_quat(found),
            "given": None if given is None else motion_to_xyz_quat(given),
            "scale": solution.values.get(BOARD_SCALE, 1.0),
            "rms_px": solution.rms_corners_px,
        }
    }


def board_lines(calibration: Calibration) -> list[str]:
    """Return the same in a sentence."""
    solution, found, corners = calibration.solution, _place(calibration), calibration.corners
    if found is None or corners is None:
        return []
    images = len(np.unique(corners.row[corners.used]))
    line = (
        f"Calibration board: {int(corners.used.sum())} of {len(corners)} corners used, in {images} "
        f"images, {solution.rms_corners_px or 0.0:.3f} px rms."
    )
    given = calibration.dataset.T_base_board
    if given is not None:
        apart = given.inv() * found
        line += (
            f" It stands {1e3 * np.linalg.norm(apart.translation):.2f} mm and "
            f"{np.degrees(apart.rotation.magnitude()):.3f} deg from where the dataset has it, if "
            "the joints of the base stand where the nominal model has them."
        )
    return [line]


def _place(calibration: Calibration) -> RigidTransform | None:
    """Return T_base_board, with R_b laid on the nominal one."""
    T_Rb_board = calibration.solution.T_Rb_board
    return None if T_Rb_board is None else calibration.dataset.mechanism.T_base_Rb * T_Rb_board


def held_out_document(held_out: HeldOut) -> dict[str, Any]:
    """Return the block ``holdout`` of ``result.json``."""
    pair = held_out.at_platform
    return {
        "images": held_out.n_images,
        "poses": held_out.n_poses,
        "outlines": held_out.outlines,
        "wrong": held_out.wrong,
        "rms_px": held_out.rms_px,
        "expected_px": held_out.expected_px,
        "views": held_out.rms_px_of_view,
        "platform": None
        if pair is None
        else {
            "poses": len(held_out.displacement),
            "dX_m": pair.displacement,
            "expected_dX_m": pair.expected_displacement,
            "dE_rad": pair.rotation,
            "expected_dE_rad": pair.expected_rotation,
        },
    }


def held_out_lines(held_out: HeldOut) -> list[str]:
    """Return the sentences of the summary."""
    of = f"{held_out.n_images} image{'s' * (held_out.n_images != 1)} kept aside"
    if held_out.rms_px is None or held_out.expected_px is None:
        return [f"Held out: {of} show no outline that could be compared."]
    views = ", ".join(f"{name} {rms:.3f}" for name, rms in held_out.rms_px_of_view.items())
    lines = [
        f"Held out: {of}: {held_out.outlines - held_out.wrong} of {held_out.outlines} outlines are "
        f"{held_out.rms_px:.3f} px (rms) from where the fit of the others foretells them, "
        f"{held_out.expected_px:.3f} px were expected ({views})."
    ]
    pair = held_out.at_platform
    if pair is None:
        return [*lines, "They show too few legs at once to tell the platform's pose alone."]
    return [
        *lines,
        f"At the platform, its pose by what {len(held_out.displacement)} of {held_out.n_poses} "
        f"poses show alone is {1e3 * pair.displacement:.3f} mm / {np.degrees(pair.rotation):.4f} "
        f"deg (rms) from that by the readings; {1e3 * pair.expected_displacement:.3f} mm / "
        f"{np.degrees(pair.expected_rotation):.4f} deg were expected.",
    ]


@dataclass(frozen=True)
class ParameterRow:
    """One parameter.

    Attributes
    ----------
    name : str
        Its name.
    value, nominal : float
        As calibrated, and in the model or camera file [unit]; axes are turns of the nominal ones.
    sigma : float or None
        Standard deviation [unit]; None where it was not estimated.
    unit : {"m", "rad", "px", ""}
        Nothing for coefficients of distortion.
    status : {"estimated", "fixed", "weak"}
        A weak one takes part in a direction that nothing determines.
    """

    name: str
    value: float
    nominal: float
    sigma: float | None
    unit: str
    status: str


def parameter_rows(calibration: Calibration) -> list[ParameterRow]:
    """Return all kinematic parameters, the radii that were observed, and intrinsics looked for."""
    solution, dataset = calibration.solution, calibration.dataset
    mechanism = dataset.mechanism
    found = parametrization_of(mechanism, twists=True)
    values = dict(solution.values)
    numbers = vector_of(found, solution.legs, geometries(mechanism))
    values |= zip(found.names, numbers.tolist(), strict=True)
    sigma_of = dict(zip(solution.names, solution.sigma.tolist(), strict=True))
    with_board = dataset.board is not None
    known = known_parameters(mechanism, dataset.measurements.views, with_board=with_board).by_name
    return [
        ParameterRow(
            name,
            values[name],
            parameter.nominal,
            sigma_of.get(name),
            parameter.unit,
            solution.status.get(name, "fixed"),
        )
        for name, parameter in known.items()
        if name in values
    ]


def platform_document(calibration: Calibration) -> dict[str, Any] | None:
    """Return the block ``platform``; None where the motors do not determine the pose."""
    platform = calibration.platform
    if platform is None:
        return None
    change, sigma = platform.change, platform.sigma
    return {
        "poses": len(sigma.displacement),
        "change_dX_m": change.mean_displacement,
        "change_dE_rad": change.mean_rotation,
        **_sigma(sigma),
        "per_pose": _per_pose(platform, calibration.dataset.measurements),
        "workspace": None
        if platform.workspace is None
        else {"poses": len(platform.workspace.displacement), **_sigma(platform.workspace)},
        "sensitivities": [
            {
                "what": found.what,
                "dX_m": found.error.mean_displacement,
                "dE_rad": found.error.mean_rotation,
                "dX_max_m": found.error.max_displacement,
                "dE_max_rad": found.error.max_rotation,
            }
            for found in platform.effects
        ],
    }


def _sigma(error: PlatformError) -> dict[str, float]:
    """Return mean and maximum of a predicted error."""
    return {
        "sigma_dX_m": error.mean_displacement,
        "sigma_dE_rad": error.mean_rotation,
        "sigma_dX_max_m": error.max_displacement,
        "sigma_dE_max_rad": error.max_rotation,
    }


def _per_pose(platform: PlatformAccuracy, measurements: Measurements) -> list[dict[str, Any]]:
    """Return change and predicted error of every pose, with the images that show it."""
    labels = measurements.pose_labels or ("",) * measurements.n_poses
    images: list[list[str]] = [[] for _ in labels]
    for pose, image in zip(measurements.pose.tolist(), measurements.image, strict=True):
        if image:
            images[pose].append(image)
    errors = (
        platform.change.displacement,
        platform.change.rotation,
        platform.sigma.displacement,
        platform.sigma.rotation,
    )
    keys = ("change_dX_m", "change_dE_rad", "sigma_dX_m", "sigma_dE_rad")
    columns = zip(*(values.tolist() for values in errors), strict=True)
    return [
        {"pose": label or None, "images": shown, **dict(zip(keys, values, strict=True))}
        for label, shown, values in zip(labels, images, columns, strict=True)
    ]


_RELOADED = 1e-11  # how far reloaded parameters may be from the written ones [m, rad]
_FURTHEST = 0.2  # of a leg length, by which the nominal home may miss what calibrated legs demand


def result_document(calibration: Calibration) -> dict[str, Any]:
    """Return the document of ``result.json``."""
    solution, mechanism = calibration.solution, calibration.dataset.mechanism
    return {
        "legcal_result": 1,
        "status": "converged",
        "verdict": calibration.verdict.sentence,
        "trustworthy": calibration.verdict.trustworthy,
        "legs": list(mechanism.leg_names),
        **_geometry(mechanism.leg_names, solution.legs),
        "nominal_axes": nominal_axes(mechanism.leg_names, geometries(mechanism)),
        "parameters": [asdict(row) for row in parameter_rows(calibration)],
        "covariance": solution.covariance.tolist(),
        "kinematic": {
            "names": list(solution.parametrization.names),
            "covariance": solution.value_covariance.tolist(),
            "held": solution.held_basis.tolist(),
        },
        "weakest": _weakest(calibration),
        "held": list(solution.held),
        "views": _views(calibration),
        "cameras": _cameras(calibration),
        "gammas": [
            {"views": list(one.views), "gamma": one.gamma, "sigma": one.gamma * one.sigma}
            for one in solution.gammas
        ],
        "stages": {"staged": _steps(calibration)},
        "residuals": {
            "chi2": solution.chi2,
            "dof": solution.dof,
            "rms_px": solution.rms_px,
            "rms_axes": solution.rms_axes,
            "noise": asdict(solution.noise),
            "shared_px": dict(solution.shared_px),
        },
        **board_document(calibration),
        "start": solution.start,
        "platform": platform_document(calibration),
        **_held_out(calibration),
        "notes": list(calibration.notes),
    }


def write_result(calibration: Calibration, destination: Path) -> None:
    """Write the result folder, all of it or nothing.

    The calibrated model is loaded again from the files and must have the parameters that were
    written and close at home, before the folder appears.

    Raises
    ------
    UsageError
        If the destination holds something else than an earlier result.
    DidNotConverge
        If the written model does not load as what was computed.
    """
    dataset, solution = calibration.dataset, calibration.solution
    stale = [Path(OBSERVATIONS_NAME), Path(CORNERS_NAME)]
    with result_folder(destination, stale=stale) as folder:
        urdf, yaml = folder / "calibrated.urdf", folder / "calibrated.yaml"
        write_urdf(dataset.mechanism, solution.legs, urdf)
        write_calibrated_yaml(dataset.mechanism, yaml, urdf.name, _home(calibration))
        _check_written(yaml, solution.legs)
        document = json.dumps(result_document(calibration), indent=1, allow_nan=False)
        (folder / "result.json").write_text(document + "\n", encoding="utf-8")
        if dataset.axes is None:
            write_observations(
                folder / OBSERVATIONS_NAME,
                solution.outlines,
                dataset.measurements,
                dataset.mechanism.leg_names,
            )
        if calibration.corners is not None:
            corners = folder / CORNERS_NAME
            write_corners(corners, calibration.corners, dataset.measurements)


def _held_out(calibration: Calibration) -> dict[str, Any]:
    """Return what images that were kept aside say, nothing where there are none."""
    held_out = calibration.held_out
    return {} if held_out is None else {"holdout": held_out_document(held_out)}


def _home(calibration: Calibration) -> RigidTransform | None:
    """Return where the calibrated legs close near home, None if at home itself."""
    mechanism = calibration.dataset.mechanism
    home = home_with(mechanism, calibration.solution.legs, _FURTHEST)
    if home is None:
        raise DidNotConverge(
            f"{mechanism.yaml_path}: the calibrated model could not be written: found no closed "
            "pose of its legs near legcal.home, needed one; check legcal.home and the nominal "
            "model; nothing was written."
        )
    return None if home is mechanism.home else home


def _check_written(yaml: Path, legs: Sequence[LegGeometry]) -> None:
    """Load what was written; it must be the model that was computed, and close."""
    written = reload_and_check(yaml)
    found = parametrization_of(written, twists=True)
    apart = vector_of(found, geometries(written), legs) - vector_of(found, legs, legs)
    off = float(np.abs(apart).max())
    if not off <= _RELOADED:
        raise DidNotConverge(
            f"The calibrated model could not be written: loaded again, its parameters differ by "
            f"{off:.1e} m or rad from the computed ones; at most {_RELOADED:.0e} is allowed; "
            "nothing was written; please report this."
        )


def _geometry(names: Sequence[str], legs: Sequence[LegGeometry]) -> dict[str, Any]:
    """Return what the legs are in R_b and R_e."""
    named = list(zip(names, legs, strict=True))
    return {
        "base_joints": [leg.A.tolist() for leg in legs],
        "platform_joints": [leg.B.tolist() for leg in legs],
        "offsets": [None if leg.kind is LegKind.PASSIVE else leg.q0 for leg in legs],
        "base_axes": {n: leg.base_axis.tolist() for n, leg in named if leg.base_axis is not None},
        "platform_axes": {
            n: leg.platform_axis.tolist() for n, leg in named if leg.platform_axis is not None
        },
        "twists": {name: leg.twist for name, leg in named if leg.twist is not None},
    }


def _weakest(calibration: Calibration) -> list[dict[str, Any]]:
    """Return the combinations of parameters that are known worst."""
    leg_names = calibration.dataset.mechanism.leg_names
    return [
        {
            "direction": describe_direction([name for name, _ in weak.parts], leg_names),
            "parameters": [name for name, _ in weak.parts],
            "components": [component for _, component in weak.parts],
            "sigma_m": weak.sigma,
        }
        for weak in calibration.solution.weak
    ]


def _views(calibration: Calibration) -> dict[str, Any]:
    """Return where the cameras stand whose images show a leg."""
    solution, dataset = calibration.solution, calibration.dataset
    measurements = dataset.measurements
    outlines, axes = solution.outlines, dataset.axes
    shown = outlines.row[outlines.used] if axes is None else axes.row
    T_base_Rb = dataset.mechanism.T_base_Rb
    return {
        measurements.views[v].name: {
            "T_base_camera": motion_to_xyz_quat(T_base_Rb * solution.T_camera_Rb[v].inv())
        }
        for v in np.unique(measurements.view[shown]).tolist()
    }


def _cameras(calibration: Calibration) -> dict[str, Any]:
    """Return the numbers that cameras came with, by the view whose name their intrinsics have."""
    views = calibration.dataset.measurements.views
    owners = set(shared_cameras([view.name for view in views], [view.camera for view in views]))
    return {view.name: camera_numbers(view.camera) for view in views if view.name in owners}


def _steps(calibration: Calibration) -> dict[str, Any]:
    """Return what the four steps gave, or why they gave nothing."""
    steps = calibration.steps
    if steps.legs is None:
        return {"failure": steps.failure}
    names = calibration.dataset.mechanism.leg_names
    return {**_geometry(names, steps.legs), "diagnostics": list(steps.diagnostics)}
