"""Errors by which a true machine differs from its nominal model (section 4.3)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Distribution(StrEnum):
    """How errors of one kind are distributed, about zero."""

    UNIFORM = "uniform"
    NORMAL = "normal"


@dataclass(frozen=True)
class Spread:
    """How large the errors of one kind of parameter are.

    Attributes
    ----------
    size : float
        Half of the width where they are uniform, one standard deviation where they are normal
        [m] or [rad].
    distribution : Distribution
        How they are distributed.
    """

    size: float = 0.0
    distribution: Distribution = Distribution.UNIFORM


@dataclass(frozen=True)
class ParameterErrors:
    """How large the errors of each kind of parameter are.

    Attributes
    ----------
    base_joints, platform_joints : Spread
        Of every coordinate of the joint centres [m].
    offsets : Spread
        Of actuated legs [m].
    lengths : Spread
        Of legs of constant length [m].
    axes : Spread
        Of both angles of axes at base and platform [rad].
    twists : Spread
        Of the angles that legs without an S joint keep [rad].
    coplanar : bool
        Whether joint centres stay in the plane that they are nominally in.
    """

    base_joints: Spread = Spread()
    platform_joints: Spread = Spread()
    offsets: Spread = Spread()
    lengths: Spread = Spread()
    axes: Spread = Spread()
    twists: Spread = Spread()
    coplanar: bool = False
