"""The machine in space: nominal and calibrated, with its uncertainty, and the cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from legcal.calibration.result import Calibration
from legcal.data.measurements import row_names
from legcal.geometry.motions import components
from legcal.geometry.types import Array
from legcal.machine.drawing import MOTOR_COLOUR
from legcal.machine.leg import Leg
from legcal.machine.parameters import geometries, moved_legs
from legcal.pages.document import Plot, plain
from legcal.report.page.residual_plots import FONT
from legcal.scene.motions import FACTORS, PlacedModel, directions, placed_model
from legcal.scene.shapes import around, ellipsoids, enlargement, pyramid

MAX_POSES = 60  # largest number of poses of the slider
MAX_CAMERAS = 60
_ROOM = 0.8  # margin around the machine, relative to its size
_RING = 0.06  # size of the median ellipsoid, relative to the machine
_EYE = np.array([1.3, -1.5, 0.8])  # nearest position of the eye, relative to the machine
_FURTHER = 2.0  # largest factor of that position to include cameras
_SLOPE = 0.4  # slope of the field of view to the line of sight
_N_RING = 20  # points of a ring
_GREY, _BLUE, _AMBER, _GREEN = "#9aa1ab", "#1f5fa8", "#b26a00", "#1e7d46"
_NO_LINES = np.zeros((0, 2, 3))


def machine_scene(calibration: Calibration) -> Plot:
    """Return the machine with sliders for pose and exaggeration."""
    machine, measurements = calibration.dataset.machine, calibration.dataset.measurements
    n = measurements.n_poses
    chosen = np.unique(np.linspace(0, n - 1, min(MAX_POSES, n)).astype(int))
    T = [calibration.solution.T_Rb_Re[k] for k in chosen.tolist()]
    q, by_readings = measurements.q_of_poses[chosen], calibration.platform is not None

    def placed(legs: Sequence[Leg]) -> PlacedModel:
        return placed_model(machine, legs, q, T, by_readings=by_readings)

    calibrated = placed(calibration.solution.legs)
    # The rim of the motors is the same for all compared models.
    rim = around(calibrated.anchors) if len(calibrated.anchors) > 2 else []
    size = float(np.ptp(np.concatenate([calibrated.A[0], calibrated.B[0]]), axis=0).max())
    modes = _modes(calibration, calibrated, placed, rim, size)
    rings, ring_factor = _rings(calibration, size)
    images = row_names(measurements)
    turn_base = machine.T_base_Rb.rotation.as_matrix()
    turn_platform = machine.T_platform_Re.rotation.as_matrix().T
    extra = {
        "modes": modes,
        "factors": FACTORS,
        "steps": len(FACTORS) - 1,
        "step": modes[0]["step"],
        "poses": [plain(images[row]) for row in measurements.first_rows[chosen].tolist()],
        "turns": _rounded(turn_base @ components(T)[0] @ turn_platform, 6),
        "rings": rings,
        "outline": {"base": around(calibrated.A[0]), "platform": around(calibrated.B[0])},
        "traces": {
            "legs": [0, 1],
            "base": [2, 3],
            "platform": [4, 5],
            "rings": 6,
            "motors": [7, 8],
        },
    }
    cameras = _cameras(calibration, 0.25 * size)
    traces = [
        _lines("nominal", _GREY, 3),
        _lines("calibrated", _BLUE, 6),
        _lines("nominal base", _GREY, 2, legend=False),
        _lines("calibrated base", _BLUE, 3, legend=False),
        _lines("nominal platform", _GREY, 2, legend=False),
        _lines("calibrated platform", _BLUE, 3, legend=False),
        _lines(f"1 sigma, {ring_factor:g} times as large", _AMBER, 2),
        _lines("nominal motors", _GREY, 4, legend=False),
        _lines("calibrated motors", MOTOR_COLOUR, 8, legend=False),
        cameras,
        _words([plain(name) for name in machine.leg_names], calibrated.A[0], "#1d2126"),
    ]
    camera_points = np.array([[v for v in cameras[a] if v is not None] for a in "xyz"]).T
    solid = np.concatenate([*calibrated.A, *calibrated.B, *_standing(calibrated, rim)])
    left_out = f" {len(chosen)} of {n} poses are shown." if len(chosen) < n else ""
    caption = (
        "Drag to turn, scroll to zoom. Grey is the nominal model, blue the calibrated one at the "
        "same readings, or grey the calibrated one and blue where a direction would move it; the "
        "slider exaggerates the difference. Rings are ellipsoids of one "
        "standard deviation at the joints: those that define R_b and R_e have flat ones or none."
        f"{' Brown are arms and carriages, at the readings.' * bool(machine.actuators)}{left_out}"
    )
    return Plot("machine-scene", traces, _layout(solid, camera_points, size), 560, caption, extra)


def _modes(
    calibration: Calibration,
    calibrated: PlacedModel,
    placed: Callable[[Sequence[Leg]], PlacedModel],
    rim: Sequence[int],
    size: float,
) -> list[dict[str, Any]]:
    """Return the selectable differences: by the calibration, and along directions."""
    solution = calibration.solution
    nominal = placed(geometries(calibration.dataset.machine))
    legend = ("nominal", "calibrated")
    modes = [_mode("change by the calibration", legend, nominal, calibrated, rim, size)]
    length = float(np.mean(np.linalg.norm(calibrated.B[0] - calibrated.A[0], axis=1)))
    legend = ("calibrated", "moved along the direction")
    for direction, step in directions(
        calibration.result, solution.kinematic.parametrization, length
    ):
        moved = placed(moved_legs(solution.legs, solution.kinematic.parametrization.place, step))
        modes.append(_mode(direction, legend, calibrated, moved, rim, size))
    return modes


def _standing(placed: PlacedModel, rim: Sequence[int]) -> Array:
    """Return the rim of the motors, and rails and axes, as lines (m, 2, 3)."""
    edges = placed.anchors[np.stack([rim[:-1], rim[1:]], axis=1)] if rim else _NO_LINES
    return np.concatenate([edges, placed.standing])


def _layout(machine: Array, cameras: Array, size: float) -> dict[str, Any]:
    """Return the layout for the points of a machine, and for cameras as far as there is room."""
    hidden = {"showbackground": False, "gridcolor": "#e8ebef", "zeroline": False,
              "title": {"text": ""}, "tickfont": {"size": 10, "color": "#667080"}}  # fmt: skip
    view = _view(machine, cameras, size)
    return {
        "font": FONT,
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "showlegend": True,
        "legend": {"x": 0, "y": 1, "bgcolor": "rgba(255,255,255,0.7)"},
        "uirevision": "kept",
        "scene": {
            f"{a}axis": {**hidden, "title": {"text": f"{a} [m]"}, "range": between}
            for a, between in zip("xyz", view["range"], strict=True)
        }
        | view["look"],
    }


def _view(machine: Array, cameras: Array, size: float) -> dict[str, Any]:
    """Return ranges of the axes that include machine and cameras, and the viewpoint."""
    everything = np.concatenate([machine - _ROOM * size, machine + _ROOM * size, cameras])
    low, high = everything.min(axis=0), everything.max(axis=0)
    middle = 0.5 * (machine.min(axis=0) + machine.max(axis=0))
    centre = (middle - 0.5 * (low + high)) / size  # scenes measure from the middle of the ranges

    offsets = (cameras - middle) / size
    towards = offsets @ (_EYE / np.linalg.norm(_EYE))
    aside = np.sqrt(np.maximum(np.sum(offsets**2, axis=1) - towards**2, 0.0))
    needed = (towards + aside / _SLOPE).max(initial=0.0) / np.linalg.norm(_EYE)
    eye = centre + float(np.clip(needed, 1.0, _FURTHER)) * _EYE

    def place(xyz: Array) -> dict[str, float]:
        return dict(zip("xyz", np.round(xyz, 4).tolist(), strict=True))

    return {
        "range": _rounded(np.stack([low, high], axis=1), 4),
        "look": {
            "aspectmode": "manual",
            "aspectratio": place((high - low) / size),
            "camera": {"center": place(centre), "eye": place(eye)},
        },
    }


def _mode(
    name: str,
    legend: tuple[str, str],
    before: PlacedModel,
    after: PlacedModel,
    rim: Sequence[int],
    size: float,
) -> dict[str, Any]:
    """Return the data of a difference, with a visible initial exaggeration."""
    # Joints at A that no motor moves are included once.
    poses = slice(1 if all(np.ptp(A, axis=0).max() == 0.0 for A in (before.A, after.A)) else None)
    return {
        "name": name,
        "legend": legend,
        "step": before.first_step(after, size),
        "base": [
            [_rounded(a, 7), _rounded(b, 7)]
            for a, b in zip(before.A[poses], after.A[poses], strict=True)
        ],
        "platform": [
            [_rounded(a, 7), _rounded(b, 7)] for a, b in zip(before.B, after.B, strict=True)
        ],
        "standing": [
            _rounded(_standing(model, rim).reshape(-1, 3), 6) for model in (before, after)
        ],
        "motors": [
            [_rounded(model.reshape(-1, 3), 6) for model in pair]
            for pair in zip(before.moving[poses], after.moving[poses], strict=True)
        ],
    }


def _rounded(values: Array, digits: int) -> Any:
    return np.round(values, digits).tolist()


def _rings(calibration: Calibration, size: float) -> tuple[dict[str, Any], float]:
    """Return ellipsoids at joints as rings about their centres [m], and their enlargement."""
    turn = np.linspace(0.0, 2.0 * np.pi, _N_RING + 1)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    axes = ellipsoids(calibration.result)
    factor = enlargement(axes, _RING * size)
    rings_by_side: dict[str, Any] = {"base": [], "platform": []}
    for side, of_side in axes.items():
        for axes_of_joint in factor * of_side:
            rings = [circle @ axes_of_joint[:, pair].T for pair in ([0, 1], [1, 2], [0, 2])]
            rings_by_side[side].append([_rounded(ring, 5) for ring in rings])
    return rings_by_side, factor


def _lines(name: str, colour: str, width: float, *, legend: bool = True) -> dict[str, Any]:
    return {
        "type": "scatter3d", "mode": "lines", "name": name, "x": [], "y": [], "z": [],
        "line": {"color": colour, "width": width}, "hoverinfo": "skip", "showlegend": legend,
    }  # fmt: skip


def _words(words: Sequence[str], at: Array, colour: str) -> dict[str, Any]:
    x, y, z = np.round(at, 4).T.tolist()
    return {
        "type": "scatter3d", "mode": "text", "text": list(words), "x": x, "y": y, "z": z,
        "textposition": "bottom center", "textfont": {"size": 11, "color": colour},
        "hoverinfo": "skip", "showlegend": False,
    }  # fmt: skip


def _cameras(calibration: Calibration, depth: float) -> dict[str, Any]:
    """Return the cameras of used views as pyramids of their field of view."""
    solution, views = calibration.solution, calibration.dataset.measurements.views
    frame, used_views = calibration.dataset.machine.T_base_Rb, calibration.result.views
    x: list[Any] = []
    names: list[str] = []
    for v, view in enumerate(views):
        if view.name not in used_views or len(names) >= MAX_CAMERAS * 13:
            continue
        camera = solution.cameras[v]
        points = pyramid(camera, frame * solution.T_camera_Rb[v].inv(), depth)
        p = np.round(points, 4).tolist()
        gap = [None] * 3
        x += [p[1], p[2], p[3], p[4], p[1], gap]
        for k in range(1, 5):
            x += [p[0], p[k]]
        x += [gap]
        names += [plain(view.name)] * 15
    columns = list(map(list, zip(*x, strict=True))) or [[], [], []]
    return {
        "type": "scatter3d", "mode": "lines", "name": "cameras", "x": columns[0], "y": columns[1],
        "z": columns[2], "line": {"color": _GREEN, "width": 2}, "text": names,
        "hovertemplate": "camera %{text}<extra></extra>", "showlegend": bool(x),
    }  # fmt: skip
