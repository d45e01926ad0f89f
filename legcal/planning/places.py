"""Camera places: around the machine, from a list, within bounds.

A tripod is placed to within an eighth of a leg and 5 deg, so that places are chosen with a margin
in the picture (:class:`Setting`): the joints of all poses, or from nearer places most of them, are
in the picture for every tripod within tolerance. Pictures are upright for z of the base link
pointing up, also for hanging machines: a tripod stands on the ground.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import NotVisible, UsageError
from legcal.files.quantity import LENGTH, parse_quantity
from legcal.geometry.lines import direction_above, normal_basis
from legcal.geometry.motions import look_at
from legcal.geometry.types import Array, BoolArray
from legcal.machine.model import Machine, vectors_A_to_B
from legcal.vision.board import Board, dictionary, facing_board
from legcal.vision.camera import Camera
from legcal.vision.visibility import Bodies, behind_plate, in_picture, rays_past_axes

_N_AZIMUTHS = 16  # directions around the machine
_ELEVATIONS = (0.1, 0.4, 0.75, 1.15)  # [rad] above the plane across the machine
_ELEVATIONS_PLANAR = (0.65, 1.0, 1.35)  # above the plane of motion
_NEARER = (1.0, 0.8, 0.65)  # of the distance from where all is in the picture
_DISTANCES = np.geomspace(0.4, 12.0, 60)  # sizes of the machine, that are tried
_CLEARANCE = 0.3  # of the size, between camera and machine, at least
_ROUNDING = 1e-9


MAX_LENGTH, MAX_ANGLE, MAX_DRAWS = 2.5, 0.8, 10_000  # of a setting: mean leg lengths, [rad]
USUAL_SHIFT, USUAL_LENGTH, USUAL_DRAWS = 0.125, 0.005, 20  # mean leg lengths, draws


@dataclass(frozen=True)
class Setting:
    """Tolerances of tripods and of the machine: the largest errors."""

    shift: float  # of the place of a camera [m]
    length: float  # of lengths and coordinates of the model [m]
    turn: float = float(np.deg2rad(5.0))  # of the orientation of a camera [rad]
    angle: float = float(np.deg2rad(0.1))  # of axes of the model [rad]
    draws: int = 20  # random sessions within these tolerances, to evaluate a plan

    def margin(self, camera: Camera, nearest: float) -> float:
        """Return the largest image shift of a point at a distance *nearest* [px]."""
        focal = float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
        return focal * float(np.tan(self.turn) + (self.shift + self.length) / nearest)

    def perturbed_camera(self, T: RigidTransform, rng: np.random.Generator) -> RigidTransform:
        """Draw a camera pose within tolerance."""
        shift, turn = rng.normal(size=(2, 3))
        shift *= self.shift * rng.random() / np.linalg.norm(shift)
        turn *= self.turn * rng.random() / np.linalg.norm(turn)
        return RigidTransform.from_components(
            T.translation + shift, Rotation.from_rotvec(turn) * T.rotation
        )


def default_setting(machine: Machine) -> Setting:
    """Return the default tolerances, those of a machine that is stated to be worse.

    Uniform errors up to the root of three sigmas have that sigma.
    """
    usual = Setting(USUAL_SHIFT * machine.size, USUAL_LENGTH * machine.size, draws=USUAL_DRAWS)
    stated = machine.tolerance
    length = math.sqrt(3.0) * max(stated.joints or 0.0, stated.lengths or 0.0)
    angle = math.sqrt(3.0) * (stated.axes or 0.0)
    return replace(usual, length=max(length, usual.length), angle=max(angle, usual.angle))


@dataclass(frozen=True, eq=False)
class Place:
    """A place of a camera."""

    T_base_camera: RigidTransform
    name: str = ""  # of the view, where it has been photographed from

    def is_inside(self, bounds: Array | None) -> bool:
        """Whether the camera is within bounds (3, 2) [m]."""
        if bounds is None:
            return True
        x = self.T_base_camera.translation
        return bool(np.all((x >= bounds[:, 0] - _ROUNDING) & (x <= bounds[:, 1] + _ROUNDING)))


def places_around(
    machine: Machine,
    points: Array,  # (n, 3) joints in the base link, of many poses [m]
    camera: Camera,
    setting: Setting,
    bounds: Array | None,  # (3, 2) lowest and highest coordinates in the base link [m]
) -> list[Place]:
    """Return places all around a machine. Raises NotVisible if there are none."""
    up, places = machine.upward, []
    for lift in _ELEVATIONS if machine.spatial else _ELEVATIONS_PLANAR:
        for turn in np.linspace(0.0, 2.0 * np.pi, _N_AZIMUTHS, endpoint=False):
            places += places_along(direction_above(up, turn, lift), points, camera, setting)
    start = f"{machine.yaml_path}: no camera could be placed:"
    if not places:
        size = float(np.linalg.norm(np.ptp(points, axis=0)))
        raise NotVisible(
            f"{start} no position within {_DISTANCES[-1] * size:.1f} m has the whole machine in "
            f"the image (tripod tolerance {1e2 * setting.shift:.2g} cm and "
            f"{np.degrees(setting.turn):g} deg); use a camera with a wider view, or correct the "
            "focal length in its file."
        )
    if bounds is None:
        return places
    inside = [place for place in places if place.is_inside(bounds)]
    if not inside:
        positions = np.array([place.T_base_camera.translation for place in places])
        spans = [
            f"{name} {low:.2f} to {high:.2f}"
            for name, low, high in zip(
                "xyz", positions.min(axis=0), positions.max(axis=0), strict=True
            )
        ]
        raise NotVisible(
            f"{start} no position inside --bounds shows most of the machine large enough; "
            f"positions around the machine are at {', '.join(spans)} m: widen --bounds to reach "
            "one, or use a camera with another field of view."
        )
    return inside


def places_along(toward: Array, points: Array, camera: Camera, setting: Setting) -> list[Place]:
    """Return the places in a direction with all, or most, points in the picture."""
    target, size, reach = _extent(toward, points)
    distance = _distance_to_frame_all(toward, points, camera, setting)
    return [
        Place(look_at(target + d * toward, target))
        for d in distance * np.array(_NEARER)
        if d < np.inf and d - reach >= _CLEARANCE * size
    ]


def _extent(toward: Array, points: Array) -> tuple[Array, float, float]:
    """Centre of points, their size, and their extent in a direction [m]."""
    target = 0.5 * (points.min(axis=0) + points.max(axis=0))
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    return target, size, float(((points - target) @ toward).max())


def _distance_to_frame_all(toward: Array, points: Array, camera: Camera, setting: Setting) -> float:
    """Distance from which all points are in the picture [m], infinite if there is none."""
    target, size, reach = _extent(toward, points)
    for distance in _DISTANCES * size:
        nearest = distance - reach
        if nearest < _CLEARANCE * size:
            continue
        P = look_at(target + distance * toward, target).inv().apply(points)
        if in_picture(camera, P, 0.0, setting.margin(camera, nearest)).all():
            return float(distance)
    return np.inf


def parse_bounds(text: str) -> Array:
    """Parse bounds (3, 2) [m] from a text ``-2m:2m,-2m:2m,0m:1.5m``."""
    parts = [part.split(":") for part in text.split(",")]
    if len(parts) != 3 or any(len(part) != 2 for part in parts):
        raise UsageError(
            f"--bounds could not be used: found '{text}', needed lowest and highest x, y and z of "
            "the camera in the base link; write them like -2m:2m,-2m:2m,0m:1.5m."
        )
    bounds = np.array([[_coordinate(x.strip()) for x in part] for part in parts])
    if np.any(bounds[:, 0] >= bounds[:, 1]):
        raise UsageError(
            f"--bounds could not be used: found '{text}', needed the lower number first in each "
            "pair; swap them."
        )
    return bounds


def _coordinate(text: str) -> float:
    """Parse a coordinate [m], which may be negative."""
    size = parse_quantity(text.removeprefix("-"), LENGTH, "--bounds")
    return -size if text.startswith("-") else size


def near(place: Place, target: Array, step: float, rng: np.random.Generator) -> Place:
    """Draw a place nearby that looks at the machine."""
    position = place.T_base_camera.translation
    distance = np.linalg.norm(position - target)
    return Place(look_at(position + step * distance * rng.normal(size=3), target))


def all_points(machine: Machine, poses: Sequence[RigidTransform]) -> Array:
    """Return the joints (n, 3) of a machine in poses, in the base link [m]."""
    ends = [T.apply(machine.B_platform) for T in poses]
    if not machine.actuators:
        return np.concatenate([machine.A_base, *ends])
    carried = [B - vectors_A_to_B(machine, T) for B, T in zip(ends, poses, strict=True)]
    return np.concatenate([*carried, *ends])


# A board on the base, and the images that show it


_SIDES = 4  # directions beside the machine
_DISTANCE = 1.05  # of a board beside the base joints, in half diagonals
_MIN_COSINE = 0.45  # between the normal of the print and the line of sight
_MODULE_PX = 2.0  # least apparent width of a module of a marker
_MODULES = 6.0  # modules equivalent to a square without a marker
_FRAME = {"charuco": 2, "aprilgrid": 4}  # modules of the black frame of a marker, both sides


@dataclass(frozen=True, eq=False)
class LaidBoard:
    """A calibration board at its place on the base."""

    board: Board
    T_base_board: RigidTransform

    @property
    def normal(self) -> Array:
        """Normal of the print in the base link, (3,)."""
        z = self.T_base_board.rotation.as_matrix()[:, 2]
        return np.asarray(z * self.board.towards_viewer)

    @property
    def corners(self) -> Array:
        """The outer corners of the print in the base link, (4, 3) [m]."""
        return np.asarray(self.T_base_board.apply(self.board.extent))

    @property
    def middle(self) -> Array:
        """The middle of the print in the base link, (3,) [m]."""
        return np.asarray(self.corners.mean(axis=0))

    def is_shown(
        self,
        camera: Camera,
        T_base_camera: RigidTransform,
        bodies: Bodies,
        margin_px: float = 0.0,
        *,
        is_read: bool = True,  # require the size for detection
    ) -> BoolArray:
        """Return a mask of the images of one camera that show the board, (n_images,)."""
        n = len(bodies.B)
        outer, eye = self.corners, T_base_camera.translation
        P = T_base_camera.inv().apply(outer)
        sight = eye - outer
        cosine = sight @ self.normal / np.linalg.norm(sight, axis=1)
        is_in_picture = in_picture(camera, P, bodies.nearest, margin_px).all()
        if cosine.min() < _MIN_COSINE or not is_in_picture:
            return np.zeros(n, dtype=np.bool_)
        if is_read and self._narrowest(camera.project(P)) < _MODULE_PX:
            return np.zeros(n, dtype=np.bool_)
        points = np.concatenate([outer, self.T_base_board.apply(self.board.points)])
        T = T_base_camera.inv()
        P = np.broadcast_to(T.apply(points), (n, len(points), 3))
        bodies = bodies.before(T_base_camera)
        distance, depth, square = rays_past_axes(P, bodies.A, *bodies.axes)
        aside = bodies.radius + self.board.side * depth / distance[..., None]
        hidden = (square < aside**2) & (depth > 0.0) & (depth < distance[..., None])
        B = bodies.B[:, : bodies.n_legs]
        hidden = hidden.any(axis=-1) | behind_plate(P[:, None], B, 0.0, surely=False)[:, 0]
        nobody, beside = np.full(len(points), -1), np.full(len(points), self.board.side)
        for k, placed in enumerate(bodies.occluders):
            hidden[k] |= placed.hide(P[k], nobody, beside, np.zeros(len(points))) >= 0
        return ~np.asarray(hidden.any(axis=1))

    def _narrowest(self, px: Array) -> float:
        """Least apparent width of a module, from outer corners (4, 2) [px]."""
        board = self.board
        x, y = (px[1] - px[0]) / board.columns, (px[3] - px[0]) / board.rows  # of a tile
        tile = abs(x[0] * y[1] - x[1] * y[0]) / max(np.linalg.norm(x), np.linalg.norm(y))
        if board.kind == "chessboard":
            return float(tile / _MODULES)
        n = dictionary(board.dictionary).markerSize + _FRAME[board.kind]
        of_tile = board.marker / board.side if board.marker else 1.0 / (1.0 + board.spacing)
        return float(tile * of_tile / n)


def feet(board: Board, A: Array, up: Array) -> list[tuple[Array, Array]]:
    """Return candidate positions relative to the centre of base joints, and x axes, (3,) [m].

    At the centre, and beyond all joints in a few directions normal to *up*.
    """
    flat = A - A.mean(axis=0)
    flat = flat - (flat @ up)[:, None] * up
    reach = float(np.linalg.norm(flat, axis=1).max())
    half = 0.5 * float(np.linalg.norm(np.ptp(board.extent, axis=0)))
    x, y = normal_basis(up)
    around = [np.cos(t) * x + np.sin(t) * y for t in 2.0 * np.pi * np.arange(_SIDES) / _SIDES]
    return [(np.zeros(3), x), *(((reach + _DISTANCE * half) * side, side) for side in around)]


def lying(board: Board, machine: Machine) -> list[LaidBoard]:
    """Return the candidate places of a board on the base."""
    up, middle = machine.upward, machine.A_base.mean(axis=0)
    return [
        LaidBoard(board, facing_board(board, middle + foot, up, side))
        for foot, side in feet(board, machine.A_base, up)
    ]
