"""The numbers that a leg's equations contain, and what they are about.

They are free of frames: what belongs to the base stands in any frame of the base, what belongs
to the platform in any frame of the platform.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from legcal.geometry.types import Array
from legcal.mechanism.leg import JointLetter, Leg, LegKind, PlatformLetter
from legcal.mechanism.parameters import KinematicParameters

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
        The letters of :class:`legcal.mechanism.leg.Leg`.
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
