"""The robust loss.

With s the squared norm of a whitened residual the cost is s / (1 + sqrt(1 + k s)), the
pseudo-Huber loss of width k^-1/2: s / 2 for small s, linear in the distance far out, convex, and
plain least squares for k = 0. No residual, however wrong, pulls with more than that width.
"""

from functools import cache
from math import gamma

import numpy as np

from legcal.geometry import Array


def width_to_k(width: float) -> float:
    """Return k of a loss that turns linear at a whitened distance; 0 for an infinite one."""
    return 1.0 / (width * width)


def weights(s: Array, k: float) -> Array:
    """Return the weights of iterated least squares at squared whitened norms."""
    return np.asarray(1.0 / np.sqrt(1.0 + k * s))


def cost_of(s: Array, k: float) -> float:
    """Return the loss of all measurements at squared whitened norms."""
    return float(np.sum(s / (1.0 + np.sqrt(1.0 + k * s))))


@cache
def efficiency(k: float, m: int = 2) -> float:
    """Return the information that the loss keeps of m Gaussian residuals, 1 for k = 0.

    E[psi']^2 / E[psi^2], the factor of the asymptotic covariance of an M-estimator.
    """
    node, weight = np.polynomial.laguerre.laggauss(60)
    weight = weight * node ** (0.5 * m - 1.0) / gamma(0.5 * m)
    s = 2.0 * node  # the squared norm of m unit Gaussians has the density s^(m/2-1) exp(-s/2)
    w = weights(s, k)
    slope = w - k * s * w**3 / m
    return float((weight @ slope) ** 2 / (weight @ (w**2 * s / m)))
