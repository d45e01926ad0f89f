"""Where a calibration board stands on the base of a machine, so that cameras see it and the legs.

It lies flat near the base joints, among the legs or beside them; for cameras whose places are given
it may also be raised and turned towards them.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DatasetError, NotVisible
from legcal.files import FileSchema, MotionEntry, PlainName, parse_yaml, read_text, validate
from legcal.geometry import Array, motion_of, normal_basis
from legcal.machine import Mechanism
from legcal.progress import Report, no_progress
from legcal.simulation.board import PlacedBoard
from legcal.simulation.machine import Machine
from legcal.simulation.rendering.rays import in_view, surrounding_points
from legcal.simulation.solids import PosedMachine
from legcal.simulation.visibility import Viewpoint, field_of_view, legs_in_image
from legcal.vision import Board, Camera, read_camera

UPWARD = np.array([0.0, 0.0, 1.0])
PAPER_VIEWS = ((0, 1, 2, 3), (2, 3, 4, 5), (0, 1, 4, 5))  # four legs seen at a time


@dataclass(frozen=True, eq=False)
class LegCamera:
    """A camera around a machine in memory, and the legs that it is said to see."""

    camera: Camera  # its intrinsics
    T_Rb_camera: RigidTransform  # its pose in R_b
    legs: tuple[int, ...]  # the legs that its images show


def sample_camera() -> Camera:
    """Return a camera of 1024 x 768 pixels without distortion, as of the example hexapod."""
    K = np.array([[1290.3, 0.0, 518.3], [0.0, 1290.3, 379.6], [0.0, 0.0, 1.0]])
    return Camera(K, 1024, 768)


def mild_lens() -> Camera:
    """Return the camera of :func:`sample_camera` behind a lens that distorts a little."""
    pinhole = sample_camera()
    return replace(pinhole, distortion=np.array([-0.1, 0.03, 2e-4, -1e-4, 0.0]))


def cameras_around(
    machine: Machine,
    rng: np.random.Generator,
    *,
    legs: Sequence[Sequence[int]] = PAPER_VIEWS,
    distance: float = 0.9,
    camera: Camera | None = None,
) -> tuple[LegCamera, ...]:
    """Return cameras that stand around a machine, each on the side of the legs it sees."""
    A_Rb = machine.parameters.base_joints
    B_Rb = machine.home.apply(machine.parameters.platform_joints)
    middle = 0.5 * (A_Rb + B_Rb)
    centre = middle.mean(axis=0)
    cameras = []
    for seen in legs:
        outward = (middle[list(seen)] - centre).mean(axis=0)
        outward[2] = 0.0
        if np.linalg.norm(outward) < 1e-3 * distance:  # every leg is seen: any side will do
            outward = np.array([*rng.normal(size=2), 0.0])
        outward /= np.linalg.norm(outward)
        lift = rng.uniform(0.0, 0.25)
        toward = np.array([*(outward[:2] * np.cos(lift)), np.sin(lift)])
        position = centre + distance * rng.uniform(0.95, 1.05) * toward
        pose = look_at(position, centre, roll=rng.uniform(-0.1, 0.1))
        cameras.append(LegCamera(camera or sample_camera(), pose, tuple(seen)))
    return tuple(cameras)


def look_at(
    position: Array, target: Array, roll: float = 0.0, *, up: Array = UPWARD
) -> RigidTransform:
    """Return the pose of a camera that looks at a point, with its y axis down."""
    z = (target - position) / np.linalg.norm(target - position)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    upright = np.column_stack([x, np.cross(z, x), z])
    return motion_of(upright @ Rotation.from_euler("z", roll).as_matrix(), position)


_SHIFT = 0.015  # [m] at most; a dataset may be off by 2 cm and 2 degrees
_TURN = float(np.deg2rad(1.5))


def rough_pose(T_base_camera: RigidTransform, rng: np.random.Generator) -> RigidTransform:
    """Return a camera pose that is up to 15 mm and 1.5 degrees off."""
    shift = _SHIFT * rng.random() * _any_direction(rng)
    turn = Rotation.from_rotvec(_TURN * rng.random() * _any_direction(rng))
    return RigidTransform.from_components(
        T_base_camera.translation + shift, turn * T_base_camera.rotation
    )


def _any_direction(rng: np.random.Generator) -> Array:
    """Return a unit vector (3,) that points anywhere."""
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


MOST_SIDE, MOST_PIXELS = 65_535, 100_000_000  # what PNG files and memory hold


class PlaceEntry(FileSchema):
    """One camera."""

    T_base_camera: MotionEntry
    camera: str | None = None


class CamerasEntry(FileSchema):
    """The whole file."""

    views: Annotated[dict[PlainName, PlaceEntry], Field(min_length=1)]


def read_lens(path: Path) -> Camera:
    """Return the camera of a camera file, of a size that pictures can have."""
    camera = read_camera(path)
    if max(camera.width, camera.height) > MOST_SIDE or camera.width * camera.height > MOST_PIXELS:
        raise DatasetError(
            f"{path}: the camera could not be simulated: found {camera.width} x {camera.height} "
            f"px, needed at most {MOST_SIDE} px a side and {MOST_PIXELS // 10**6} million px; "
            "correct its image size."
        )
    return camera


def read_cameras(path: Path, camera: Camera) -> dict[str, tuple[Camera, RigidTransform]]:
    """Return the camera and T_base_camera of every view of a file."""
    found = parse_yaml(read_text(path, "cameras file"), path, "cameras file")
    entry = validate(CamerasEntry, found, path)
    return {
        name: (
            camera if view.camera is None else read_lens(path.parent / view.camera),
            view.T_base_camera.motion(),
        )
        for name, view in entry.views.items()
    }


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
    """Return where cameras stand."""
    return scored_places(mechanism, machines, cameras, rng, progress)[0]


def scored_places(
    mechanism: Mechanism,
    machines: Sequence[PosedMachine],
    cameras: Sequence[Camera],
    rng: np.random.Generator,
    progress: Report = no_progress,
    board: PlacedBoard | None = None,
) -> tuple[tuple[RigidTransform, ...], float]:
    """Return where cameras stand, and how much they see."""
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
    """Return a place by chance of a camera that is held in the hand, and how much it sees."""
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


_ENOUGH = 2  # places with cameras, of which the better is taken
_SIDES = 4  # directions beside the machine
_AWAY = 1.05  # half diagonals of the board beyond the base joints
_LEVELS = (0.0, -0.08, 0.25)  # of the size of the machine, above the base joints
_TILTS = (0.0, 0.6, 1.1)  # [rad] from lying flat, towards cameras with given places
_HIDDEN = 0.9  # of what is seen of the legs that must stay seen


@dataclass(frozen=True, eq=False)
class BoardScene:
    """A board in its place and the cameras that see it."""

    placed: PlacedBoard
    machines: tuple[PosedMachine, ...]  # the machine in every pose, with the board
    places: tuple[RigidTransform, ...]  # T_base_camera of every view


def board_and_cameras(
    board: Board,
    mechanism: Mechanism,
    machines: Sequence[PosedMachine],
    cameras: Sequence[Camera],
    rng: np.random.Generator,
    progress: Report = no_progress,
) -> BoardScene:
    """Return a board on the base of a machine, and cameras around both."""
    tried = _some(machines)
    good: list[tuple[float, PlacedBoard, tuple[RigidTransform, ...]]] = []
    for placed in _lying(board, mechanism, tried):
        if len(good) == _ENOUGH:
            break
        together = [placed.beside(machine) for machine in machines]
        places, score = scored_places(
            mechanism, together, cameras, copy.deepcopy(rng), progress, placed
        )
        if score > 0.0:
            good.append((score, placed, places))
    if not good:
        raise NotVisible(_nowhere(board, "every camera around the machine", "use a smaller board"))
    _, placed, places = max(good, key=lambda found: found[0])
    return BoardScene(placed, tuple(placed.beside(machine) for machine in machines), places)


def board_before(
    board: Board,
    mechanism: Mechanism,
    machines: Sequence[PosedMachine],
    views: Sequence[Viewpoint],
) -> BoardScene:
    """Return a board where cameras whose places are given see it."""
    tried = _some(machines)
    towards = np.mean([view.T_base_camera.translation for view in views], axis=0)
    best: tuple[float, PlacedBoard] | None = None
    for placed in _lying(board, mechanism, tried, towards):
        seen = min(_share(placed, tried, view) for view in views)
        if (
            seen > 0.0
            and (best is None or seen > best[0])
            and not _hides(placed, mechanism, tried, views)
        ):
            best = seen, placed
    if best is None:
        raise NotVisible(
            _nowhere(board, "all of the given cameras", "turn or move the cameras, or use another")
        )
    placed = best[1]
    together = tuple(placed.beside(machine) for machine in machines)
    return BoardScene(placed, together, tuple(view.T_base_camera for view in views))


def _some(machines: Sequence[PosedMachine]) -> list[PosedMachine]:
    """Return a machine in a few of its poses."""
    return [machines[i] for i in np.unique(np.linspace(0, len(machines) - 1, _TRIED).astype(int))]


def _lying(
    board: Board,
    mechanism: Mechanism,
    machines: Sequence[PosedMachine],
    towards: Array | None = None,
) -> list[PlacedBoard]:
    """Return places near the base that the machine leaves free, also tilted towards a point."""
    up = upward(mechanism)
    A = mechanism.A_base
    middle = A.mean(axis=0)
    joints = np.concatenate([part for m in machines for part in (m.A, m.B)])
    size = float(np.linalg.norm(np.ptp(joints, axis=0)))
    flat = A - middle - ((A - middle) @ up)[:, None] * up
    reach = float(np.linalg.norm(flat, axis=1).max())
    half = 0.5 * float(np.linalg.norm(np.ptp(board.extent, axis=0)))
    x, y = normal_basis(up)
    around = [np.cos(t) * x + np.sin(t) * y for t in 2.0 * np.pi * np.arange(_SIDES) / _SIDES]
    feet = [(np.zeros(3), x)]
    feet += [((reach + _AWAY * half) * side, side) for side in around]
    found = []
    for foot, side in feet:
        for level in _LEVELS:
            place = middle + foot + level * size * up
            for tilt in _TILTS if towards is not None else _TILTS[:1]:
                normal = up if towards is None else _tilted(up, towards - place, tilt)
                placed = PlacedBoard(board, _facing(board, place, normal, side))
                if not any(placed.runs_through(machine) for machine in machines):
                    found.append(placed)
                    break
            else:
                continue
            break  # one level at each foot
    return found


def _tilted(up: Array, way: Array, tilt: float) -> Array:
    """Return a direction that leans from *up* towards a way by an angle."""
    level = way - (way @ up) * up
    length = float(np.linalg.norm(level))
    if length < 1e-9:
        return up
    return np.asarray(np.cos(tilt) * up + np.sin(tilt) * level / length)


def _facing(board: Board, place: Array, normal: Array, side: Array) -> RigidTransform:
    """Return T_base_board with the middle of the print at a place and its face along a normal."""
    z = normal if board.kind == "aprilgrid" else -normal
    y = side - (side @ z) * z
    if np.linalg.norm(y) < 1e-6:
        y = normal_basis(z)[0]
    y = y / np.linalg.norm(y)
    turn = Rotation.from_matrix(np.column_stack([np.cross(y, z), y, z]))
    return RigidTransform.from_components(place - turn.apply(board.extent.mean(axis=0)), turn)


def _share(placed: PlacedBoard, machines: Sequence[PosedMachine], view: Viewpoint) -> float:
    """Return the share of the corners that a view shows, zero if too few in one of the poses."""
    shown = [
        placed.seen(placed.beside(machine), view.camera, view.T_base_camera) for machine in machines
    ]
    enough = [placed.is_enough(seen) for seen in shown]
    return float(np.mean(shown)) if all(enough) else 0.0


def _hides(
    placed: PlacedBoard,
    mechanism: Mechanism,
    machines: Sequence[PosedMachine],
    views: Sequence[Viewpoint],
) -> bool:
    """Say whether a board hides much of the legs."""
    for view in views:
        lengths = []
        for bodies in (machines, [placed.beside(machine) for machine in machines]):
            shown = [
                legs_in_image(
                    mechanism.legs, machine, view.camera, view.T_base_camera, samples=_SAMPLES
                )
                for machine in bodies
            ]
            lengths.append(sum(leg.length_px for legs in shown for leg in legs if leg.is_seen))
        if lengths[1] < _HIDDEN * lengths[0]:
            return True
    return False


def _nowhere(board: Board, who: str, remedy: str) -> str:
    """Return that a board has no place."""
    width, height = np.ptp(board.extent, axis=0)[:2].tolist()
    return (
        f"The board could not be placed: found no place near the base at which {who} would see a "
        f"{board.kind} of {1000 * width:.0f} x {1000 * height:.0f} mm well enough, needed one in "
        f"all images; {remedy}."
    )
