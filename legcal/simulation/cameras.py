"""Simulated cameras and the board: poses chosen so that images show the legs.

Places around a machine are scored by the lengths of its legs in the images. A board lies flat near
the base joints, among the legs or beside them, and cameras are placed to see it.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DatasetError, NotVisible
from legcal.geometry.lines import direction_above, normal_basis
from legcal.geometry.motions import look_at
from legcal.geometry.types import Array
from legcal.machine.leg import Link
from legcal.machine.model import Machine
from legcal.perception.placement import sensor_extent
from legcal.planning.places import feet
from legcal.progress import Report, no_progress
from legcal.simulation.board import PlacedBoard
from legcal.simulation.observe import (
    Viewpoint,
    legs_in_image,
)
from legcal.simulation.rendering.rays import in_view, surrounding_points
from legcal.simulation.solids import PosedMachine
from legcal.vision.board import Board, facing_board
from legcal.vision.camera import Camera, sample_camera
from legcal.vision.camera_file import read_camera

_MAX_SHIFT = 0.015  # [m] of rough poses; the method accepts 2 cm and 2 degrees
_MAX_TURN = float(np.deg2rad(1.5))

_MAX_SIDE, _MAX_PIXELS = 65_535, 100_000_000  # limits of PNG files and memory

_TURNS = (-0.35, -0.15, 0.0, 0.15, 0.35)  # azimuths in a sector, in units of it or a right angle
_LIFTS = (0.1, 0.25, 0.45, 0.7, 0.95, 1.2)  # [rad] above the plane across the machine
_LIFTS_PLANAR = (0.8, 0.95, 1.1, 1.25, 1.4)  # [rad] above the plane of motion
_N_POSES = 5  # poses for scoring places
_SAMPLES = 32  # points of a leg for scoring
_ROUNDING = 1e-9  # relative rounding of the upper bound of a score
_ROLL = 0.08  # [rad] maximum roll of cameras
_EXTRA_DISTANCE = 0.08  # maximum extra distance of cameras, in minimum distances
_HAND_ROLL, _HAND_EXTRA_DISTANCE = 0.3, 0.25  # the same for hand-held cameras
_N_HAND_CANDIDATES = 3  # places with board and legs in view, of which the best is taken
MAX_HAND_DRAWS = 60
_MARGIN = 0.03  # free margin at each side, in units of the image size
_CENTRING_STEPS = 3  # steps that bring the machine into the middle of the image
_MIN_BOARD_SHARE = 0.75  # minimum share of poses in which a camera must see the board
_WIDEST = 1.0  # tangent of the widest angle to the axis at which a camera shows the machine
_MIN_DISTANCE = 0.3  # minimum distance between camera and machine, in machine sizes

_N_BOARD_CANDIDATES = 2  # places of a board with cameras, of which the better is taken
_LEVELS = (0.0, -0.08, 0.25)  # heights above the base joints, in machine sizes
_PLATFORM_LEVELS = (0.02, 0.05, 0.1, 0.2, 0.3)  # heights above the joints of the platform


def mild_lens() -> Camera:
    """Return the camera of ``vision.sample_camera`` behind a lens that distorts a little."""
    pinhole = sample_camera()
    return replace(pinhole, distortion=np.array([-0.1, 0.03, 2e-4, -1e-4, 0.0]))


def rough_pose(T_base_camera: RigidTransform, rng: np.random.Generator) -> RigidTransform:
    """Return a camera pose that is up to 15 mm and 1.5 degrees off."""
    shift = _MAX_SHIFT * rng.random() * _any_direction(rng)
    turn = Rotation.from_rotvec(_MAX_TURN * rng.random() * _any_direction(rng))
    return RigidTransform.from_components(
        T_base_camera.translation + shift, turn * T_base_camera.rotation
    )


def _any_direction(rng: np.random.Generator) -> Array:
    """Return a unit vector (3,) that points anywhere."""
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def read_lens(path: Path) -> Camera:
    """Return the camera of a camera file, of a size that pictures can have."""
    camera = read_camera(path)
    if max(camera.width, camera.height) > _MAX_SIDE or camera.width * camera.height > _MAX_PIXELS:
        raise DatasetError(
            f"{path}: the camera could not be simulated: found {camera.width} x {camera.height} "
            f"px, needed at most {_MAX_SIDE} px a side and {_MAX_PIXELS // 10**6} million px; "
            "correct its image size."
        )
    return camera


def cameras_around(
    machine: Machine,
    posed_machines: Sequence[PosedMachine],  # in the poses that the cameras are to see
    cameras: Mapping[str, Camera],
    rng: np.random.Generator,  # of the first sector, roll and distance
    progress: Report = no_progress,
) -> tuple[tuple[Viewpoint, ...], float]:
    """Return cameras around a machine, each in a separate sector, and their score.

    The score is the minimum over views of the mean length of the legs in the images [px], zero if a
    camera does not see a board.
    """
    reached, tried, up = _reached(posed_machines), _some(posed_machines), machine.upward
    sector = 2.0 * np.pi / len(cameras)
    first = rng.uniform(0.0, 2.0 * np.pi)
    lifts = _LIFTS if machine.spatial else _LIFTS_PLANAR
    viewpoints, least = [], np.inf
    for v, (name, camera) in enumerate(cameras.items()):
        progress("Cameras", v, len(cameras))
        roll, further = rng.uniform(-_ROLL, _ROLL), 1.0 + _EXTRA_DISTANCE * rng.random()
        candidates = [
            _before(
                direction_above(up, first + v * sector + turn, lift),
                up,
                roll,
                further,
                reached,
                camera,
            )
            for turn in min(sector, 0.5 * np.pi) * np.array(_TURNS)
            for lift in lifts
        ]
        place, score = _best(machine, tried, camera, candidates)
        viewpoints.append(Viewpoint(name, camera, candidates[place]))
        least = min(least, score)
    progress("Cameras", len(cameras), len(cameras))
    return tuple(viewpoints), least


def camera_in_hand(
    machine: Machine,
    posed: PosedMachine,  # in the pose that the image is to show, with its boards
    camera: Camera,
    rng: np.random.Generator,
) -> RigidTransform | None:
    """Return the best of a few T_base_camera with boards and legs in view; None without any."""
    up, reached = machine.upward, _reached([posed])
    lifts = _LIFTS if machine.spatial else _LIFTS_PLANAR
    good = []
    for _ in range(MAX_HAND_DRAWS):
        toward = direction_above(
            up, rng.uniform(0.0, 2.0 * np.pi), rng.uniform(lifts[0], lifts[-1])
        )
        roll, further = (
            rng.uniform(-_HAND_ROLL, _HAND_ROLL),
            1.0 + _HAND_EXTRA_DISTANCE * rng.random(),
        )
        T = _before(toward, up, roll, further, reached, camera)
        score = _score(machine, [posed], camera, T)
        if score > 0.0:
            good.append((score, T))
        if len(good) == _N_HAND_CANDIDATES:
            break
    return max(good, key=lambda scored: scored[0])[1] if good else None


def board_and_cameras(
    board: Board,
    machine: Machine,
    posed_machines: Sequence[PosedMachine],
    cameras: Mapping[str, Camera],
    rng: np.random.Generator,
    progress: Report = no_progress,
) -> tuple[PlacedBoard, tuple[Viewpoint, ...]]:
    """Return a board on the base of a machine, and cameras around both."""
    good: list[tuple[float, PlacedBoard, tuple[Viewpoint, ...]]] = []
    for placed in _lying(board, machine, _some(posed_machines)):
        together = [placed.beside(posed) for posed in posed_machines]
        views, score = cameras_around(machine, together, cameras, copy.deepcopy(rng), progress)
        if score > 0.0:
            good.append((score, placed, views))
        if len(good) == _N_BOARD_CANDIDATES:
            break
    if not good:
        raise _nowhere(board, "every camera around the machine")
    _, placed, views = max(good, key=lambda scored: scored[0])
    return placed, views


def board_on_platform(
    board: Board,
    machine: Machine,
    posed_machines: Sequence[PosedMachine],
    T_base_platform: Sequence[RigidTransform],
) -> RigidTransform:
    """Return T_platform_board of a board that lies on top of the platform, free of the machine."""
    up = machine.home.rotation.inv().apply(machine.upward)
    size = float(np.linalg.norm(np.ptp(_joints(posed_machines), axis=0)))
    side = normal_basis(up)[0]
    for level in _PLATFORM_LEVELS:
        place = machine.B_platform.mean(axis=0) + level * size * up
        T = facing_board(board, place, up, side)
        placed = [PlacedBoard(board, T_base_platform[k] * T) for k in _few(posed_machines)]
        if not any(
            p.runs_through(body) or p.is_covered(body)
            for p, body in zip(placed, _some(posed_machines), strict=True)
        ):
            return T
    raise _nowhere(board, "the cameras", "platform")


def _few(posed_machines: Sequence[PosedMachine]) -> list[int]:
    return list(map(int, np.unique(np.linspace(0, len(posed_machines) - 1, _N_POSES).astype(int))))


def _some(posed_machines: Sequence[PosedMachine]) -> list[PosedMachine]:
    return [posed_machines[i] for i in _few(posed_machines)]


def _joints(posed_machines: Sequence[PosedMachine]) -> Array:
    """Return the joint centres (n, 3) of a machine in all of its poses [m]."""
    return np.concatenate([part for m in posed_machines for part in (m.A, m.B)])


def _reached(posed_machines: Sequence[PosedMachine]) -> Array:
    """Return points (n, 3) around a machine in all of its poses, without its walls and floors."""
    joints = _joints(posed_machines)
    size = float(np.linalg.norm(np.ptp(joints, axis=0)))
    solids = [s for m in posed_machines for s in in_view(m.solids, RigidTransform.identity())]
    around = [surrounding_points(s) for s in solids if s.reach < size]
    points = np.concatenate([joints, *around])
    try:
        return np.asarray(points[ConvexHull(points).vertices])
    except QhullError:  # all of them in a plane
        return points


def _before(
    toward: Array, up: Array, roll: float, further: float, points: Array, camera: Camera
) -> RigidTransform:
    """Return the pose of a camera in a direction, with all points in the image."""
    target = 0.5 * (points.min(axis=0) + points.max(axis=0))
    rotation = look_at(target + toward, target, roll, up=up).rotation
    low, high = np.clip((1.0 - 2.0 * _MARGIN) * sensor_extent(camera), -_WIDEST, _WIDEST)
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    p = rotation.inv().apply(points - target)
    for _ in range(_CENTRING_STEPS):
        needed = [np.max(p[:, :2] / limit - p[:, 2:]) for limit in (low, high)]
        distance = float(max(*needed, _MIN_DISTANCE * size - p[:, 2].min()))
        directions = p[:, :2] / (p[:, 2:] + distance)
        middle = 0.5 * (directions.min(axis=0) + directions.max(axis=0)) - 0.5 * (low + high)
        aside = np.append(distance * middle, 0.0)
        p = p - aside
        target = target + rotation.apply(aside)
    return look_at(target + further * distance * toward, target, roll, up=up)


def _best(
    machine: Machine,
    posed_machines: Sequence[PosedMachine],
    camera: Camera,
    places: Sequence[RigidTransform],
) -> tuple[int, float]:
    """Return the first of the places with the highest score, and that score.

    Places are left out that could not reach it even if nothing were hidden.
    """
    most = np.array([_length(machine, posed_machines, camera, T, True) for T in places])
    most *= 1.0 + _ROUNDING
    scores = np.full(len(places), -1.0)
    for k in np.argsort(-most, kind="stable").tolist():
        if most[k] < scores.max():
            break
        scores[k] = _score(machine, posed_machines, camera, places[k])
    return int(np.argmax(scores)), float(scores.max())


def _score(
    machine: Machine,
    posed_machines: Sequence[PosedMachine],
    camera: Camera,
    T: RigidTransform,
) -> float:
    """Return the mean length in the image [px] of all legs; hidden legs count as zero.

    It is multiplied by the share of the poses in which each board is visible, which must be most.
    """
    share = 1.0
    for boards in zip(*(posed.boards for posed in posed_machines), strict=True):
        shown = [
            board.is_enough(board.seen(posed, camera, T))
            for board, posed in zip(boards, posed_machines, strict=True)
        ]
        share *= float(np.mean(shown))
        if np.mean(shown) < _MIN_BOARD_SHARE:
            return 0.0
    return share * _length(machine, posed_machines, camera, T, False)


def _length(
    machine: Machine,
    posed_machines: Sequence[PosedMachine],
    camera: Camera,
    T: RigidTransform,
    nothing_hides: bool,
) -> float:
    """Return the mean length in the image [px] of all legs, zero for those that are not seen."""
    seen = [
        legs_in_image(machine.legs, posed, camera, T, samples=_SAMPLES, nothing_hides=nothing_hides)
        for posed in posed_machines
    ]
    total = sum(float(view.length_px[~view.is_arm].sum()) for view in seen)
    return total / (len(seen) * machine.n_legs)


def _lying(
    board: Board, machine: Machine, posed_machines: Sequence[PosedMachine]
) -> Iterator[PlacedBoard]:
    """Yield places near the base that the machine leaves free, one at each foot."""
    up, middle = machine.upward, machine.A_base.mean(axis=0)
    size = float(np.linalg.norm(np.ptp(_joints(posed_machines), axis=0)))
    for foot, side in feet(board, machine.A_base, up):
        for level in _LEVELS:
            T = facing_board(board, middle + foot + level * size * up, up, side)
            placed = PlacedBoard(board, T)
            if not any(placed.runs_through(posed) for posed in posed_machines):
                yield placed
                break


def _nowhere(board: Board, who: str, link: Link = "base") -> NotVisible:
    """Return the error of a board without a suitable place."""
    width, height = np.ptp(board.extent, axis=0)[:2].tolist()
    return NotVisible(
        f"The board could not be placed: found no place near the {link} at which {who} would see a "
        f"{board.kind} of {1000 * width:.0f} x {1000 * height:.0f} mm well enough, needed one in "
        "all images; use a smaller board."
    )
