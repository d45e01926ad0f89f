"""How much the claimed covariances of outlines can be trusted, estimated from the residuals.

The covariance that enters the fit is ``scale^2 C + bias^2 [[1, 1], [1, 1]] + tilt^2 [[1, -1],
[-1, 1]]``: C is what detection claims, the bias is an error that both ends of an outline share
(shading, blur), the tilt one that has opposite signs there. What outlines share with others
is not among these (they are blocks of variables).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from legcal.geometry import Array, BoolArray

_SUM = np.array([1.0, 1.0])
_DIFFERENCE = np.array([-1.0, 1.0])
_MEDIAN_OF_1 = 0.454936423119573  # of the square of a unit Gaussian
MEDIAN_OF_2 = 2.0 * np.log(2.0)  # of the squared norm of two unit Gaussians
_SMALLEST_SCALE = 0.1
_LEAST_GAIN = 12.0  # twice the log-likelihood: of white offsets, one set in 4,000 gains that much
_MAX_STEPS = 100
_SETTLED = 1e-9
_ALIKE = 1e-10  # of the largest singular value: kinds of noise that cannot be told apart


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

    Wrong outlines, as long as they are fewer than half, hardly matter. The difference of the
    offsets at both ends does not feel the bias and their sum does not feel the tilt: the smaller of
    what these two say is the scale, and the excess of the other is bias or tilt.

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
        return float(np.median(noise.squared_norms(offsets, claimed)) - MEDIAN_OF_2)

    return _balanced(scale_of(_SUM), scale_of(_DIFFERENCE), excess, offsets)


def estimate_noise(offsets: Array, explained: Array, claimed: Array) -> NoiseModel:
    """Return the noise of outlines by restricted maximum likelihood.

    Bias and tilt of single outlines are there only if the offsets show them.

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
    best = _fitted(moments, claimed, bias=False, tilt=False)
    for _ in range(2):
        wider = [
            _fitted(moments, claimed, bias=bias, tilt=tilt)
            for bias, tilt in ((True, best.tilt_px > 0.0), (best.bias_px > 0.0, True))
        ]
        gains = [_likelihood(noise, moments, claimed) for noise in wider]
        gain = 2.0 * (max(gains) - _likelihood(best, moments, claimed))
        if gain <= _LEAST_GAIN:
            break
        best = wider[int(np.argmax(gains))]
    return best


def _fitted(moments: Array, claimed: Array, *, bias: bool, tilt: bool) -> NoiseModel:
    """Return the noise of these kinds with the largest likelihood, by Fisher's scoring."""
    shapes = [claimed]
    if bias:
        shapes.append(np.broadcast_to(np.outer(_SUM, _SUM), claimed.shape))
    if tilt:
        shapes.append(np.broadcast_to(np.outer(_DIFFERENCE, _DIFFERENCE), claimed.shape))
    share = np.trace(np.linalg.solve(claimed, moments), axis1=1, axis2=2)
    variances = np.zeros(len(shapes))
    variances[0] = max(0.5 * float(np.mean(share)), _SMALLEST_SCALE**2)
    least = np.array([_SMALLEST_SCALE**2, 0.0, 0.0])[: len(shapes)]
    for _ in range(_MAX_STEPS):
        covariance = sum(v * shape for v, shape in zip(variances, shapes, strict=True))
        inverse = np.linalg.inv(covariance)
        weighted = [inverse @ shape for shape in shapes]
        weighted_moments = inverse @ moments
        information = np.array([[_product(a, b) for b in weighted] for a in weighted])
        right = np.array([_product(a, weighted_moments) for a in weighted])
        found = np.linalg.lstsq(information, right, rcond=_ALIKE)[0]
        before, variances = variances, np.maximum(found, least)
        if np.allclose(variances, before, rtol=_SETTLED, atol=_SETTLED * variances[0]):
            break
    sigma = np.sqrt(variances).tolist()
    return NoiseModel(sigma[0], sigma[1] if bias else 0.0, sigma[-1] if tilt else 0.0)


def _product(a: Array, b: Array) -> float:
    """Return the sum of the traces of the products of matrices (n, 2, 2)."""
    return float(np.einsum("nij,nji->", a, b))


def _likelihood(noise: NoiseModel, moments: Array, claimed: Array) -> float:
    """Return the logarithm of the likelihood of second moments (n, 2, 2) [px^2]."""
    covariance = noise.covariance(claimed)
    shares = np.trace(np.linalg.solve(covariance, moments), axis1=1, axis2=2)
    return -0.5 * float(np.sum(np.log(np.linalg.det(covariance)) + shares))


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
