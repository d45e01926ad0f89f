"""What the fit has to know of a mechanism: its legs, their frames and their radii."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import IntArray
from legcal.mechanism.leg import Leg
from legcal.mechanism.parameters import parameter_names


@dataclass(frozen=True, eq=False)
class FittedLegs:
    """The legs of a mechanism as the fit sees them.

    Attributes
    ----------
    names : tuple of str
        Leg names in the mechanism's order.
    sign : (n_legs,) array of int
        +1 where the leg grows with the reading, -1 where it shrinks: L = sign q + q0.
    frame_legs : tuple of int
        The legs whose joint centres define R_b and R_e.
    radii : dict
        Radius of the model [m] for each (leg index, part).
    """

    names: tuple[str, ...]
    sign: IntArray
    frame_legs: tuple[int, ...]
    radii: dict[tuple[int, str], float]

    @property
    def n_legs(self) -> int:
        """Number of legs."""
        return len(self.names)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the kinematic parameters in the order of ``parameters.to_vector``."""
        return parameter_names(self.names, self.frame_legs)


def fitted_legs(legs: Sequence[Leg], frame_legs: Sequence[int]) -> FittedLegs:
    """Return the fit's view of the legs of a mechanism.

    Parameters
    ----------
    legs : sequence of Leg
        ``mechanism.legs``.
    frame_legs : sequence of 3 int
        ``mechanism.frame_legs``.

    Returns
    -------
    FittedLegs
    """
    return FittedLegs(
        tuple(leg.name for leg in legs),
        np.array([leg.sign for leg in legs], dtype=np.intp),
        tuple(frame_legs),
        {(i, part): r for i, leg in enumerate(legs) for part, r in leg.radius_of_part.items()},
    )
