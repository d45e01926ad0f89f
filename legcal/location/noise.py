"""How precise the measured tool poses are, and what else moves them.

The errors of a row are those of the measurement, the same in all directions: one standard
deviation for positions and one for orientations, times a factor that may be unknown; and those of
the readings, which move position and orientation together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from legcal.geometry.types import Array, BoolArray, IntArray

SMALLEST = 1e-9  # [m, rad]; nobody measures better, and files round


@dataclass(frozen=True, eq=False)
class Noise:
    """Standard deviations of the rows.

    Attributes
    ----------
    sigma : (n, 2) array
        Of position [m] and orientation [rad] of each row, up to ``factor``.
    factor : (2,) array
        What all of a kind are multiplied with.
    stated : tuple of bool
        Whether the standard deviations of positions and of orientations were stated; the factor
        of those that were not is estimated.
    readings : (n, 6, 6) array or None
        Covariance of the tool pose by errors of the readings [m, rad]; None without any.
    """

    sigma: Array
    factor: Array
    stated: tuple[bool, bool]
    readings: Array | None = None

    def of(self, rows: BoolArray | IntArray) -> Noise:
        """Return that of some rows."""
        readings = None if self.readings is None else self.readings[rows]
        return replace(self, sigma=self.sigma[rows], readings=readings)

    def scaled(self, factor: Array) -> Noise:
        """Return the same with other factors."""
        return replace(self, factor=factor)

    @property
    def floor(self) -> Array:
        """The smallest factor of each kind that can be meant."""
        return np.asarray(SMALLEST / self.sigma.min(axis=0))

    def standard_deviations(self) -> Array:
        """Return those of each row and component without the readings', (n, 6) [m, rad]."""
        return np.repeat(self.sigma * self.factor, 3, axis=1)

    def whitening(self, oriented: BoolArray) -> Array:
        """Return matrices W (n, 6, 6) with W^T W the inverse covariance; zero where unmeasured."""
        sigma = self.standard_deviations()
        if self.readings is None:
            W = np.zeros((*sigma.shape, 6))
            W[:, range(6), range(6)] = 1.0 / sigma
        else:
            S = self.readings.copy()
            S[~oriented, 3:, :3] = S[~oriented, :3, 3:] = 0.0
            S[:, range(6), range(6)] += sigma**2
            W = np.linalg.inv(np.linalg.cholesky(S))
        W[~oriented, 3:] = 0.0
        return np.asarray(W)
