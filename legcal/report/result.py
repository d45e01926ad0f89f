"""The result folder: what a controller and a script read (formats, section 4)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration import Calibration
from legcal.dataset.folder import OBSERVATIONS_NAME
from legcal.dataset.given_corners import CORNERS_NAME
from legcal.errors import DidNotConverge
from legcal.geometry.frames import motion_to_xyz_quat
from legcal.mechanism.home import home_with
from legcal.mechanism.leg import LegKind
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.parameter_words import describe_direction
from legcal.mechanism.parametrization import geometries, parametrization_of, vector_of
from legcal.observations.corners_file import write_corners
from legcal.observations.table import write_observations
from legcal.report.axis_turns import nominal_axes
from legcal.report.board_report import board_document
from legcal.report.files import result_folder
from legcal.report.held_out_report import held_out_document
from legcal.report.parameter_rows import parameter_rows
from legcal.report.platform_document import platform_document
from legcal.report.urdf import reload_and_check, write_calibrated_yaml, write_urdf
from legcal.vision.intrinsics import camera_numbers, shared_cameras

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
