"""Joint axes that meet in a point: R, U and S from revolutes and spheres, and their centres.

Everything is in one frame, with all joints of a leg at zero: what is tested between neighbours
does not depend on their joint values.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from legcal.errors import OutOfClass
from legcal.geometry.lines import distance_to_line
from legcal.geometry.types import Array
from legcal.mechanism.bodies import Connection
from legcal.mechanism.leg import PlatformLetter

CONCURRENT = 10e-6  # [m]
PERPENDICULAR = 1e-3  # [rad]


@dataclass(frozen=True, eq=False)
class Step:
    """A connection as a leg passes it from base to platform.

    Attributes
    ----------
    connection : Connection
        The joint.
    near, far : int
        Which of its two bodies lies towards the base, and which towards the platform.
    axis : (3,) array
        Unit axis in the joint frame.
    """

    connection: Connection
    near: int
    far: int
    axis: Array

    @property
    def name(self) -> str:
        """The joint as a message names it."""
        return self.connection.joint or "the 3d closure"

    def line(self, side: int) -> tuple[Array, Array]:
        """Return a point [m] and the direction of the axis in the body of one side."""
        matrix = self.connection.T_body_joint[side].as_matrix()
        return matrix[:3, 3], matrix[:3, :3] @ self.axis

    def point(self, side: int, along: float) -> Array:
        """Return the point of the axis at a distance from the joint frame's origin [m]."""
        origin, direction = self.line(side)
        return origin + along * direction


@dataclass(frozen=True, eq=False)
class Axis:
    """The axis of a revolute, or the centre of a sphere.

    Attributes
    ----------
    name : str
        The joint.
    point : (3,) array
        A point of the axis: the joint's origin [m].
    direction : (3,) array or None
        Unit direction; None for a sphere.
    """

    name: str
    point: Array
    direction: Array | None

    @property
    def along(self) -> Array:
        """The direction of a revolute."""
        if self.direction is None:
            raise ValueError("a sphere has no axis")
        return self.direction

    def distance(self, point: Array) -> float:
        """Return how far a point is from the axis, or from the centre of a sphere [m]."""
        if self.direction is None:
            return float(np.linalg.norm(point - self.point))
        return float(distance_to_line(point, self.direction, self.point))

    def foot(self, point: Array) -> Array:
        """Return the point of the axis that is nearest to a point [m]."""
        return self.point + ((point - self.point) @ self.along) * self.along


@dataclass(frozen=True, eq=False)
class Pivot:
    """What the revolutes and spheres at one end of a leg make together.

    Attributes
    ----------
    letter : {"R", "U", "S", ""}
        The joint; empty where nothing turns but the leg about itself.
    centre : (3,) array or None
        Its centre [m]; None for R, which has an axis of possible ones.
    axes : tuple of Axis
        The axis of R; the outer one, fixed in base or platform, and the inner one of U.
    spins : tuple of Axis
        Revolutes along the leg that are not part of it.
    spare : int
        Freedoms that it has beyond those of its letter.
    """

    letter: PlatformLetter
    centre: Array | None
    axes: tuple[Axis, ...]
    spins: tuple[Axis, ...] = ()
    spare: int = 0


def pivot(axes: Sequence[Axis], along: Array | None, leg: str) -> Pivot:
    """Return the joint that consecutive spheres and revolutes make, from their geometry.

    Three or more revolutes whose axes meet in one point are an S, two that meet at right angles a
    U. A revolute along the leg turns nothing but the leg itself.

    Parameters
    ----------
    axes : sequence of Axis
        From the one fixed in base or platform to the one fixed in the leg.
    along : (3,) array or None
        The direction of the leg; None while it is not known.
    leg : str
        A joint that names the leg.

    Raises
    ------
    OutOfClass
        If the axes do not meet within 10 um, or a U is not at right angles.
    """
    spheres = [axis for axis in axes if axis.direction is None]
    if spheres:
        return _about(spheres[0], [axis for axis in axes if axis is not spheres[0]], leg)
    lines = _distinct(axes)
    spare = len(axes) - len(lines)
    spins: tuple[Axis, ...] = ()
    if along is not None and 1 <= len(lines) <= 2 and parallel(lines[-1].along, along):
        *lines, spin = lines
        spins = (spin,)
    if len(lines) < 2:
        return Pivot("R" if lines else "", None, tuple(lines), spins, spare)
    centre = _meeting(lines, leg)
    if len(lines) > 2:
        return Pivot("S", centre, (), (), spare + len(lines) - 3)
    tilt = off_square(lines[0].along, lines[1].along)
    if tilt > PERPENDICULAR:
        raise OutOfClass(
            f"leg '{leg}' could not be understood: the axes of {_names(lines)} are "
            f"{np.degrees(tilt):.4g} deg from perpendicular, needed a universal joint within "
            f"{np.degrees(PERPENDICULAR):.2g} deg; correct their axes."
        )
    return Pivot("U", centre, tuple(lines), (), spare)


