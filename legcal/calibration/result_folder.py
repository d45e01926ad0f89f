"""The result folder: what a controller and a script read, written, and read back for other jobs.

It is written all of it or nothing: the calibrated model, ``result.json``, and the tables of what
was observed. A result that is read back must be complete and consistent: its covariance that of its
parameters, and these the ones of the model beside it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.documents import (
    BoardPose,
    Gamma,
    Holdout,
    HoldoutPlatform,
    Kinematic,
    NoSteps,
    ParameterRow,
    PlatformBlock,
    Pose,
    PoseAccuracy,
    ResidualsBlock,
    Result,
    SensitivityRow,
    Staged,
    Stages,
    ViewPose,
    WeakCombination,
    WorkspaceAccuracy,
    unreadable,
)
from legcal.calibration.joint_fit import (
    BOARD_SCALE,
    KINDS,
    KnownIntrinsics,
    PlatformError,
    known_parameters,
)
from legcal.calibration.verdict import Calibration
from legcal.data import CORNERS_NAME, OBSERVATIONS_NAME, write_corners, write_observations
from legcal.errors import DatasetError, DidNotConverge, ModelError, OutOfClass
from legcal.files import motion_to_xyz_quat, result_folder
from legcal.geometry import Array
from legcal.machine import (
    Leg,
    LegKind,
    Machine,
    calibrated_axis,
    describe_direction,
    geometries,
    home_of_legs,
    load_mechanism,
    nominal_axes,
    parametrization_of,
    reload_and_check,
    turns_between,
    vector_of,
    write_calibrated_yaml,
    write_urdf,
)
from legcal.vision import (
    Camera,
    camera_numbers,
    intrinsic_names,
    intrinsic_values,
    shared_cameras,
)

RESULT_NAME, MODEL_NAME = "result.json", "calibrated.yaml"
RELOAD_TOLERANCE = 1e-11  # between reloaded and written parameters [m, rad]
MAX_HOME_RESIDUAL = 0.2  # of a leg length: of calibrated legs at the nominal home
ROUNDING = 1e-9  # of numbers in files [m]
SYMMETRY_TOLERANCE = 1e-6  # relative, of covariances


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
    machine = dataset.machine
    stale = [Path(OBSERVATIONS_NAME), Path(CORNERS_NAME)]
    with result_folder(destination, stale=stale) as folder:
        urdf, yaml = folder / "calibrated.urdf", folder / MODEL_NAME
        write_urdf(machine, solution.legs, urdf)
        home = home_of_legs(machine, solution.legs, MAX_HOME_RESIDUAL)
        if home is None:
            raise DidNotConverge(
                f"{machine.yaml_path}: the calibrated model could not be written: found no "
                "closed pose of its legs near legcal.home, needed one; check legcal.home and the "
                "nominal model; nothing was written."
            )
        write_calibrated_yaml(machine, yaml, urdf.name, None if home is machine.home else home)
        _check_written(yaml, solution.legs)
        document = json.dumps(result_of(calibration).document(), indent=1, allow_nan=False)
        (folder / RESULT_NAME).write_text(document + "\n", encoding="utf-8")
        if dataset.axes is None:
            table, measurements = folder / OBSERVATIONS_NAME, dataset.measurements
            write_observations(table, solution.outlines, measurements, machine.leg_names)
        if calibration.corners is not None:
            write_corners(folder / CORNERS_NAME, calibration.corners, dataset.measurements)


def _check_written(yaml: Path, legs: Sequence[Leg]) -> None:
    """Load what was written; it must be the model that was computed, and close."""
    written = reload_and_check(yaml)
    found = parametrization_of(written, twists=True)
    apart = vector_of(found, geometries(written), legs) - vector_of(found, legs, legs)
    off = float(np.abs(apart).max())
    if not off <= RELOAD_TOLERANCE:
        raise DidNotConverge(
            f"The calibrated model could not be written: loaded again, its parameters differ by "
            f"{off:.1e} m or rad from the computed ones; at most {RELOAD_TOLERANCE:.0e} is "
            "allowed; nothing was written; please report this."
        )


def result_of(calibration: Calibration) -> Result:
    """Return the document of a calibration."""
    solution, dataset = calibration.solution, calibration.dataset
    machine, measurements = dataset.machine, dataset.measurements
    names, views, steps = machine.leg_names, measurements.views, calibration.steps
    owners = shared_cameras([view.name for view in views], [view.camera for view in views])
    o, axes = solution.outlines, dataset.axes
    shown = np.unique(measurements.view[o.row[o.used] if axes is None else axes.row]).tolist()
    T_base_Rb = machine.T_base_Rb
    return Result(
        legcal_result=1,
        status="converged",
        verdict=calibration.verdict.sentence,
        trustworthy=calibration.verdict.trustworthy,
        legs=list(names),
        **_legs(names, solution.legs),
        nominal_axes=nominal_axes(names, geometries(machine)),
        parameters=_parameters(calibration),
        covariance=solution.covariance.tolist(),
        kinematic=Kinematic(
            names=list(solution.parametrization.names),
            covariance=solution.value_covariance.tolist(),
            held=solution.held_basis.tolist(),
        ),
        weakest=[
            WeakCombination(
                direction=describe_direction([name for name, _ in weak.parts], names),
                parameters=[name for name, _ in weak.parts],
                components=[component for _, component in weak.parts],
                sigma_m=weak.sigma,
            )
            for weak in solution.weak
        ],
        held=list(solution.held),
        views={
            views[v].name: ViewPose(T_base_camera=_pose(T_base_Rb * solution.T_camera_Rb[v].inv()))
            for v in shown
        },
        cameras={v.name: camera_numbers(v.camera) for v in views if v.name in set(owners)},
        gammas=[
            Gamma(views=list(one.views), gamma=one.gamma, sigma=one.gamma * one.sigma)
            for one in solution.gammas
        ],
        stages=Stages(
            staged=NoSteps(failure=steps.failure)
            if steps.legs is None
            else Staged(**_legs(names, steps.legs), diagnostics=list(steps.diagnostics))
        ),
        residuals=ResidualsBlock.model_validate(solution),
        board=_board(calibration),
        start=solution.start,
        platform=_platform(calibration),
        holdout=_holdout(calibration),
        notes=list(calibration.notes),
    )


def _legs(names: Sequence[str], legs: Sequence[Leg]) -> dict[str, Any]:
    """Return the fields of :class:`Legs`."""
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


def _pose(T: RigidTransform) -> Pose:
    return Pose(**motion_to_xyz_quat(T))


def _parameters(calibration: Calibration) -> list[ParameterRow]:
    """Return all kinematic parameters, the radii that were observed, and estimated intrinsics."""
    solution, dataset = calibration.solution, calibration.dataset
    machine = dataset.machine
    found = parametrization_of(machine, twists=True)
    numbers = vector_of(found, solution.legs, geometries(machine)).tolist()
    values = {**solution.values, **dict(zip(found.names, numbers, strict=True))}
    sigma = dict(zip(solution.names, solution.sigma.tolist(), strict=True))
    with_board = dataset.board is not None
    known = known_parameters(machine, dataset.measurements.views, with_board=with_board).by_name
    return [
        ParameterRow(
            name=name,
            value=values[name],
            nominal=parameter.nominal,
            sigma=sigma.get(name),
            prior_sigma=solution.prior_sigma.get(name),
            unit=parameter.unit,
            status=solution.status.get(name, "fixed"),
        )
        for name, parameter in known.items()
        if name in values
    ]


def _board(calibration: Calibration) -> BoardPose | None:
    """Return where the board stands, which differs from what the dataset says by where R_b is."""
    solution, dataset = calibration.solution, calibration.dataset
    if solution.T_Rb_board is None:
        return None
    given = dataset.T_base_board
    return BoardPose(
        T_base_board=_pose(dataset.machine.T_base_Rb * solution.T_Rb_board),
        given=None if given is None else _pose(given),
        scale=solution.values.get(BOARD_SCALE, 1.0),
        rms_px=solution.rms_corners_px,
    )


def _platform(calibration: Calibration) -> PlatformBlock | None:
    """Return what all this means at the platform."""
    platform, measurements = calibration.platform, calibration.dataset.measurements
    if platform is None:
        return None
    labels = measurements.pose_labels or ("",) * measurements.n_poses
    images: list[list[str]] = [[] for _ in labels]
    for pose, image in zip(measurements.pose.tolist(), measurements.image, strict=True):
        if image:
            images[pose].append(image)
    change, sigma, workspace = platform.change, platform.sigma, platform.workspace
    return PlatformBlock(
        change_dX_m=change.mean_displacement,
        change_dE_rad=change.mean_rotation,
        **_predicted(sigma),
        per_pose=[
            PoseAccuracy(
                pose=label or None,
                images=images[k],
                change_dX_m=change.displacement[k],
                change_dE_rad=change.rotation[k],
                sigma_dX_m=sigma.displacement[k],
                sigma_dE_rad=sigma.rotation[k],
            )
            for k, label in enumerate(labels)
        ],
        workspace=None if workspace is None else WorkspaceAccuracy(**_predicted(workspace)),
        sensitivities=[
            SensitivityRow(what=effect.what, **_errors(effect.error)) for effect in platform.effects
        ],
    )


def _errors(error: PlatformError, prefix: str = "") -> dict[str, Any]:
    """Return means and maxima of an error of the platform, as the document names them."""
    return {
        f"{prefix}dX_m": error.mean_displacement,
        f"{prefix}dE_rad": error.mean_rotation,
        f"{prefix}dX_max_m": error.max_displacement,
        f"{prefix}dE_max_rad": error.max_rotation,
    }


def _predicted(error: PlatformError) -> dict[str, Any]:
    """Return the fields of :class:`WorkspaceAccuracy`."""
    return {"poses": len(error.displacement), **_errors(error, "sigma_")}


def _holdout(calibration: Calibration) -> Holdout | None:
    """Return what images that were kept aside say."""
    held_out = calibration.held_out
    if held_out is None:
        return None
    pair = held_out.at_platform
    return Holdout(
        images=held_out.n_images,
        poses=held_out.n_poses,
        outlines=held_out.outlines,
        wrong=held_out.wrong,
        rms_px=held_out.rms_px,
        expected_px=held_out.expected_px,
        views=held_out.rms_px_of_view,
        platform=None
        if pair is None
        else HoldoutPlatform(
            poses=len(held_out.displacement),
            dX_m=pair.displacement,
            expected_dX_m=pair.expected_displacement,
            dE_rad=pair.rotation,
            expected_dE_rad=pair.expected_rotation,
        ),
    )


@dataclass(frozen=True, eq=False)
class EarlierResult:
    """An earlier calibration, whose parts agree with each other."""

    folder: Path
    document: Result
    machine: Machine  # the calibrated model
    names: tuple[str, ...]  # kinematic parameters that were estimated, or weak
    covariance: Array  # theirs, zero along what was held; axes count from the calibrated ones
    held: Array  # (w, n) how they change along the directions that were held, by a metre
    fixed: tuple[str, ...]  # kinematic parameters that were fixed

    def intrinsics(self, given: Camera) -> KnownIntrinsics | None:
        """Return what was found of the intrinsics of a camera; None if none was estimated."""
        rows = [row for row in self.document.parameters if row.status == "estimated"]
        number, names = {row.name: i for i, row in enumerate(rows)}, intrinsic_names(given)
        for owner, numbers in self.document.cameras.items():
            found = {
                k: number[f"{owner}.{name}"]
                for k, name in enumerate(names)
                if numbers == camera_numbers(given) and f"{owner}.{name}" in number
            }
            if found:
                covariance, at = np.zeros((len(names), len(names))), list(found.values())
                known = np.array(self.document.covariance)[np.ix_(at, at)]
                covariance[np.ix_(list(found), list(found))] = known
                mean = intrinsic_values(given)
                mean[list(found)] = [rows[i].value for i in at]
                return KnownIntrinsics(mean, covariance)
        return None


def read_result(given: str | Path) -> EarlierResult:
    """Return the result in a folder that ``legcal calibrate`` wrote, or in its ``result.json``.

    Raises
    ------
    DatasetError
        If it is no such folder, damaged, or put together from several.
    """
    path = Path(given)
    path = path if path.name == RESULT_NAME and not os.path.isdir(path) else path / RESULT_NAME
    document = Result.read(path)
    try:
        machine = load_mechanism(path.parent / MODEL_NAME)
    except (ModelError, OutOfClass) as error:
        raise DatasetError(error.problems) from error
    if sorted(document.legs) != sorted(machine.leg_names):
        found = f"the legs {', '.join(document.legs)} in {RESULT_NAME}"
        needed = f"{', '.join(machine.leg_names)} as in {MODEL_NAME} beside it"
        raise unreadable(path, found, needed)
    machine = machine.with_leg_order(document.legs)
    legs, known = geometries(machine), parametrization_of(machine, twists=True)
    values = {row.name: row.value for row in document.parameters}
    nominal_legs = _with_nominal_axes(machine.leg_names, legs, document, values)
    estimated = [row for row in document.parameters if row.status == "estimated"]
    _check_covariance(path, estimated, np.array([row.sigma for row in estimated]), document)
    _check_same_model(path, document, values, machine, nominal_legs)
    covariance, held = _kinematic(path, estimated, document, known.names)
    others = [name for name in document.residuals.shared_px if name not in KINDS]
    if others:
        raise unreadable(path, f"the shared errors '{others[0]}'", ", ".join(KINDS))
    fixed = {row.name for row in document.parameters if row.status == "fixed"}
    kept = [i for i, name in enumerate(known.names) if name not in fixed]
    turns = turns_between(known, legs, nominal_legs)
    return EarlierResult(
        folder=path.parent,
        document=document,
        machine=machine,
        names=tuple(known.names[i] for i in kept),
        covariance=(turns @ covariance @ turns.T)[np.ix_(kept, kept)],
        held=(held @ turns.T)[:, kept],
        fixed=tuple(name for name in values if name in fixed and name in known.names),
    )


def _with_nominal_axes(
    names: Sequence[str],
    legs: Sequence[Leg],
    document: Result,
    values: Mapping[str, float],
) -> tuple[Leg, ...]:
    """Return legs with the axes and twists that the parameters of a document count from."""
    base, platform = (
        {name: np.array(axis) for name, axis in document.nominal_axes.get(side, {}).items()}
        for side in ("base", "platform")
    )
    return tuple(
        replace(
            leg,
            base_axis=base.get(name, leg.base_axis),
            platform_axis=platform.get(name, leg.platform_axis),
            twist=values.get(f"{name}.twist", leg.twist),
        )
        for name, leg in zip(names, legs, strict=True)
    )


def _check_covariance(
    path: Path, estimated: Sequence[ParameterRow], sigma: Array, document: Result
) -> None:
    """Refuse a covariance that cannot be that of the estimated parameters."""
    n, found = len(estimated), document.covariance
    needed = f"a covariance of the {n} estimated parameters that fits their sigmas"
    if n == 0 or len(found) != n or any(len(row) != n for row in found):
        shape = f"{len(found)} rows of {len(found[0]) if found else 0} numbers"
        raise unreadable(path, shape, needed)
    if all(row.sigma is not None for row in estimated):
        scaled = np.array(found) / np.outer(sigma, sigma)
        if (
            np.abs(scaled - scaled.T).max() < SYMMETRY_TOLERANCE
            and np.abs(np.diagonal(scaled) - 1.0).max() < SYMMETRY_TOLERANCE
            and np.linalg.eigvalsh(scaled)[0] > -SYMMETRY_TOLERANCE
        ):
            return
    raise unreadable(path, "another matrix", needed)


def _kinematic(
    path: Path, estimated: Sequence[ParameterRow], document: Result, known: Sequence[str]
) -> tuple[Array, Array]:
    """Return covariance (p, p) and held directions (w, p) of all kinematic parameters."""
    n, found = len(known), document.kinematic
    needed = f"a covariance and held directions of the {n} kinematic parameters"
    if sorted(found.names) != sorted(known) or len(found.covariance) != n:
        raise unreadable(path, f"those of {len(found.names)} others", needed)
    if any(len(row) != n for row in (*found.covariance, *found.held)):
        raise unreadable(path, "rows of other lengths", needed)
    order = [found.names.index(name) for name in known]
    covariance = np.array(found.covariance)[np.ix_(order, order)]
    held = np.array(found.held).reshape(-1, n)[:, order]
    both = [i for i, row in enumerate(estimated) if row.name in known]
    at = [known.index(estimated[i].name) for i in both]
    of_all = np.array(document.covariance)
    sigma = np.sqrt(np.diagonal(of_all))[both]
    apart = (covariance[np.ix_(at, at)] - of_all[np.ix_(both, both)]) / np.outer(sigma, sigma)
    is_same = np.abs(apart).max(initial=0.0) <= SYMMETRY_TOLERANCE
    if not is_same or np.abs(covariance - covariance.T).max() > ROUNDING:
        raise unreadable(path, "another matrix in 'kinematic'", needed)
    return covariance, held


def _check_same_model(
    path: Path,
    document: Result,
    values: Mapping[str, float],
    machine: Machine,
    nominal_legs: Sequence[Leg],
) -> None:
    """Refuse a document whose parameters are not those of the model beside it."""
    legs, known = geometries(machine), parametrization_of(machine, twists=True)
    numbers = dict(zip(known.names, vector_of(known, legs, nominal_legs).tolist(), strict=True))
    other = [
        name
        for name, number in numbers.items()
        if "_axis." not in name and not abs(values.get(name, number) - number) <= ROUNDING
    ]
    other += [name for name in numbers if name not in values and not name.endswith(".twist")]
    for side, axes in nominal_axes(machine.leg_names, legs).items():
        for leg, axis in axes.items():
            nominal = document.nominal_axes.get(side, {}).get(leg)
            found = None if nominal is None else calibrated_axis(nominal, leg, side, values)
            # An axis is a line: either direction is the same.
            if found is None or not np.linalg.norm(np.cross(found, axis)) < ROUNDING:
                other.append(f"the {side} axis of {leg}")
    if other:
        found_words = f"other values of {', '.join(other[:3])}" + " and more" * (len(other) > 3)
        raise unreadable(path, found_words, f"those of {MODEL_NAME} beside it")
