"""The numbers that a leg's equations contain, and what they are about.

They are free of frames: what belongs to the base stands in any frame of the base, what belongs
to the platform in any frame of the platform.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

import numpy as np

from legcal.geometry import Array, BoolArray


@dataclass(frozen=True, eq=False)
class KinematicParameters:
    """The parameters of a mechanism with point-like joints, in R_b and R_e.

    Attributes
    ----------
    base_joints : (n_legs, 3) array
        Base joint centres A in R_b [m].
    platform_joints : (n_legs, 3) array
        Platform joint centres B in R_e [m].
    offsets : (n_legs,) array
        q0 for actuated legs, the length for constant ones, NaN for passive ones [m].
    """

    base_joints: Array
    platform_joints: Array
    offsets: Array


def n_frame_legs(*, spatial: bool) -> int:
    """Return N_d, the number of legs whose joints define a frame."""
    return 3 if spatial else 2


def free_coordinates(n_legs: int, frame_legs: Sequence[int]) -> BoolArray:
    """Return which joint coordinates are parameters and not zero by the frame's definition.

    Two frame legs belong to a planar mechanism, whose heights z are no parameters.

    Parameters
    ----------
    n_legs : int
        Number of legs.
    frame_legs : sequence of 3 or 2 int
        The legs whose joint centres are origin, x axis and xy plane of the frame.

    Returns
    -------
    (n_legs, 3) array of bool
    """
    free = np.ones((n_legs, 3), dtype=np.bool_)
    free[:, 2] = len(frame_legs) == 3
    for rank, leg in enumerate(frame_legs):
        free[leg, rank:] = False
    return free


def parameter_names(leg_names: Sequence[str], frame_legs: Sequence[int]) -> tuple[str, ...]:
    """Return the parameter names, in the order of :func:`to_vector`."""
    free = free_coordinates(len(leg_names), frame_legs)
    joints = [
        f"{name}.{side}.{'xyz'[axis]}"
        for side in ("base", "platform")
        for leg, name in enumerate(leg_names)
        for axis in range(3)
        if free[leg, axis]
    ]
    return (*joints, *(f"{name}.offset" for name in leg_names))


def radius_name(leg_name: str, part: str) -> str:
    """Return the name of the radius of a cylinder of a leg."""
    return f"{leg_name}.radius.{part}"


def to_vector(parameters: KinematicParameters, frame_legs: Sequence[int]) -> Array:
    """Return the free parameters as one vector [m]: base joints, platform joints, offsets."""
    free = free_coordinates(len(parameters.offsets), frame_legs)
    return np.concatenate(
        [parameters.base_joints[free], parameters.platform_joints[free], parameters.offsets]
    )


def from_vector(vector: Array, n_legs: int, frame_legs: Sequence[int]) -> KinematicParameters:
    """Return the parameters of a vector laid out as in :func:`to_vector`."""
    free = free_coordinates(n_legs, frame_legs)
    n_free = int(free.sum())
    base, platform = np.zeros((n_legs, 3)), np.zeros((n_legs, 3))
    base[free] = vector[:n_free]
    platform[free] = vector[n_free : 2 * n_free]
    return KinematicParameters(base, platform, np.array(vector[2 * n_free :]))


JointLetter = Literal["R", "U", "S"]
PlatformLetter = Literal["R", "U", "S", ""]

SHORTEST, LONGEST = 1e-3, 20.0  # [m]; legs beyond are most likely written in another unit
THINNEST, THICKEST = 2e-4, 0.5  # radius of a leg in its length; beyond, its unit is the mistake
MOST_LEGS = 32  # the work of all that is done with them grows with the cube of their number


class LegKind(StrEnum):
    """What moves along a leg: a motor with an encoder, a free slider, or nothing."""

    ACTUATED = "actuated"
    PASSIVE = "passive"
    CONSTANT = "constant"


@dataclass(frozen=True)
class Cylinder:
    """A visible cylinder coaxial with its leg: a tube or a rod.

    Attributes
    ----------
    link : str
        The URDF link that carries the visual; it names the part in observations.
    radius : float
        Radius [m].
    side : {"base", "platform"}
        The half of the leg that the cylinder moves with. Positions along the leg are
        measured from A for ``base`` and from B for ``platform``, positive from A to B.
    start, end : float
        The ends along the leg axis [m], ``start < end``.
    """

    link: str
    radius: float
    side: Literal["base", "platform"]
    start: float
    end: float

    def span(self, length: float) -> tuple[float, float]:
        """Return both ends as distances from A along a leg of that length [m]."""
        shift = 0.0 if self.side == "base" else length
        return self.start + shift, self.end + shift


def main_cylinders(cylinders: Sequence[Cylinder]) -> dict[str, Cylinder]:
    """Return the cylinder that each link names as a part: its longest; the others hide pieces."""
    found: dict[str, Cylinder] = {}
    for cylinder in sorted(cylinders, key=lambda c: (c.end - c.start, c.radius)):
        found[cylinder.link] = cylinder
    return found


@dataclass(frozen=True, eq=False)
class Leg:
    """A leg from its base joint centre A to its platform joint centre B.

    Attributes
    ----------
    name : str
        The name in the mechanism file.
    base_joint : {"R", "U", "S"}
        Type of the joint at the base, found from the model.
    platform_joint : {"R", "U", "S", ""}
        Type of the joint at the platform; empty for a leg that is fixed to the platform (the
        centre leg of a Tricept). B of such a leg is the foot of the platform link's origin on
        the leg's axis.
    kind : LegKind
        Actuated, passive or constant length.
    prismatic : str or None
        The URDF prismatic joint; None for a constant-length leg.
    A_base : (3,) array
        Base joint centre in the base link [m].
    B_platform : (3,) array
        Platform joint centre in the platform link [m].
    q0 : float
        Leg length at reading zero [m]: L = sign * q + q0. The length of a constant leg.
    sign : int
        +1 where the leg grows with the joint value, -1 where it shrinks.
    travel : tuple of float
        Lower and upper joint limit [m]; (0, 0) for a constant-length leg.
    cylinders : tuple of Cylinder
        What a camera can see of the leg.
    base_axis, platform_axis : (3,) array or None
        Unit axis in the base or platform link, only for joints whose axis is a parameter: R,
        and the outer axis of U in a leg without an S joint; none in planar mechanisms. The last
        component that is not zero is positive: an axis is a line. The platform axis of a leg
        that is fixed to the platform is its direction from A to B.
    twist : float or None
        Angle about u from the inner axis at the base to the inner one at the platform [rad],
        in (-pi/2, pi/2], which the leg keeps constant; only for legs without an S joint in
        space. See :mod:`legcal.machine.equations`.
    """

    name: str
    base_joint: JointLetter
    platform_joint: PlatformLetter
    kind: LegKind
    prismatic: str | None
    A_base: Array
    B_platform: Array
    q0: float
    sign: int
    travel: tuple[float, float]
    cylinders: tuple[Cylinder, ...]
    base_axis: Array | None = None
    platform_axis: Array | None = None
    twist: float | None = None

    @property
    def radius_of_part(self) -> dict[str, float]:
        """Radius [m] of each part that outlines are found of, by its URDF link."""
        return {link: c.radius for link, c in main_cylinders(self.cylinders).items()}

    @property
    def type(self) -> str:
        """The leg's joints from base to platform, such as ``SPU``; ``UP`` if fixed there."""
        slider = "" if self.kind is LegKind.CONSTANT else "P"
        return f"{self.base_joint}{slider}{self.platform_joint}"