def _about(sphere: Axis, others: Sequence[Axis], leg: str) -> Pivot:
    """Return an S joint made of a sphere and revolutes through its centre."""
    for axis in others:
        miss = axis.distance(sphere.point)
        if miss > CONCURRENT:
            raise OutOfClass(
                f"leg '{leg}' could not be understood: the axis of '{axis.name}' misses the centre "
                f"of {sphere.name} by {1e3 * miss:.4g} mm, needed one joint at each end of the leg "
                "within 0.01 mm; correct their origins."
            )
    return Pivot("S", sphere.point, (), (), len(others))


def _distinct(axes: Sequence[Axis]) -> list[Axis]:
    """Return axes, each only once where neighbours are one line."""
    lines: list[Axis] = []
    for axis in axes:
        same = (
            lines
            and parallel(lines[-1].along, axis.along)
            and lines[-1].distance(axis.point) <= CONCURRENT
        )
        if not same:
            lines.append(axis)
    return lines


def _meeting(lines: Sequence[Axis], leg: str) -> Array:
    """Return the one point where axes meet [m]."""
    points = []
    for one, two in pairwise(lines):
        near, far = nearest(one, two)
        gap = None if near is None or far is None else float(np.linalg.norm(far - near))
        if near is None or gap is None or gap > CONCURRENT:
            found = "are parallel" if gap is None else f"miss each other by {1e3 * gap:.4g} mm"
            raise OutOfClass(
                f"leg '{leg}' could not be understood: the axes of '{one.name}' and '{two.name}' "
                f"{found}, needed axes that meet within 0.01 mm; correct their origins."
            )
        points.append(near)
    apart = max(float(np.linalg.norm(point - points[0])) for point in points)
    if apart > CONCURRENT:
        raise OutOfClass(
            f"leg '{leg}' could not be understood: the axes of {_names(lines)} meet in two points "
            f"{1e3 * apart:.4g} mm apart, needed one point within 0.01 mm; correct their origins."
        )
    return points[0]


def nearest(one: Axis, two: Axis) -> tuple[Array, Array] | tuple[None, None]:
    """Return the points of two axes that are nearest to each other [m], None if parallel."""
    normal = np.cross(one.along, two.along)
    square = float(normal @ normal)
    if square < PERPENDICULAR**2:
        return None, None
    between = two.point - one.point
    on_one = float(np.cross(between, two.along) @ normal) / square
    on_two = float(np.cross(between, one.along) @ normal) / square
    return one.point + on_one * one.along, two.point + on_two * two.along


def parallel(one: Array, two: Array) -> bool:
    """Say whether two unit directions are parallel, or opposite, within 1 mrad."""
    return bool(np.linalg.norm(np.cross(one, two)) < PERPENDICULAR)


def off_square(one: Array, two: Array) -> float:
    """Return how far two unit directions are from perpendicular [rad]."""
    return abs(float(np.arcsin(np.clip(one @ two, -1.0, 1.0))))


def undirected(axis: Array) -> Array:
    """Return the direction of a line whose last component that is not zero is positive."""
    sized = axis[np.abs(axis) > 1e-9]
    return axis if len(sized) == 0 or sized[-1] > 0.0 else -axis


def _names(axes: Sequence[Axis]) -> str:
    """Return joints as a message names them."""
    return " and ".join(f"'{axis.name}'" for axis in axes)
