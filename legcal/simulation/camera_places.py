"""Where cameras stand around a machine of any class, so that they see its legs well.

Each camera has a sector around the machine, in the plane normal to the direction from base to
platform (or to the plane of motion), and tries directions at several heights there. It takes the
one from which most of the legs are seen, and longest in the image, over poses spread through the
motion. It stands as near as the whole machine stays in the image in all poses, but for solids
larger than the space that the legs move in: walls and floors.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import RigidTransform

from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array
from legcal.mechanism.model import Mechanism
from legcal.progress import Report, no_progress
from legcal.simulation.cameras import look_at
from legcal.simulation.placed_board import PlacedBoard
from legcal.simulation.posed_machine import PosedMachine
from legcal.simulation.rendering.footprint import surrounding_points
from legcal.simulation.rendering.solid_in_view import in_view
from legcal.simulation.visibility import field_of_view, legs_in_image
from legcal.vision.camera import Camera

_TURNS = (-0.35, -0.15, 0.0, 0.15, 0.35)  # within its sector, in sectors of a right angle at most
_LIFTS = (0.1, 0.25, 0.45, 0.7, 0.95, 1.2)  # [rad] above the plane across the machine
_LIFTS_PLANAR = (0.8, 0.95, 1.1, 1.25, 1.4)  # [rad] above the plane of motion
_TRIED = 5  # poses at which directions are judged
_SAMPLES = 32  # points of a leg in that
_ROLL = 0.08  # [rad] by which cameras are not upright
_FURTHER = 0.08  # of the least distance, by which cameras stand further away
_HAND_ROLL, _HAND_FURTHER = 0.3, 0.25  # the same for cameras that are held in the hand
_MARGIN = 0.03  # of the image that stays free at each side
_CENTRINGS = 3  # steps that bring the machine into the middle of the image
_MOSTLY = 0.75  # of the poses in which a camera must see the board
_BEHIND = 0.3  # machine sizes that lie between the camera and the machine, at least


def places_around(
    mechanism: Mechanism,
    machines: Sequence[PosedMachine],
    cameras: Sequence[Camera],
    rng: np.random.Generator,
    progress: Report = no_progress,
) -> tuple[RigidTransform, ...]:
    """Return where cameras stand.

    Parameters
    ----------
    mechanism : Mechanism
        The true machine.
    machines : sequence of PosedMachine
        The machine in the poses that the cameras are to see.
    cameras : sequence of Camera
        The camera of each view.
    rng : numpy.random.Generator
        Source of the first sector, of roll and distance.
    progress : callable
        Called as ``progress(stage, done, total)``.

    Returns
    -------
    tuple of RigidTransform
        T_base_camera.
    """
    return scored_places(mechanism, machines, cameras, rng, progress)[0]


def scored_places(
    mechanism: Mechanism,
    machines: Sequence[PosedMachine],
    cameras: Sequence[Camera],
    rng: np.random.Generator,
    progress: Report = no_progress,
    board: PlacedBoard | None = None,
) -> tuple[tuple[RigidTransform, ...], float]:
    """Return where cameras stand, and how much they see.

    Parameters
    ----------
    mechanism, machines, cameras, rng, progress
        As for :func:`places_around`.
    board : PlacedBoard, optional
        A calibration board that every camera must see; the machines have it beside them.

    Returns
    -------
    places : tuple of RigidTransform
        T_base_camera.
    score : float
        The least mean length of the legs in the images of a view [px]; zero if a camera does not
        see the board.
    """
    reached = _reached(machines)
    tried = [machines[i] for i in np.unique(np.linspace(0, len(machines) - 1, _TRIED).astype(int))]
    up = upward(mechanism)
    sector = 2.0 * np.pi / len(cameras)
    first = rng.uniform(0.0, 2.0 * np.pi)
    lifts = _LIFTS if mechanism.spatial else _LIFTS_PLANAR
    found, least = [], np.inf
    for v, camera in enumerate(cameras):
        progress("Cameras", v, len(cameras))
        roll, further = rng.uniform(-_ROLL, _ROLL), 1.0 + _FURTHER * rng.random()
        candidates = [
            _place(
                _direction(up, first + v * sector + turn, lift), up, roll, further, reached, camera
            )
            for turn in min(sector, 0.5 * np.pi) * np.array(_TURNS)
            for lift in lifts
        ]
        scores = [_score(mechanism, tried, camera, T, board) for T in candidates]
        found.append(candidates[int(np.argmax(scores))])
        least = min(least, max(scores))
    progress("Cameras", len(cameras), len(cameras))
    return tuple(found), least


def place_somewhere(
    mechanism: Mechanism,
    machine: PosedMachine,
    camera: Camera,
    rng: np.random.Generator,
    board: PlacedBoard,
) -> tuple[RigidTransform, float]:
    """Return a place by chance of a camera that is held in the hand, and how much it sees.

    Parameters
    ----------
    mechanism : Mechanism
        The true machine.
    machine : PosedMachine
        The machine in the pose that it is to see, with the board.
    camera : Camera
        The camera.
    rng : numpy.random.Generator
        Source of the place.
    board : PlacedBoard
        The board.

    Returns
    -------
    T_base_camera : RigidTransform
        The place.
    score : float
        The mean length of the legs in the image [px], zero if it does not show the board.
    """
    up = upward(mechanism)
    lifts = _LIFTS if mechanism.spatial else _LIFTS_PLANAR
    toward = _direction(up, rng.uniform(0.0, 2.0 * np.pi), rng.uniform(lifts[0], lifts[-1]))
    roll, further = rng.uniform(-_HAND_ROLL, _HAND_ROLL), 1.0 + _HAND_FURTHER * rng.random()
    T = _place(toward, up, roll, further, _reached([machine]), camera)
    return T, _score(mechanism, [machine], camera, T, board)


def upward(mechanism: Mechanism) -> Array:
    """Return the direction from base to platform at home, or the normal of the plane of motion."""
    if mechanism.base_normal is not None:
        return mechanism.base_normal
    A, B = mechanism.A_base, mechanism.home.apply(mechanism.B_platform)
    across = (B - A).mean(axis=0)
    size = float(np.linalg.norm(across))
    reach = float(np.ptp(A, axis=0).max())
    return np.asarray(across / size) if size > 1e-3 * reach else np.array([0.0, 0.0, 1.0])


def _direction(up: Array, turn: float, lift: float) -> Array:
    """Return the unit direction at an angle around *up* and a height [rad]."""
    x, y = normal_basis(up)
    level = np.cos(turn) * x + np.sin(turn) * y
    return np.asarray(np.cos(lift) * level + np.sin(lift) * up)


def _reached(machines: Sequence[PosedMachine]) -> Array:
    """Return points (n, 3) around a machine in all of its poses, without its walls and floors."""
    joints = np.concatenate([part for m in machines for part in (m.A, m.B)])
    size = float(np.linalg.norm(np.ptp(joints, axis=0)))
    solids = [s for m in machines for s in in_view(m.solids, RigidTransform.identity())]
    around = [surrounding_points(s) for s in solids if s.reach < size]
    points = np.concatenate([joints, *around])
    try:
        return np.asarray(points[ConvexHull(points).vertices])
    except QhullError:  # all of them in a plane
        return points


def _place(
    toward: Array, up: Array, roll: float, further: float, points: Array, camera: Camera
) -> RigidTransform:
    """Return the pose of a camera in a direction from which all points are in the image."""
    target = 0.5 * (points.min(axis=0) + points.max(axis=0))
    rotation = look_at(target + toward, target, roll, up=up).rotation
    low, high = field_of_view(camera)
    low, high = (1.0 - 2.0 * _MARGIN) * low, (1.0 - 2.0 * _MARGIN) * high
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    p = rotation.inv().apply(points - target)
    for _ in range(_CENTRINGS):
        needed = [np.max(p[:, :2] / limit - p[:, 2:]) for limit in (low, high)]
        distance = float(max(*needed, _BEHIND * size - p[:, 2].min()))
        seen = p[:, :2] / (p[:, 2:] + distance)
        middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0)) - 0.5 * (low + high)
        aside = np.append(distance * middle, 0.0)
        p = p - aside
        target = target + rotation.apply(aside)
    return look_at(target + further * distance * toward, target, roll, up=up)


def _score(
    mechanism: Mechanism,
    machines: Sequence[PosedMachine],
    camera: Camera,
    T: RigidTransform,
    board: PlacedBoard | None,
) -> float:
    """Return the mean length in the image [px] of all legs, those hidden counted as nothing.

    It counts by the share of the poses in which the board is seen, which must be most of them.
    """
    share = 1.0
    if board is not None:
        shown = [board.is_enough(board.seen(machine, camera, T)) for machine in machines]
        share = float(np.mean(shown))
        if share < _MOSTLY:
            return 0.0
    views = [
        view
        for machine in machines
        for view in legs_in_image(mechanism.legs, machine, camera, T, samples=_SAMPLES)
    ]
    return share * float(np.mean([view.length_px if view.is_seen else 0.0 for view in views]))
