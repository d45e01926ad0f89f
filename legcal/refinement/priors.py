"""The unknowns that have names, and what is known of them beforehand.

Named are kinematic parameters, radii, biases, intrinsics and the size of the calibration board;
they stand first in x. Their values
are what a user means by their names: an axis is two angles from the nominal one, whereas its
unknowns are turns of where it is now.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.mechanism.parametrization import tied_twist_slope, turn_slope
from legcal.refinement.layout import Layout
from legcal.refinement.legs import FittedLegs
from legcal.refinement.residuals import prior_residual
from legcal.refinement.state import State, intrinsic_of

_BASE_AXIS, _PLATFORM_AXIS, _TWIST = slice(7, 9), slice(9, 11), 11  # among the numbers of a leg
_ANGLES = slice(7, 12)


@dataclass(frozen=True, eq=False)
class Priors:
    """Gaussian priors on single named unknowns.

    Attributes
    ----------
    layout : Layout
    position : (n,) array of int
        Positions in x.
    mean, sigma : (n,) array
        Means and standard deviations [m, rad, px].
    """

    layout: Layout
    position: IntArray
    mean: Array
    sigma: Array

    def __len__(self) -> int:
        return len(self.position)

    def linearize(self, state: State, legs: FittedLegs) -> tuple[Array, Array]:
        """Return whitened residuals (n,) and derivatives (n, n_kept) of all priors."""
        value = named_values(state, self.layout, legs)[self.position]
        data = np.column_stack([self.mean, 1.0 / self.sigma])
        r, slope = prior_residual().evaluate(value[:, None], data)
        J = np.zeros((len(self), self.layout.n_kept))
        if len(self):
            by_x = np.eye(self.layout.n_named)
            if np.isin(self.position, self.layout.place[:, _ANGLES]).any():
                by_x = named_jacobian(state, self.layout, legs)
            J[:, : len(by_x)] = slope[:, 0] * by_x[self.position]
        return r[:, 0], J


def named_values(state: State, layout: Layout, legs: FittedLegs) -> Array:
    """Return the values of the named unknowns, (n_named,), in the order of x."""
    kinematic = legs.vector(state.legs)[layout.kinematic < layout.size]
    radii = state.radii[layout.radius < layout.size]
    scale = state.board_scale[layout.board_scale < layout.size]
    return np.concatenate([kinematic, radii, state.biases, _intrinsics(state, layout), scale])


@lru_cache(maxsize=2)  # several ask for it at one state
def named_jacobian(state: State, layout: Layout, legs: FittedLegs) -> Array:
    """Return the derivative (n_named, n_named) of the values of named unknowns by x.

    It is one but for axes.
    """
    J = np.eye(layout.n_named)
    free = layout.kinematic < layout.size
    for leg, nominal, place, number in zip(
        state.legs, legs.nominal, layout.place, legs.parametrization.place, strict=True
    ):
        both = (leg.base_axis, nominal.base_axis), (leg.platform_axis, nominal.platform_axis)
        for columns, axes in zip((_BASE_AXIS, _PLATFORM_AXIS), both, strict=True):
            if np.all(place[columns] >= layout.size):
                continue
            by = np.zeros((len(free), 2))
            by[number[columns]] = turn_slope(*axes)
            if columns is _PLATFORM_AXIS and number[_TWIST] >= 0:
                by[number[_TWIST]] = -tied_twist_slope(leg, nominal)
            for x, column in zip(place[columns], by.T, strict=True):
                if x < layout.size:
                    J[: layout.n_kinematic, x] = column[free]
    J.flags.writeable = False
    return J


def _intrinsics(state: State, layout: Layout) -> Array:
    """Return the values of the intrinsics that are unknowns, in their order."""
    positions, first = np.unique(layout.intrinsic, return_index=True)
    n_keys = max(len(layout.intrinsic_keys), 1)
    return np.array(
        [
            intrinsic_of(state.cameras[place // n_keys], layout.intrinsic_keys[place % n_keys])
            for position, place in zip(positions.tolist(), first.tolist(), strict=True)
            if position < layout.size
        ]
    )
