"""How much the claimed covariances of outlines can be trusted, estimated from the residuals.

The covariance that enters the fit is ``scale^2 C + bias^2 [[1, 1], [1, 1]] + tilt^2 [[1, -1],
[-1, 1]]``: C is what detection claims, the bias is an error that both ends of an outline share
(shading, blur), the tilt one that has opposite signs there. The difference of the offsets at both
ends does not feel the bias and their sum does not feel the tilt: the smaller of what
these two say is the scale, and the excess of the other is bias or tilt.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from legcal.geometry.types import Array, BoolArray

_SUM = np.array([1.0, 1.0])
_DIFFERENCE = np.array([-1.0, 1.0])
_MEDIAN_OF_1 = 0.454936423119573  # of the square of a unit Gaussian
_MEDIAN_OF_2 = 2.0 * np.log(2.0)  # of the squared norm of two
_SMALLEST_SCALE = 0.1


@dataclass(frozen=True)
class NoiseModel:
    """Errors of outlines.

    Attributes
    ----------
    scale : float
        Factor on the claimed standard deviations.
    bias_px : float
        Standard deviation of the error that is common to both ends of an outline [px].
    tilt_px : float
        Standard deviation of the error that is opposite at both ends [px].
    """

    scale: float = 1.0
    bias_px: float = 0.0
    tilt_px: float = 0.0

    def covariance(self, claimed: Array) -> Array:
        """Return the covariances (n, 2, 2) [px^2] that claimed ones stand for."""
        added = self.bias_px**2 * np.outer(_SUM, _SUM)
        added = added + self.tilt_px**2 * np.outer(_DIFFERENCE, _DIFFERENCE)
        return np.asarray(self.scale**2 * claimed + added)

    def whitening(self, claimed: Array, used: BoolArray | None = None) -> Array:
        """Return lower triangular T (n, 2, 2) with T C T^T = 1 [1/px]; zero where not used."""
        T = np.linalg.inv(np.linalg.cholesky(self.covariance(claimed)))
        return np.asarray(T if used is None else np.where(used[:, None, None], T, 0.0))

    def squared_norms(self, offsets: Array, claimed: Array) -> Array:
        """Return the squared whitened norms (n,) of offsets (n, 2) [px]."""
        whitened = np.einsum("nij,nj->ni", self.whitening(claimed), offsets)
        return np.asarray(np.sum(whitened**2, axis=-1))


def noise_of_the_median(offsets: Array, claimed: Array) -> NoiseModel:
    """Return the noise at which the median outline is as far off as it should be.

    Wrong outlines, as long as they are fewer than half, hardly matter.

    Parameters
    ----------
    offsets : (n, 2) array
        Offsets at both ends [px].
    claimed : (n, 2, 2) array
        Claimed covariances [px^2].

    Returns
    -------
    NoiseModel
    """

    def scale_of(mode: Array) -> float:
        share = (offsets @ mode) ** 2 / np.einsum("i,nij,j->n", mode, claimed, mode)
        return float(np.sqrt(np.median(share) / _MEDIAN_OF_1))

    def excess(noise: NoiseModel) -> float:
        return float(np.median(noise.squared_norms(offsets, claimed)) - _MEDIAN_OF_2)

    return _balanced(scale_of(_SUM), scale_of(_DIFFERENCE), excess, offsets)


def estimate_noise(offsets: Array, explained: Array, claimed: Array) -> NoiseModel:
    """Return the noise at which outlines have the chi-square that they should have.

    Parameters
    ----------
    offsets : (n, 2) array
        Offsets of the accepted outlines at both ends [px].
    explained : (n, 2, 2) array
        Covariance of the predicted offsets [px^2]: what the fit has taken up of the errors.
    claimed : (n, 2, 2) array
        Claimed covariances [px^2].

    Returns
    -------
    NoiseModel
    """
    moments = offsets[:, :, None] * offsets[:, None, :] + explained

    def scale_of(mode: Array) -> float:
        measured, expected = (np.einsum("i,nij,j->n", mode, M, mode) for M in (moments, claimed))
        return float(np.sqrt(np.mean(measured / expected)))

    def excess(noise: NoiseModel) -> float:
        shares = np.linalg.solve(noise.covariance(claimed), moments)
        return float(np.mean(np.trace(shares, axis1=1, axis2=2))) - 2.0

    return _balanced(scale_of(_SUM), scale_of(_DIFFERENCE), excess, offsets)


def _balanced(
    of_sums: float, of_differences: float, excess: Callable[[NoiseModel], float], offsets: Array
) -> NoiseModel:
    """Return the scale of the better mode, and the excess of the other as bias or tilt."""
    if of_differences <= of_sums:
        scale = max(of_differences, _SMALLEST_SCALE)
        return NoiseModel(scale, _root(lambda px: excess(NoiseModel(scale, px)), offsets))
    scale = max(of_sums, _SMALLEST_SCALE)
    return NoiseModel(scale, 0.0, _root(lambda px: excess(NoiseModel(scale, 0.0, px)), offsets))


def _root(excess: Callable[[float], float], offsets: Array) -> float:
    """Return where a falling function of an added error crosses zero, 0 if it starts below."""
    if excess(0.0) <= 0.0:
        return 0.0
    largest = 2.0 * float(np.abs(offsets).max())
    while excess(largest) > 0.0:
        largest *= 2.0
    return float(brentq(excess, 0.0, largest, xtol=1e-12, rtol=1e-14))
