"""Errors by which a true machine differs from its nominal model (section 4.3).

They are errors of the parameters: R_b and R_e stay where they are, and what their definition makes
zero stays zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from numbers import Real

import numpy as np

from legcal.errors import UsageError
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.leg_steps import footed, moved_legs
from legcal.mechanism.model import Mechanism
from legcal.mechanism.parametrization import geometries, parametrization_of

LARGEST = 1.0  # [m] or [rad]
ANGLES = ("axes", "twists")


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

    Raises
    ------
    UsageError
        If the size is no number, or there is no such distribution.
    """

    size: float = 0.0
    distribution: Distribution = Distribution.UNIFORM

    def __post_init__(self) -> None:
        if not isinstance(self.size, Real) or self.distribution not in list(Distribution):
            raise UsageError(
                f"A spread could not be used: found the size {self.size!r} and the distribution "
                f"{self.distribution!r}, needed a number [m, rad] and "
                f"{' or '.join(Distribution)}; correct it."
            )
        object.__setattr__(self, "size", float(self.size))
        object.__setattr__(self, "distribution", Distribution(self.distribution))


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
    radii : Spread
        Of the cylinders that legs are seen as [m]; no parameter of the kinematics.
    coplanar : bool
        Whether joint centres keep their heights, their z in R_b and R_e: what is coplanar stays so.
    """

    base_joints: Spread = Spread()
    platform_joints: Spread = Spread()
    offsets: Spread = Spread()
    lengths: Spread = Spread()
    axes: Spread = Spread()
    twists: Spread = Spread()
    radii: Spread = Spread()
    coplanar: bool = False


_FIELDS = {
    "base": "base_joints",
    "platform": "platform_joints",
    "offset": "offsets",
    "length": "lengths",
    "base_axis": "axes",
    "platform_axis": "axes",
    "twist": "twists",
}


KINDS = (*dict.fromkeys(_FIELDS.values()), "radii")  # the fields that are sizes


def kinds_of(mechanism: Mechanism) -> set[str]:
    """Return the kinds of errors, fields of :class:`ParameterErrors`, that a machine can have."""
    names = parametrization_of(mechanism, twists=True).names
    kinds = {_FIELDS[name.split(".")[1]] for name in names}
    return kinds | ({"radii"} if any(leg.cylinders for leg in mechanism.legs) else set())


def draw_errors(
    nominal: Mechanism, errors: ParameterErrors, rng: np.random.Generator
) -> tuple[LegGeometry, ...]:
    """Return the legs of a machine with drawn errors, in R_b and R_e.

    Every parameter of the class takes its chance in the same order, however large its error is:
    errors of one kind do not depend on those of another. B of a leg that is fixed to the platform
    then slides along the leg to where models put it, the foot of the platform link's origin.

    Parameters
    ----------
    nominal : Mechanism
        The nominal model.
    errors : ParameterErrors
        How large the errors are.
    rng : numpy.random.Generator
        Source of the errors.

    Raises
    ------
    UsageError
        If an error is negative, not finite or beyond reason.
    """
    _check(errors)
    found, legs = parametrization_of(nominal, twists=True), geometries(nominal)
    uniform, normal = rng.uniform(-1.0, 1.0, len(found)), rng.normal(size=len(found))
    step = np.zeros(len(found))
    for i, name in enumerate(found.names):
        spread = _spread(errors, name)
        unit = normal if spread.distribution is Distribution.NORMAL else uniform
        step[i] = spread.size * unit[i]
    moved = moved_legs(legs, found.place, step)
    origin = np.asarray(nominal.T_platform_Re.inv().translation)
    return footed(moved, origin)


def _spread(errors: ParameterErrors, name: str) -> Spread:
    """Return how large the error of a parameter is, by its name."""
    _, kind, *more = name.split(".")
    if errors.coplanar and kind in ("base", "platform") and more == ["z"]:
        return Spread()
    found: Spread = getattr(errors, _FIELDS[kind])
    return found


def _check(errors: ParameterErrors) -> None:
    """Refuse sizes that are no sizes."""
    problems = []
    for kind in KINDS:
        size = getattr(errors, kind).size
        if not (math.isfinite(size) and 0.0 <= size <= LARGEST):
            scale, unit = (np.rad2deg(1.0), "deg") if kind in ANGLES else (1e3, "mm")
            problems.append(
                f"The errors of {kind.replace('_', ' ')} could not be drawn: found a size of "
                f"{scale * size:g} {unit}, needed 0 to {scale * LARGEST:.3g} {unit}; correct it."
            )
    if problems:
        raise UsageError(problems)
