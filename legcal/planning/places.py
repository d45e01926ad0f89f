"""Where cameras may stand: around the machine, at places of a list, within bounds.

A tripod is set to an eighth of a leg and 5 deg, so a place counts with a margin in the picture
(:class:`Setting`): from where it stands the joints of all poses are in the picture even if it is
set that much wrongly, or, nearer, most of them. Pictures are upright where z of the base link
points up, also of machines that hang: a tripod stands on the ground.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import NotVisible, UsageError
from legcal.files.quantity import LENGTH, parse_quantity
from legcal.geometry.lines import direction_above
from legcal.geometry.motions import look_at
from legcal.geometry.types import Array
from legcal.machine.model import Machine, vectors_A_to_B
from legcal.vision.camera import Camera
from legcal.vision.visibility import in_picture

_TURNS = 16  # directions around the machine
_LIFTS = (0.1, 0.4, 0.75, 1.15)  # [rad] above the plane across the machine
_LIFTS_PLANAR = (0.65, 1.0, 1.35)  # above the plane of motion
_NEARER = (1.0, 0.8, 0.65)  # of the distance from where all is in the picture
_FARTHER = 2.0  # of it, at most, in a box
_ACROSS = 5  # places along each side of a box
_DISTANCES = np.geomspace(0.4, 12.0, 60)  # sizes of the machine, that are tried
_CLEARANCE = 0.3  # of the size, between camera and machine, at least
_ROUNDING = 1e-9


MAX_LENGTH, MAX_ANGLE, MAX_DRAWS = 2.5, 0.8, 10_000  # of a setting: mean leg lengths, [rad]
USUAL_SHIFT, USUAL_LENGTH, USUAL_DRAWS = 0.125, 0.005, 20  # mean leg lengths, draws


@dataclass(frozen=True)
class Setting:
    """How well a tripod is set, and what is known of the machine before.

    Attributes
    ----------
    shift : float
        How far a camera may stand from its place [m], at most.
    length : float
        How far lengths and coordinates are from the model [m], at most.
    turn : float
        How far a camera may look elsewhere [rad], at most.
    angle : float
        How far axes are from the model [rad], at most.
    draws : int
        How many such sessions are drawn to judge a plan.
    """

    shift: float
    length: float
    turn: float = float(np.deg2rad(5.0))
    angle: float = float(np.deg2rad(0.1))
    draws: int = 20

    def margin(self, camera: Camera, nearest: float) -> float:
        """Return how far in the picture a point moves at most, at that distance [px]."""
        focal = float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
        return focal * float(np.tan(self.turn) + (self.shift + self.length) / nearest)

    def camera_elsewhere(self, T: RigidTransform, rng: np.random.Generator) -> RigidTransform:
        """Return a camera pose as it may be set instead of another."""
        shift, turn = rng.normal(size=(2, 3))
        shift *= self.shift * rng.random() / np.linalg.norm(shift)
        turn *= self.turn * rng.random() / np.linalg.norm(turn)
        return RigidTransform.from_components(
            T.translation + shift, Rotation.from_rotvec(turn) * T.rotation
        )


def usual_setting(size: float) -> Setting:
    """Return the setting of a machine of a mean leg length [m], where nobody says more."""
    return Setting(USUAL_SHIFT * size, USUAL_LENGTH * size, draws=USUAL_DRAWS)


@dataclass(frozen=True, eq=False)
class Place:
    """A place of a camera."""

    T_base_camera: RigidTransform
    name: str = ""  # of a tripod that stands somewhere
    fixed: bool = False  # it is not moved any more

    def is_inside(self, bounds: Array | None) -> bool:
        """Say whether a camera stands within bounds (3, 2) [m]."""
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
    up, found = machine.upward, []
    for lift in _LIFTS if machine.spatial else _LIFTS_PLANAR:
        for turn in np.linspace(0.0, 2.0 * np.pi, _TURNS, endpoint=False):
            found += places_along(direction_above(up, turn, lift), points, camera, setting)
    start = f"{machine.yaml_path}: no camera could be placed: found"
    if not found:
        size = float(np.linalg.norm(np.ptp(points, axis=0)))
        raise NotVisible(
            f"{start} no place up to {_DISTANCES[-1] * size:.1f} m around the machine that has all "
            f"of it in the picture, tripods set to {1e2 * setting.shift:.2g} cm and "
            f"{np.degrees(setting.turn):g} deg, needed one; use a camera with a wider view, or "
            "correct the focal length in its file."
        )
    if bounds is None:
        return found
    inside = [place for place in found if place.is_inside(bounds)]
    if len(inside) < _TURNS:  # a box between those places
        inside += _places_in(bounds, points, camera, setting)
    if not inside:
        where = np.array([place.T_base_camera.translation for place in found])
        _, distance, least = _distances(bounds.mean(axis=1), points, camera, setting)
        where_to = " that reach one"
        if distance > _FARTHER * least:
            where_to = ", nearer to the machine"
        elif distance < min(_NEARER) * least:
            where_to = ", farther from the machine"
        spans = [
            f"{name} {low:.2f} to {high:.2f}"
            for name, low, high in zip("xyz", where.min(axis=0), where.max(axis=0), strict=True)
        ]
        raise NotVisible(
            f"{start} no place inside --bounds that shows most of it, near enough, needed one; "
            f"places around the machine have {', '.join(spans)} m: give wider bounds{where_to}, or "
            "a camera with another view."
        )
    return inside


def places_along(toward: Array, points: Array, camera: Camera, setting: Setting) -> list[Place]:
    """Return the places in a direction from where all, or most, points are in the picture."""
    target, size, reach = _extent(toward, points)
    distance = _distance_of_all(toward, points, camera, setting)
    return [
        Place(look_at(target + d * toward, target))
        for d in distance * np.array(_NEARER)
        if d < np.inf and d - reach >= _CLEARANCE * size
    ]


def _places_in(bounds: Array, points: Array, camera: Camera, setting: Setting) -> list[Place]:
    """Return places all over a box, from where all, or most, points are in the picture."""
    grid = np.meshgrid(*(np.linspace(low, high, _ACROSS) for low, high in bounds))
    found = []
    for position in np.stack(grid, axis=-1).reshape(-1, 3):
        toward, d, distance = _distances(position, points, camera, setting)
        target, size, reach = _extent(toward, points)
        if d - reach >= _CLEARANCE * size and min(_NEARER) <= d / distance <= _FARTHER:
            found.append(Place(look_at(position, target)))
    return found


def _distances(
    position: Array, points: Array, camera: Camera, setting: Setting
) -> tuple[Array, float, float]:
    """Return the direction of a position from points, how far it is, and from how far all show.

    Distances are those from the middle of the points [m].
    """
    away = position - 0.5 * (points.min(axis=0) + points.max(axis=0))
    d = max(float(np.linalg.norm(away)), _ROUNDING)
    return away / d, d, _distance_of_all(away / d, points, camera, setting)


def _extent(toward: Array, points: Array) -> tuple[Array, float, float]:
    """Return the middle of points, their size, and how far they reach in a direction [m]."""
    target = 0.5 * (points.min(axis=0) + points.max(axis=0))
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    return target, size, float(((points - target) @ toward).max())


def _distance_of_all(toward: Array, points: Array, camera: Camera, setting: Setting) -> float:
    """Return from how far all points are in the picture [m], infinity if from nowhere."""
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
    """Return bounds (3, 2) [m] of a text ``-2:2,-2:2,0:1.5``."""
    parts = [part.split(":") for part in text.split(",")]
    if len(parts) != 3 or any(len(part) != 2 for part in parts):
        raise UsageError(
            f"--bounds could not be used: found '{text}', needed lowest and highest x, y and z of "
            "the camera in the base link; write them like -2m:2m,-2m:2m,0m:1.5m."
        )
    found = np.array([[_coordinate(x.strip()) for x in part] for part in parts])
    if np.any(found[:, 0] >= found[:, 1]):
        raise UsageError(
            f"--bounds could not be used: found '{text}', needed the lower number first in each "
            "pair; exchange them."
        )
    return found


def _coordinate(text: str) -> float:
    """Return a coordinate [m], which may be negative."""
    size = parse_quantity(text.removeprefix("-"), LENGTH, "--bounds")
    return -size if text.startswith("-") else size


def near(place: Place, target: Array, step: float, rng: np.random.Generator) -> Place:
    """Return a place that stands a little elsewhere and looks at the machine."""
    if place.fixed:
        return place
    position = place.T_base_camera.translation
    away = np.linalg.norm(position - target)
    return Place(look_at(position + step * away * rng.normal(size=3), target))


def all_points(machine: Machine, poses: Sequence[RigidTransform]) -> Array:
    """Return the joints (n, 3) of a machine in poses, in the base link [m]."""
    ends = [T.apply(machine.B_platform) for T in poses]
    if not machine.actuators:
        return np.concatenate([machine.A_base, *ends])
    carried = [B - vectors_A_to_B(machine, T) for B, T in zip(ends, poses, strict=True)]
    return np.concatenate([*carried, *ends])
