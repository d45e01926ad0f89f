"""Scenes of the page of a calibration: the machine, and the platform error over the workspace."""

from __future__ import annotations

from typing import Any

import numpy as np

from legcal.calibration.result import Calibration
from legcal.calibration.workspace_errors import PlatformMap
from legcal.data.measurements import row_names
from legcal.errors import printable
from legcal.geometry.motions import components
from legcal.geometry.types import Array
from legcal.machine.parameters import geometries
from legcal.pages.document import Scene
from legcal.scene.motions import FACTORS, MachineScene, PlacedModel
from legcal.scene.shapes import enlargement, pyramid

MAX_POSES = 60  # largest number of poses of the slider
MAX_CAMERAS = 60
_RING = 0.06  # size of the median ellipsoid, relative to the machine
_DEPTH = 0.25  # depth of the pyramid of a camera, relative to the machine
_FLAT = 1e-3  # height of a planar workspace, relative to its extent


def machine_scene(calibration: Calibration) -> Scene:
    """Return the machine with sliders for pose and exaggeration."""
    machine, measurements = calibration.dataset.machine, calibration.dataset.measurements
    solution, result = calibration.solution, calibration.result
    n = measurements.n_poses
    chosen = np.unique(np.linspace(0, n - 1, min(MAX_POSES, n)).astype(int))
    T = [solution.T_Rb_Re[k] for k in chosen.tolist()]
    q, by_readings = measurements.q_of_poses[chosen], calibration.platform is not None
    nominal, parameters = geometries(machine), solution.kinematic.parametrization
    scene = MachineScene(machine, solution.legs, nominal, result, parameters)

    def placed(legs: Any) -> PlacedModel:
        return scene.placed(legs, q, T, by_readings=by_readings)

    calibrated = placed(solution.legs)
    pairs = [("change by the calibration", ("nominal", "calibrated"),
              placed(nominal), calibrated)]  # fmt: skip
    pairs += [
        (words, ("calibrated", "moved along the direction"), calibrated, placed(scene.moved(k)))
        for k, (words, _) in enumerate(scene.directions)
    ]
    images = row_names(measurements)
    turn_base = machine.T_base_Rb.rotation.as_matrix()
    turn_platform = machine.T_platform_Re.rotation.as_matrix().T
    factor = enlargement(scene.ellipsoids, _RING * scene.size)
    content = {
        "unit": "m",
        "flat": not machine.spatial,
        "factors": FACTORS,
        "poses": [printable(images[row]) for row in measurements.first_rows[chosen].tolist()],
        "modes": [
            {
                "name": printable(name),
                "legend": legend,
                "step": scene.first_step(before, after),
                "models": [_model(before), _model(after)],
            }
            for name, legend, before, after in pairs
        ],
        "names": [printable(name) for name in machine.leg_names],
        "rims": scene.rims,
        "rings": {
            "name": f"1 sigma, {factor:g} times as large",
            "turns": _rounded(turn_base @ components(T)[0] @ turn_platform, 6),
            **{side: _rounded(factor * axes, 6) for side, axes in scene.ellipsoids.items()},
        },
        "cameras": _cameras(calibration, _DEPTH * scene.size),
    }
    left_out = f" {len(chosen)} of {n} poses are shown." if len(chosen) < n else ""
    caption = (
        "Drag to turn, scroll to zoom. Grey is the nominal model, blue the calibrated one at the "
        "same readings, or grey the calibrated one and blue where a direction would move it; the "
        "slider exaggerates the difference. Rings are ellipsoids of one "
        "standard deviation at the joints: those that define R_b and R_e have flat ones or none."
        f"{' Brown are arms and carriages, at the readings.' * bool(machine.actuators)}{left_out}"
    )
    return Scene("machine-scene", content, 560, caption)


def platform_scene(workspace: PlatformMap) -> Scene:
    """Return the platform error at all positions in space, after and before."""
    position = workspace.position
    content = {
        "unit": "mm",
        "flat": bool(np.ptp(position[:, 2]) < _FLAT * np.ptp(position, axis=0).max()),
        "marks": _rounded(1e3 * position, 1),
        "modes": [
            {"name": name, "values": _rounded(1e3 * error.displacement, 5)}
            for name, error in (("after, 1 sigma", workspace.sigma), ("before", workspace.change))
        ],
    }
    caption = "The same in space: larger and darker marks are larger errors."
    return Scene("platform-space", content, 420, caption)


def _model(model: PlacedModel) -> dict[str, Any]:
    """Return the geometry of a model; joints at A that no motor moves are included once."""
    is_fixed = np.ptp(model.A, axis=0).max() == 0.0
    once = model._replace(A=model.A[:1], moving=model.moving[:1]) if is_fixed else model
    return {name: _rounded(values, 7) for name, values in once._asdict().items()}


def _cameras(calibration: Calibration, depth: float) -> list[dict[str, Any]]:
    """Return the cameras of used views as pyramids of their field of view."""
    solution, views = calibration.solution, calibration.dataset.measurements.views
    frame, used_views = calibration.dataset.machine.T_base_Rb, calibration.result.views
    used = [v for v, view in enumerate(views) if view.name in used_views][:MAX_CAMERAS]
    return [
        {
            "name": printable(views[v].name),
            "points": _rounded(
                pyramid(solution.cameras[v], frame * solution.T_camera_Rb[v].inv(), depth), 4
            ),
        }
        for v in used
    ]


def _rounded(values: Array, digits: int) -> Any:
    return np.round(values, digits).tolist()
