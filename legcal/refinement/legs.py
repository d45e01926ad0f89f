"""What the fit has to know of a mechanism: its legs, their frames and their radii."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.model import Mechanism
from legcal.mechanism.parametrization import Parametrization, geometries, parametrize, vector_of


@dataclass(frozen=True, eq=False)
class FittedLegs:
    """The legs of a mechanism as the fit sees them.

    Attributes
    ----------
    names : tuple of str
        Leg names in the mechanism's order.
    nominal : tuple of LegGeometry
        The nominal legs in R_b and R_e: what the axes count from, and what stays as it is where it
        is fixed or held.
    sign : (n_legs,) array of int
        +1 where the leg grows with the reading, -1 where it shrinks: L = sign q + q0.
    frame_legs : tuple of int
        The legs whose joint centres define R_b and R_e: three in space, two in a plane.
    radii : dict
        Radius of the model [m] for each (leg index, part).
    """

    names: tuple[str, ...]
    nominal: tuple[LegGeometry, ...]
    sign: IntArray
    frame_legs: tuple[int, ...]
    radii: dict[tuple[int, str], float]

    @property
    def n_legs(self) -> int:
        """Number of legs."""
        return len(self.names)

    @property
    def spatial(self) -> bool:
        """Whether the platform moves in space and not in a plane."""
        return len(self.frame_legs) == 3

    @cached_property
    def parametrization(self) -> Parametrization:
        """The kinematic parameters, twists among them."""
        return parametrize(self.names, self.nominal, self.frame_legs, twists=True)

    def vector(self, legs: tuple[LegGeometry, ...]) -> Array:
        """Return the kinematic parameters of legs [m, rad]; axes count from the nominal ones."""
        return vector_of(self.parametrization, legs, self.nominal)


def fitted_legs(mechanism: Mechanism) -> FittedLegs:
    """Return the fit's view of the legs of a mechanism."""
    return FittedLegs(
        tuple(leg.name for leg in mechanism.legs),
        geometries(mechanism),
        np.array([leg.sign for leg in mechanism.legs], dtype=np.intp),
        tuple(mechanism.frame_legs),
        {
            (i, part): r
            for i, leg in enumerate(mechanism.legs)
            for part, r in leg.radius_of_part.items()
        },
    )
