"""Robust losses of whitened residuals, by their squared norms s.

The pseudo-Huber loss of width k^-1/2 is s / (1 + sqrt(1 + k s)): s / 2 for small s, linear in the
residual norm for large s, convex, and least squares for k = 0. Huber's loss switches at the width.
In both, the influence of a residual is bounded by the width. Weights of losses that are not convex
are for iteratively reweighted least squares from a good start.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np
from scipy.special import roots_genlaguerre

from legcal.geometry.types import Array


class Loss(Protocol):
    """A robust loss of whitened residuals with squared norms s."""

    @property
    def width(self) -> float:
        """Norm at which the loss turns from quadratic to linear."""

    def cost(self, s: Array) -> float:
        """Return the total loss of measurements with squared norms s (n,)."""

    def softened(self, r: Array, slope: Array) -> tuple[Array, Array]:
        """Return rows (n, q), (n, q, l) whose squares have the loss's gradient and curvature."""

    def efficiency(self, m: int) -> float:
        """Return the efficiency of the M-estimator for m Gaussian residuals."""


@dataclass(frozen=True)
class PseudoHuber:
    """The pseudo-Huber loss; least squares for an infinite width."""

    width: float = np.inf

    @property
    def k(self) -> float:
        """1 / width^2."""
        return 1.0 / (self.width * self.width)

    def cost(self, s: Array) -> float:
        """Return the total loss of measurements with squared norms s (n,)."""
        if self.k == 0.0:
            return 0.5 * float(s.sum())
        return float((s / (1.0 + np.sqrt(1.0 + self.k * s))).sum())

    def weights(self, s: Array) -> Array:
        """Return the weights (n,) of the squares s (n,) that have the gradient of the loss."""
        return np.asarray(1.0 / np.sqrt(1.0 + self.k * s))

    def softened(self, r: Array, slope: Array) -> tuple[Array, Array]:
        """Return rows with gradient w r and curvature w (1 - k w^2 r r^T), w = (1 + k s)^-1/2.

        Both are positive, so that the square root of the curvature is a factor of the rows.
        """
        if self.k == 0.0:
            return r, slope
        s = np.einsum("nq,nq->n", r, r)
        root = np.sqrt(1.0 + self.k * s)
        along = (1.0 - 1.0 / root) / np.maximum(s, 1e-300)
        part = along[:, None] * np.einsum("nq,nqm->nm", r, slope)
        softened = slope - r[..., None] * part[:, None]
        softened /= np.sqrt(root)[:, None, None]
        return np.sqrt(root)[:, None] * r, softened

    def efficiency(self, m: int) -> float:
        """Return E[psi']^2 / E[psi^2], the asymptotic efficiency of the M-estimator."""
        return _efficiency(self.k, m)


@dataclass(frozen=True)
class Huber:
    """Huber's loss, with the curvature of iteratively reweighted least squares."""

    width: float

    def cost(self, s: Array) -> float:
        """Return the total loss of measurements with squared norms s (n,)."""
        size = np.sqrt(s)
        far = self.width * (size - 0.5 * self.width)
        return float(np.where(size > self.width, far, 0.5 * s).sum())

    def softened(self, r: Array, slope: Array) -> tuple[Array, Array]:
        """Return rows weighted with the root of width / |r| where that is below one."""
        size = np.sqrt(np.einsum("nq,nq->n", r, r))
        root = np.sqrt(np.minimum(1.0, self.width / np.maximum(size, 1e-12)))
        return root[:, None] * r, root[:, None, None] * slope

    def efficiency(self, m: int) -> float:
        """Return one: the weights are in the rows already."""
        return 1.0


LEAST_SQUARES = PseudoHuber()


def cauchy_weights(s: Array) -> Array:
    """Return the weights of Cauchy's loss for squares s of residuals in units of its width."""
    return np.asarray(1.0 / (1.0 + s))


def biweights(s: Array) -> Array:
    """Return Tukey's weights for squares s of residuals in units of the width: zero beyond it."""
    return np.asarray(np.maximum(1.0 - s, 0.0) ** 2)


@cache
def _efficiency(k: float, m: int) -> float:
    # The squared norm of m unit Gaussians has the density s^(m/2-1) exp(-s/2), infinite for m = 1
    node, weight = roots_genlaguerre(60, 0.5 * m - 1.0)
    s, weight = 2.0 * node, weight / weight.sum()
    w = 1.0 / np.sqrt(1.0 + k * s)
    slope = w - k * s * w**3 / m
    return float((weight @ slope) ** 2 / (weight @ (w**2 * s / m)))
