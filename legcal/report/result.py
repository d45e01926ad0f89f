"""The result folder: what a controller and a script read (formats, section 4)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from legcal.calibration import Calibration
from legcal.dataset.folder import OBSERVATIONS_NAME
from legcal.errors import DidNotConverge
from legcal.geometry.frames import motion_to_xyz_quat
from legcal.mechanism.parameters import KinematicParameters, parameter_names, radius_name, to_vector
from legcal.observations.table import write_observations
from legcal.report.files import result_folder
from legcal.report.urdf import reload_and_check, write_calibrated_urdf, write_calibrated_yaml

_RELOADED = 1e-11  # how far reloaded parameters may be from the written ones [m]


def result_document(calibration: Calibration) -> dict[str, Any]:
    """Return the document of ``result.json``."""
    solution, mechanism = calibration.solution, calibration.dataset.mechanism
    measurements, axes = calibration.dataset.measurements, calibration.dataset.axes
    used = solution.outlines.row[solution.outlines.used] if axes is None else axes.row
    placed = np.unique(measurements.view[used]).tolist()
    return {
        "legcal_result": 1,
        "status": "converged",
        "verdict": calibration.verdict.sentence,
        "trustworthy": calibration.verdict.trustworthy,
        "legs": list(mechanism.leg_names),
        **_joints(solution.parameters),
        "base_axes": {},
        "platform_axes": {},
        "parameters": _parameter_rows(calibration),
        "covariance": solution.covariance.tolist(),
        "views": {
            measurements.views[v].name: {
                "T_base_camera": motion_to_xyz_quat(
                    mechanism.T_base_Rb * solution.T_camera_Rb[v].inv()
                )
            }
            for v in placed
        },
        "stages": {"staged": _steps(calibration)},
        "residuals": {
            "chi2": solution.chi2,
            "dof": solution.dof,
            "rms_px": solution.rms_px,
            "rms_axes": solution.rms_axes,
        },
        "start": solution.start,
        "platform": {
            "poses": len(calibration.change.displacement),
            "change_dX_m": calibration.change.mean_displacement,
            "change_dE_rad": calibration.change.mean_rotation,
            "sigma_dX_m": calibration.sigma.mean_displacement,
            "sigma_dE_rad": calibration.sigma.mean_rotation,
        },
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
    dataset = calibration.dataset
    with result_folder(destination, stale=[Path(OBSERVATIONS_NAME)]) as folder:
        urdf, yaml = folder / "calibrated.urdf", folder / "calibrated.yaml"
        write_calibrated_urdf(dataset.mechanism, calibration.solution.parameters, urdf)
        write_calibrated_yaml(dataset.mechanism, yaml, urdf.name)
        _check_written(yaml, calibration)
        document = json.dumps(result_document(calibration), indent=1, allow_nan=False)
        (folder / "result.json").write_text(document + "\n", encoding="utf-8")
        if dataset.axes is None:
            write_observations(
                folder / OBSERVATIONS_NAME,
                calibration.solution.outlines,
                dataset.measurements,
                dataset.mechanism.leg_names,
            )


def _check_written(yaml: Path, calibration: Calibration) -> None:
    """Load what was written; it must be the model that was computed, and close."""
    written = reload_and_check(yaml)
    expected = to_vector(calibration.solution.parameters, written.frame_legs)
    found = to_vector(written.parameters, written.frame_legs)
    known = ~(np.isnan(found) & np.isnan(expected))  # passive legs have no offset
    off = float(np.abs(found - expected)[known].max())
    if not off <= _RELOADED:
        raise DidNotConverge(
            f"The calibrated model could not be written: loaded again, its parameters differ by "
            f"{off:.1e} m from the computed ones; at most {_RELOADED:.0e} m is allowed; nothing "
            "was written; please report this."
        )


def _joints(parameters: KinematicParameters) -> dict[str, Any]:
    return {
        "base_joints": parameters.base_joints.tolist(),
        "platform_joints": parameters.platform_joints.tolist(),
        "offsets": [None if np.isnan(q0) else q0 for q0 in parameters.offsets.tolist()],
    }


def _steps(calibration: Calibration) -> dict[str, Any]:
    steps = calibration.steps
    if steps.parameters is None:
        return {"failure": steps.failure}
    return {**_joints(steps.parameters), "diagnostics": list(steps.diagnostics)}


def _parameter_rows(calibration: Calibration) -> list[dict[str, Any]]:
    mechanism, solution = calibration.dataset.mechanism, calibration.solution
    nominal_radii = {
        (j, part): radius
        for j, leg in enumerate(mechanism.legs)
        for part, radius in leg.radius_of_part.items()
    }
    names = (
        *parameter_names(mechanism.leg_names, mechanism.frame_legs),
        *(radius_name(mechanism.leg_names[leg], part) for leg, part in solution.radii),
    )
    values = to_vector(solution.parameters, mechanism.frame_legs).tolist()
    nominal = to_vector(mechanism.parameters, mechanism.frame_legs).tolist()
    values += solution.radii.values()
    nominal += (nominal_radii[key] for key in solution.radii)
    sigma_of = dict(zip(solution.names, solution.sigma.tolist(), strict=True))
    return [
        {
            "name": name,
            "value": value,
            "nominal": start,
            "sigma": sigma_of.get(name),
            "unit": "m",
            "status": "estimated" if name in sigma_of else "fixed",
        }
        for name, value, start in zip(names, values, nominal, strict=True)
        if not np.isnan(value)  # the offset of a passive leg
    ]
