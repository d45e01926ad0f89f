"""A leg: the chain of joint, slider or rod, and joint from base to platform, and its numbers.

:class:`JointType` is the table of joints: their freedoms, axes and the equations that they add to
their leg. Vectors of the base are in a frame of the base, those of the platform in a frame of the
platform: the links for the legs of a :class:`~legcal.machine.model.Machine`, the joint frames R_b
and R_e for :func:`legcal.machine.parameters.geometries`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Literal, NamedTuple

import numpy as np

from legcal.brief import brief
from legcal.geometry.lines import cross, distance_to_line, normal_basis
from legcal.geometry.motions import matrix_inverse
from legcal.geometry.types import Array, BoolArray
from legcal.machine.actuator import Actuator, ActuatorColumns, Arm
from legcal.machine.chain import Connection

Link = Literal["base", "platform"]
LINKS: tuple[Link, ...] = ("base", "platform")
TRAVEL_MARGIN = 0.05  # tolerance of the travel, relative to it
# Default standard deviations of readings and of measured lengths, in mean leg lengths.
SIGMA_READING, SIGMA_LENGTH = 5e-6, 1.25e-4
MIN_LENGTH, MAX_LENGTH = 1e-3, 20.0  # plausible leg lengths [m]; others hint at a wrong unit
MIN_RADIUS, MAX_RADIUS = 2e-4, 0.5  # plausible radii, relative to the leg length
PERPENDICULAR = 1e-3  # largest angular error of perpendicular and parallel axes [rad]
MAX_LEGS = 32  # computing time grows with the cube of the number of legs


class LegColumns:
    """Columns of the numbers of a leg: joint centres [m], length [m], angles of axes, twist."""

    A, B, LENGTH = slice(0, 3), slice(3, 6), 6
    BASE_AXIS, PLATFORM_AXIS, TWIST = slice(7, 9), slice(9, 11), 11
    OWN = 12  # number of columns of the leg itself; its actuator follows (ActuatorColumns)
    ACTUATOR = slice(OWN, OWN + ActuatorColumns.COUNT)
    COUNT = ACTUATOR.stop


class LegKind(StrEnum):
    """The freedom along a leg: a motor with an encoder, a free slider, or none."""

    ACTUATED = "actuated"
    PASSIVE = "passive"
    CONSTANT = "constant"


class EquationKind(StrEnum):
    """The subject of an equation of a leg."""

    LENGTH = "length"
    BASE_AXIS = "base axis"
    PLATFORM_AXIS = "platform axis"
    DIRECTION_1 = "direction in the platform, first angle"
    DIRECTION_2 = "direction in the platform, second angle"
    TWIST = "twist"
    PLANE = "plane of motion"  # of the platform of a planar machine, without leg


class JointType(StrEnum):
    """The joint at one end of a leg, by its letter.

    ============  ==  ======================  ====================  ============================
    joint             axis in base, platform  axis in the leg       constraint on direction u
    ============  ==  ======================  ====================  ============================
    revolute      R   v                       v                     v . u = 0, eq (7)
    universal     U   v                       v x u                 none
    spherical     S   none                    none: the leg twists  none
    fixed             u                       the first across u    u across its axis, two rows
    ============  ==  ======================  ====================  ============================
    """

    n_freedoms: int  # free rotations of the leg
    at_base: tuple[EquationKind, ...]  # equations that it adds to its leg at the base
    at_platform: tuple[EquationKind, ...]  # equations that it adds at the platform

    def __new__(
        cls,
        letter: str,
        n_freedoms: int = 0,
        at_base: tuple[EquationKind, ...] = (),
        at_platform: tuple[EquationKind, ...] = (),
    ) -> JointType:
        """Return a row of the table."""
        member = str.__new__(cls, letter)
        member._value_ = letter
        member.n_freedoms, member.at_base, member.at_platform = n_freedoms, at_base, at_platform
        return member

    REVOLUTE = "R", 1, (EquationKind.BASE_AXIS,), (EquationKind.PLATFORM_AXIS,)
    UNIVERSAL = "U", 2
    SPHERICAL = "S", 3
    FIXED = "", 0, (), (EquationKind.DIRECTION_1, EquationKind.DIRECTION_2)  # at the platform only

    @property
    def has_axis(self) -> bool:
        """Whether it has an axis fixed in base or platform."""
        return self in (JointType.REVOLUTE, JointType.UNIVERSAL)

    @property
    def twists_freely(self) -> bool:
        """Whether the leg may twist about itself."""
        return self is JointType.SPHERICAL

    @property
    def inner_is_across(self) -> bool:
        """Whether the axis in the leg is normal to the leg and to the axis in base or platform."""
        return self is JointType.UNIVERSAL


class Cover(NamedTuple):
    """A section of a leg that moves with one half of it, such as one inside a solid."""

    side: Literal["base", "platform"]
    start: float  # from A for base, from B for platform, positive from A to B [m]
    end: float

    def span(self, length: float) -> tuple[float, float]:
        """Return both ends as distances from A along a leg of this length [m]."""
        shift = 0.0 if self.side == "base" else length
        return self.start + shift, self.end + shift


@dataclass(frozen=True)
class Cylinder:
    """A visible cylinder coaxial with its leg: a tube or a rod."""

    link: str  # the URDF link that carries the visual; it names the part in observations
    radius: float  # [m]
    side: Literal["base", "platform"]  # the half of the leg that carries it
    start: float  # ends along the leg [m], start < end: from A for base, from B for platform,
    end: float  # positive from A to B
    covers: tuple[Cover, ...] = ()  # sections enclosed by other solids of the leg

    def span(self, length: float) -> tuple[float, float]:
        """Return both ends as distances from A along a leg of this length [m]."""
        return Cover(self.side, self.start, self.end).span(length)


def with_radii(
    cylinders: Sequence[Sequence[Cylinder]], radius: Callable[[int, Cylinder], float]
) -> tuple[tuple[Cylinder, ...], ...]:
    """Return the cylinders of all legs with radii [m] by a function of leg index and cylinder."""
    return tuple(
        tuple(replace(cylinder, radius=radius(j, cylinder)) for cylinder in of_leg)
        for j, of_leg in enumerate(cylinders)
    )


def main_cylinders(cylinders: Sequence[Cylinder]) -> dict[str, Cylinder]:
    """Return the longest cylinder of each link, which it names as a part; others only hide."""
    longest: dict[str, Cylinder] = {}
    for cylinder in sorted(cylinders, key=lambda c: (c.end - c.start, c.radius)):
        longest[cylinder.link] = cylinder
    return longest


def cylinder_of_arm(arm: Arm) -> Cylinder:
    """Return an arm as a cylinder along its own line, from its near end."""
    return Cylinder(arm.link, arm.radius, "base", 0.0, arm.length)


@dataclass(frozen=True, eq=False)
class Axis:
    """The axis of a revolute, or the centre of a sphere (no direction)."""

    name: str
    point: Array  # (3,) origin of the joint [m]
    direction: Array | None  # (3,) unit vector

    @property
    def along(self) -> Array:
        """The direction of a revolute."""
        if self.direction is None:
            raise ValueError("a sphere has no axis")
        return self.direction

    def distance(self, point: Array) -> float:
        """Return the distance of a point from the axis, or from the centre of a sphere [m]."""
        if self.direction is None:
            return float(np.linalg.norm(point - self.point))
        return float(distance_to_line(point, self.direction, self.point))

    def foot(self, point: Array) -> Array:
        """Return the point of the axis nearest to a point [m]."""
        return self.point + ((point - self.point) @ self.along) * self.along

    def nearest(self, other: Axis) -> tuple[Array, Array] | None:
        """Return the nearest points of two axes [m], None if they are parallel."""
        normal = cross(self.along, other.along)
        square = float(normal @ normal)
        if square < PERPENDICULAR**2:
            return None
        between = other.point - self.point
        here = float(cross(between, other.along) @ normal) / square
        there = float(cross(between, self.along) @ normal) / square
        return self.point + here * self.along, other.point + there * other.along

    def gap(self, other: Axis) -> float:
        """Return the distance of axes or spheres [m], infinite for parallel axes."""
        if self.direction is None:
            return other.distance(self.point)
        if other.direction is None:
            return self.distance(other.point)
        ends = self.nearest(other)
        return math.inf if ends is None else float(np.linalg.norm(ends[1] - ends[0]))


@dataclass(frozen=True, eq=False)
class Pivot:
    """The joint formed by the revolutes and spheres at one end of a leg."""

    type: JointType  # FIXED if the leg only turns about itself
    centre: Array | None  # (3,) [m]; None for R, which has an axis of possible centres
    axes: tuple[Axis, ...]  # axis of R; for U the one fixed in base or platform, then the inner one
    spins: tuple[Axis, ...] = ()  # revolutes along the leg that are not part of it
    spare: int = 0  # freedoms beyond those of its type

    def near(self, point: Array | None) -> Array:
        """Return the centre, of an R the point of its axis nearest to a point (3,) [m]."""
        if self.centre is not None:
            return self.centre
        return self.axes[0].point if point is None else self.axes[0].foot(point)

    @property
    def outer(self) -> Array | None:
        """The direction fixed in base or platform of R or U."""
        return self.axes[0].along if self.axes else None

    @property
    def inner(self) -> Array | None:
        """The direction fixed in the leg of R or U."""
        return self.axes[-1].along if self.axes else None


@dataclass(frozen=True, eq=False)
class LegChain:
    """The joints of one leg, and its geometry with all of them at zero, in the base body."""

    steps: tuple[Connection, ...]  # passed from base to platform
    poses: tuple[Array, ...]  # (4, 4) of the bodies from base to platform
    n_lower: int  # number of joints below the slider, or the rod, with its actuator
    slider: Connection | None  # None for a leg of constant length
    base: Pivot
    platform: Pivot
    A: Array  # (3,) [m]
    B: Array  # (3,) [m]
    u: Array  # (3,) direction of the slider towards the platform; else from A to B
    idle_spins: int  # freedoms that only spin the leg about itself
    actuator: Connection | None = None  # the first step, if it is a motor that carries the rod

    @property
    def B_platform(self) -> Array:
        """B in the platform body, (3,) [m]."""
        return self.line_in(-1, self.B)[0]

    @property
    def bodies(self) -> tuple[str, ...]:
        """The bodies of the leg, without base and platform."""
        return tuple(step.bodies[1] for step in self.steps[:-1])

    @property
    def is_joint(self) -> bool:
        """Whether it is one joint that holds the platform on the base."""
        return self.n_lower == len(self.steps)

    @property
    def n_upper(self) -> int:
        """The index of the body behind the slider, or of the rod."""
        return self.n_lower + (self.slider is not None)

    @property
    def motor(self) -> str | None:
        """The joint of the slider, or of the motor that carries the rod; None for other rods."""
        moving = self.slider or self.actuator
        return None if moving is None else moving.joint

    @property
    def reach(self) -> float:
        """Position of B past A along u at joint value zero [m]."""
        return float((self.B - self.A) @ self.u)

    @property
    def twists(self) -> bool:
        """Whether an S joint lets the leg twist about itself."""
        return self.base.type.twists_freely or self.platform.type.twists_freely

    def line_in(self, body: int, point: Array) -> tuple[Array, Array]:
        """Return a point and the direction u in one of the bodies: 0 the base, -1 the platform."""
        matrix = matrix_inverse(self.poses[body])
        return matrix[:3, :3] @ point + matrix[:3, 3], matrix[:3, :3] @ self.u


@brief
@dataclass(frozen=True, eq=False)
class Leg:
    """A leg from its base joint centre A to its platform joint centre B.

    Axes are lines, given for joints whose axis is a parameter: R, and the outer axis of U in a leg
    without an S joint; none in planar machines. A leg that is fixed to the platform (the centre
    leg of a Tricept) has its direction from A to B as platform axis, and B at the foot of the
    platform link origin, or in R_e at its :func:`frame_point` if it defines R_e. The twist is the
    angle about u from the inner axis at the base to the inner axis at the platform, constant for a
    leg without an S joint.
    """

    base_joint: JointType
    platform_joint: JointType
    kind: LegKind
    A: Array  # (3,) base joint centre [m], with an actuator that carries it at reading 0
    B: Array  # (3,) platform joint centre [m]
    q0: float  # length at reading zero [m], L = sign q + q0; the length of a rod
    base_axis: Array | None = None  # (3,) unit axis; in links its last nonzero component is > 0
    platform_axis: Array | None = None  # (3,)
    twist: float | None = None  # [rad], in (-pi/2, pi/2]
    name: str = ""
    prismatic: str | None = None  # the URDF joint of the slider, or of the actuator of a rod
    sign: int = 1  # -1 if the leg shrinks with the joint value
    travel: tuple[float, float] = (0.0, 0.0)  # joint limits of slider or actuator [m or rad]
    cylinders: tuple[Cylinder, ...] = ()  # visible cylinders
    chain: LegChain | None = None  # its joints in the URDF; None without a file
    actuator: Actuator | None = None  # the motor that carries the joint at A of a rod
    mode: int = 1  # sign of d|AB|/dq of such a rod, which selects one of two readings

    @property
    def is_motor(self) -> bool:
        """Whether a motor moves it: a slider, or the actuator of a rod."""
        return self.kind is LegKind.ACTUATED or self.actuator is not None

    @property
    def has_value(self) -> bool:
        """Whether it has a joint value: of a slider, or of the actuator of a rod."""
        return self.kind is not LegKind.CONSTANT or self.actuator is not None

    @property
    def reads_angle(self) -> bool:
        """Whether its motor turns, so that its reading is an angle [rad]."""
        return self.actuator is not None and self.actuator.turns

    @property
    def reading_unit(self) -> Literal["m", "rad"]:
        """The unit of its readings."""
        return "m" if self.actuator is None else self.actuator.unit

    @property
    def motor_label(self) -> str:
        """The name of its motor in messages: the joint that moves A, else the leg itself."""
        return self.name if self.actuator is None else self.actuator.joint

    def reading_of(self, distance: float) -> float:
        """Return the change of reading [m or rad] that moves the joint at A, or B, by *distance*.

        For a motor that slides it is the distance itself.
        """
        if self.actuator is None or not self.actuator.turns:
            return distance
        return distance / float(distance_to_line(self.A, self.actuator.axis, self.actuator.point))

    @property
    def type(self) -> str:
        """The joints from base to platform, such as ``SPU``; ``UP`` if fixed to the platform.

        For a rod on an actuator the actuator comes first: ``PSS``, ``RSS``.
        """
        first = "" if self.actuator is None else "R" if self.actuator.turns else "P"
        slider = "" if self.kind is LegKind.CONSTANT else "P"
        return f"{first}{self.base_joint}{slider}{self.platform_joint}"

    @property
    def arm(self) -> Arm | None:
        """The arm of its motor if outlines list it as a part of this rod, else None."""
        arm = None if self.actuator is None else self.actuator.arm
        return arm if arm is not None and arm.leg == self.name else None

    def is_arm(self, part: str) -> bool:
        """Return whether a part is the arm of its motor, not along the leg."""
        return self.arm is not None and self.arm.link == part

    @property
    def radius_along(self) -> dict[str, float]:
        """Radius [m] of each part along the leg with outlines, by URDF link."""
        return {link: c.radius for link, c in main_cylinders(self.cylinders).items()}

    @property
    def radius_of_part(self) -> dict[str, float]:
        """Radius [m] of each part with outlines, the arm included, by URDF link."""
        arm = {} if self.arm is None else {self.arm.link: self.arm.radius}
        return self.radius_along | arm

    @property
    def is_fixed_to_platform(self) -> bool:
        """Whether the leg does not turn relative to the platform."""
        return self.platform_joint is JointType.FIXED

    @property
    def is_platform_joint(self) -> bool:
        """Whether it is one joint that holds the platform on the base: U, or S.

        Its direction from A to B is a convention (:func:`with_platform_points`).
        """
        return self.is_fixed_to_platform and self.kind is LegKind.CONSTANT

    @property
    def inner_axis(self) -> Array | None:
        """The axis (3,) in the platform of a joint that holds it there, None for an S joint."""
        if self.twist is None or self.platform_axis is None or not self.is_platform_joint:
            return None
        e1, e2 = normal_basis(self.platform_axis)
        return np.asarray(math.cos(self.twist) * e1 - math.sin(self.twist) * e2)

    def length_at(self, reading: float) -> float:
        """Return the length |AB| at a reading, L = sign q + q0 [m]."""
        return self.sign * reading + self.q0

    def readings_at(self, lengths: Array) -> Array:
        """Return the readings at lengths |AB| (n,), q = sign (L - q0) [m]."""
        return np.asarray(self.sign * (lengths - self.q0))

    def in_travel(self, readings: Array) -> BoolArray:
        """Return which readings (n,) [m] are within the travel, with a margin of 5 % of it.

        Missing readings (NaN) are not; without limits, or with equal limits, all others are.
        """
        lower, upper = self.travel
        margin = TRAVEL_MARGIN * (upper - lower)
        if not 0.0 < margin < np.inf:
            return ~np.isnan(readings)
        return np.asarray((readings >= lower - margin) & (readings <= upper + margin))

    @property
    def equations(self) -> tuple[EquationKind, ...]:
        """The kinds of equations of this leg, in the order of their rows."""
        kinds = [EquationKind.LENGTH]
        if self.base_axis is not None:
            kinds += self.base_joint.at_base
        if self.platform_axis is not None:
            kinds += self.platform_joint.at_platform
        if self.twist is not None:
            kinds.append(EquationKind.TWIST)
        return tuple(kinds)

    @property
    def urdf_chain(self) -> LegChain:
        """Its joints in the URDF; ValueError for a leg without a file."""
        if self.chain is None:
            raise ValueError("a leg that no file describes has no joints in a URDF")
        return self.chain

    @property
    def idle_spins(self) -> int:
        """Number of freedoms in the URDF that only spin the leg about itself."""
        return 0 if self.chain is None else self.chain.idle_spins

    @property
    def n_constraints(self) -> int:
        """Number of equations that hold without a reading (or at that of the actuator of a rod)."""
        return len(self.equations) - (self.kind is not LegKind.CONSTANT)


def mean_length(legs: Sequence[Leg], pose: Array) -> float:
    """Return the mean length of legs at a pose (3, 4) [m]."""
    R, t = pose[:, :3], pose[:, 3]
    lengths = [
        leg.q0 if leg.actuator is not None else float(np.linalg.norm(R @ leg.B + t - leg.A))
        for leg in legs
    ]
    return float(np.mean(lengths))


def frame_point(legs: Sequence[Leg], frame_legs: Sequence[int], leg: int) -> Array:
    """Return the point (3,) [m] at which a frame leg fixed to the platform defines R_e.

    Nothing depends on the position of B along such a leg. Frames need a point that all models of
    one machine share: it is half the distance of the other two joints beyond the foot of their
    middle, so that the three span a plane even if the line meets the middle. With another leg of
    this kind it is the foot of the third joint.
    """
    u = legs[leg].platform_axis
    others = [legs[j].B for j in frame_legs if not legs[j].is_fixed_to_platform]
    if u is None or not others:
        return legs[leg].B
    middle = np.mean(others, axis=0)
    beyond = 0.5 * float(np.linalg.norm(others[0] - others[-1]))
    return np.asarray(legs[leg].B + ((middle - legs[leg].B) @ u + beyond) * u)


def with_platform_points(
    legs: Sequence[Leg], frame_legs: Sequence[int], origin: Array | None = None
) -> tuple[Leg, ...]:
    """Return legs with B at its conventional point on legs fixed to the platform.

    Nothing depends on the position of B along such a leg. A frame leg has B at its
    :func:`frame_point`, any other at the foot of the platform link origin, *origin* (3,) in the
    frame of the legs [m], if given.
    """
    moved = []
    if len(frame_legs) == 3:
        legs = redirected(legs, frame_legs)
    for j, leg in enumerate(legs):
        point = frame_point(legs, frame_legs, j) if j in frame_legs else origin
        if leg.is_fixed_to_platform and leg.platform_axis is not None and point is not None:
            along = float((point - leg.B) @ leg.platform_axis)
            leg = replace(
                leg,
                B=leg.B + along * leg.platform_axis,
                q0=leg.q0 + along,
                cylinders=tuple(
                    replace(c, start=c.start - along, end=c.end - along)
                    if c.side == "platform"
                    else c
                    for c in leg.cylinders
                ),
            )
        moved.append(leg)
    return tuple(moved)


def redirected(legs: Sequence[Leg], frame_legs: Sequence[int]) -> tuple[Leg, ...]:
    """Return legs; joints that hold the platform get their conventional directions.

    Such a direction is across the axis of the joint and the line of two other joints of the
    platform, or towards their middle, so that all models of one machine share it.
    """
    others = [legs[j].B for j in frame_legs if not legs[j].is_fixed_to_platform]
    return tuple(
        _redirected(leg, others) if leg.is_platform_joint and len(others) > 1 else leg
        for leg in legs
    )


def _redirected(held: Leg, others: Sequence[Array]) -> Leg:
    """Return a joint that holds the platform in its direction from other joints there (n, 3)."""
    if held.platform_axis is None:
        return held
    centre, inner = held.B - held.q0 * held.platform_axis, held.inner_axis
    line = others[1] - others[0]
    to_middle = np.mean(others, axis=0) - centre
    across = to_middle - (to_middle @ line) / (line @ line) * line
    if inner is not None:
        across = to_middle - (to_middle @ inner) * inner
        square = cross(inner, line)
        if float(square @ square) > float(across @ across):
            across = square if float(inner @ to_middle) >= 0.0 else -square
    size = float(np.linalg.norm(across))
    if size < 1e-6 * float(np.linalg.norm(line)):
        return held
    u = across / size  # whatever the sign of the inner axis is
    twist = held.twist
    if inner is not None:
        e1 = normal_basis(u)[0]
        angle = math.atan2(float(u @ cross(inner, e1)), float(inner @ e1))
        twist = angle - math.pi * math.ceil(angle / math.pi - 0.5 - 1e-10)
    return replace(held, B=centre + held.q0 * u, platform_axis=u, twist=twist)


def radius_name(leg_name: str, part: str) -> str:
    """Return the name of the radius of a cylinder of a leg."""
    return f"{leg_name}.radius.{part}"


# Names of parameters, and their parts: owner, kind, component.
JOINTS = ("base", "platform")  # kinds of joint coordinates at both ends of a leg
AXES = ("base_axis", "platform_axis")  # kinds of rotations of the axes there
ARMS = ("arm_axis", "arm_point")  # kinds of the line of an arm
_XYZ, _TWO = ("x", "y", "z"), ("1", "2")
_COMPONENTS = {
    **dict.fromkeys(JOINTS, _XYZ),
    **dict.fromkeys(AXES, (*_TWO, *_XYZ)),  # turns in R_b or R_e, and about the axes of a link
    **dict.fromkeys((*ARMS, "direction", "axis", "axis_point"), _TWO),
}
_RADIUS = ".radius."


@dataclass(frozen=True, slots=True)
class ParameterId:
    """A parameter, named ``<owner>.<kind>`` or ``<owner>.<kind>.<component>``.

    Attributes
    ----------
    owner : str
        The leg, motor or view; it may contain dots.
    kind : str
        ``base``, ``platform``, ``offset``, ``length``, ``base_axis``, ``platform_axis``,
        ``twist``, ``radius`` of legs; ``direction``, ``axis``, ``axis_point``, ``arm_axis``,
        ``arm_point``, ``gain`` of motors; ``fx``, ``k1``, ``gamma`` and others of cameras.
    component : str
        A coordinate (``x``), an angle (``1``), the link of a radius, or nothing.
    """

    owner: str
    kind: str
    component: str = ""

    @classmethod
    def parse(cls, name: str) -> ParameterId:
        """Return the parameter of a name; the owner is empty if the name has no dot."""
        head, _, component = name.rpartition(".")
        owner, _, kind = head.rpartition(".")
        if owner and component in _COMPONENTS.get(kind, ()):
            return cls(owner, kind, component)
        if _RADIUS in name:
            owner, _, link = name.partition(_RADIUS)
            return cls(owner, "radius", link)
        return cls(head, component)

    def __str__(self) -> str:
        return ".".join(part for part in (self.owner, self.kind, self.component) if part)

    @property
    def is_joint_coordinate(self) -> bool:
        """Whether it is a coordinate of a joint at an end of a leg."""
        return self.kind in JOINTS
