"""A leg: the joint at its base, a slider or a rod, the joint at its platform, and its numbers.

What belongs to the base stands in a frame of the base, what belongs to the platform in a frame of
the platform: the links for the legs of a :class:`~legcal.machine.model.Machine`, the joint
frames R_b and R_e for :func:`legcal.machine.parameters.geometries`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

import numpy as np

from legcal.geometry import Array

JointLetter = Literal["R", "U", "S"]
PlatformLetter = Literal["R", "U", "S", ""]

SHORTEST, LONGEST = 1e-3, 20.0  # [m]; legs beyond are most likely written in another unit
THINNEST, THICKEST = 2e-4, 0.5  # radius of a leg in its length; beyond, its unit is the mistake
MOST_LEGS = 32  # the work of all that is done with them grows with the cube of their number
N_LOCAL = 12  # numbers of a leg: A, B, length, base axis 1 and 2, platform axis 1 and 2, twist


class LegKind(StrEnum):
    """What moves along a leg: a motor with an encoder, a free slider, or nothing."""

    ACTUATED = "actuated"
    PASSIVE = "passive"
    CONSTANT = "constant"


class Demand(StrEnum):
    """What an equation of a leg is about."""

    LENGTH = "length"
    BASE_AXIS = "base axis"
    PLATFORM_AXIS = "platform axis"
    ALONG_1 = "direction in the platform, first angle"
    ALONG_2 = "direction in the platform, second angle"
    TWIST = "twist"
    PLANE = "plane of motion"  # of the platform of a planar machine, and of no leg


@dataclass(frozen=True)
class Cylinder:
    """A visible cylinder coaxial with its leg: a tube or a rod."""

    link: str  # the URDF link that carries the visual; it names the part in observations
    radius: float  # [m]
    side: Literal["base", "platform"]  # the half of the leg that it moves with
    start: float  # ends along the leg [m], start < end: from A for base, from B for platform,
    end: float  # positive from A to B

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

    Axes are lines, given for joints whose axis is a parameter: R, and the outer axis of U in a leg
    without an S joint; none in planar machines. A leg that is fixed to the platform (the centre
    leg of a Tricept) has the platform joint "", its direction from A to B as platform axis, and B
    at the foot of the platform link's origin. The twist is the angle about u from the inner axis at
    the base to the inner one at the platform, which a leg without an S joint keeps.
    """

    base_joint: JointLetter
    platform_joint: PlatformLetter
    kind: LegKind
    A: Array  # (3,) base joint centre [m]
    B: Array  # (3,) platform joint centre [m]
    q0: float  # length at reading zero [m], L = sign q + q0; the length of a constant leg
    base_axis: Array | None = None  # (3,) unit axis; in links its last nonzero component is > 0
    platform_axis: Array | None = None  # (3,)
    twist: float | None = None  # [rad], in (-pi/2, pi/2]
    name: str = ""
    prismatic: str | None = None  # the URDF joint of the slider
    sign: int = 1  # -1 where the leg shrinks with the joint value
    travel: tuple[float, float] = (0.0, 0.0)  # joint limits of the slider [m]
    cylinders: tuple[Cylinder, ...] = ()  # what a camera can see of it

    @property
    def type(self) -> str:
        """The leg's joints from base to platform, such as ``SPU``; ``UP`` if fixed there."""
        slider = "" if self.kind is LegKind.CONSTANT else "P"
        return f"{self.base_joint}{slider}{self.platform_joint}"

    @property
    def radius_of_part(self) -> dict[str, float]:
        """Radius [m] of each part that outlines are found of, by its URDF link."""
        return {link: c.radius for link, c in main_cylinders(self.cylinders).items()}

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


@dataclass(frozen=True, eq=False)
class KinematicParameters:
    """Joint centres in R_b and R_e and lengths of legs: all parameters if joints are point-like."""

    base_joints: Array  # (n_legs, 3) A in R_b [m]
    platform_joints: Array  # (n_legs, 3) B in R_e [m]
    offsets: Array  # (n_legs,) q0 of actuated legs, length of constant ones, NaN of passive ones


def point_like_legs(parameters: KinematicParameters) -> tuple[Leg, ...]:
    """Return actuated legs with point-like joints; those without an offset are passive."""
    kinds = [LegKind.PASSIVE if np.isnan(q0) else LegKind.ACTUATED for q0 in parameters.offsets]
    joints = zip(parameters.base_joints, parameters.platform_joints, strict=True)
    return tuple(
        Leg("S", "S", kind, A, B, float(q0))
        for (A, B), kind, q0 in zip(joints, kinds, parameters.offsets, strict=True)
    )


def radius_name(leg_name: str, part: str) -> str:
    """Return the name of the radius of a cylinder of a leg."""
    return f"{leg_name}.radius.{part}"