N_LOCAL = 12  # A, B, length, base axis 1 and 2, platform axis 1 and 2, twist


class Demand(StrEnum):
    """What an equation of a leg is about."""

    LENGTH = "length"
    BASE_AXIS = "base axis"
    PLATFORM_AXIS = "platform axis"
    ALONG_1 = "direction in the platform, first angle"
    ALONG_2 = "direction in the platform, second angle"
    TWIST = "twist"


@dataclass(frozen=True, eq=False)
class LegGeometry:
    """The numbers that a leg's equations contain.

    Attributes
    ----------
    base_joint, platform_joint : str
        The letters of :class:`legcal.machine.leg.Leg`.
    kind : LegKind
        Whether the length is measured, free or constant.
    A, B : (3,) array
        Joint centres in the frames of base and platform [m].
    q0 : float
        Length at reading zero [m]; that of a constant leg.
    base_axis, platform_axis : (3,) array or None
        Unit axes in the frames of base and platform.
    twist : float or None
        Angle that the leg keeps [rad].
    """

    base_joint: JointLetter
    platform_joint: PlatformLetter
    kind: LegKind
    A: Array
    B: Array
    q0: float
    base_axis: Array | None = None
    platform_axis: Array | None = None
    twist: float | None = None

    @property
    def demands(self) -> tuple[Demand, ...]:
        """The equations of this leg, in the order in which they are linearised."""
        found = [Demand.LENGTH]
        if self.base_joint == "R" and self.base_axis is not None:
            found.append(Demand.BASE_AXIS)
        if self.platform_joint == "R" and self.platform_axis is not None:
            found.append(Demand.PLATFORM_AXIS)
        if self.platform_joint == "":
            found += [Demand.ALONG_1, Demand.ALONG_2]
        if self.twist is not None:
            found.append(Demand.TWIST)
        return tuple(found)


def geometry_of(leg: Leg) -> LegGeometry:
    """Return the geometry of a leg in the links of base and platform."""
    return LegGeometry(
        leg.base_joint,
        leg.platform_joint,
        leg.kind,
        leg.A_base,
        leg.B_platform,
        leg.q0,
        leg.base_axis,
        leg.platform_axis,
        leg.twist,
    )


def point_like_legs(parameters: KinematicParameters) -> tuple[LegGeometry, ...]:
    """Return actuated legs with point-like joints; those without an offset are passive."""
    kinds = [LegKind.PASSIVE if np.isnan(q0) else LegKind.ACTUATED for q0 in parameters.offsets]
    joints = zip(parameters.base_joints, parameters.platform_joints, strict=True)
    return tuple(
        LegGeometry("S", "S", kind, A, B, float(q0))
        for (A, B), kind, q0 in zip(joints, kinds, parameters.offsets, strict=True)
    )
