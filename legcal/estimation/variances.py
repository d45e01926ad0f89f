"""Restricted maximum likelihood of the variances of random effects.

Let b be the effects, B their whitened columns, M the projector onto the residuals of a fit, and r
the residuals: z = B^T M r is a sufficient statistic of b, and K = B^T M B. If b has the covariance
D, z has the covariance K + K D K, and the log-likelihood, zero for D = 0, is::

    L = -log det(1 + K D) / 2 + z^T (1 + D K)^-1 D z / 2

Its gradient and its expected curvature are sums of squares of y = (1 + K D)^-1 z and of
(1 + K D)^-1 K. At D = 0 they are Rao's score test, and the first step is the method of moments.

A variance estimated from few effects is uncertain, and a covariance with the likeliest variances
is too small on average. :func:`expected_variances` returns posterior means instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from legcal.geometry.types import Array, BoolArray, IntArray

_CONVERGED = 1e-4  # change of the log-likelihood
_MAX_STEPS = 50
_HALVINGS = 30
_NODES = np.geomspace(1e-3, 1e4, 512)  # quadrature nodes: standard deviations over their scale
_EXPECTED, _MAX_ROUNDS = 0.02, 10  # relative change at convergence, and rounds over kinds
_MIN_EIGENVALUE = 1e-9  # over the largest element of K: below, an effect is invisible to residuals


@dataclass(frozen=True, eq=False)
class Effects:
    """Scores of b random effects and their covariance, from the residuals of a fit."""

    z: Array  # (b,) scores at zero effects, nuisance parameters of the fit projected out
    K: Array  # (b, b) covariance of the scores for zero effects
    kind: IntArray  # (b,) kind of each effect; effects of a kind have one variance

    @property
    def n_kinds(self) -> int:
        """Number of variances."""
        return int(self.kind.max(initial=-1)) + 1

    def log_likelihood(self, variances: Array) -> float:
        """Return the log-likelihood of variances (n_kinds,), 0 for zero variances."""
        return self.with_variances(variances).log_likelihood

    def slope(self, variances: Array) -> tuple[Array, Array]:
        """Return its derivatives (n_kinds,) and their covariance (n_kinds, n_kinds)."""
        return self.with_variances(variances).slope()

    def with_variances(self, variances: Array) -> EffectsWithVariances:
        """Factor L L^T = 1 + D^(1/2) K D^(1/2) over the effects of positive variance."""
        active = np.flatnonzero(variances[self.kind] > 0.0)
        root = np.asarray(np.sqrt(variances[self.kind[active]]))
        spread = root[:, None] * self.K[np.ix_(active, active)] * root
        L = np.asarray(np.linalg.cholesky(np.eye(len(active)) + spread), dtype=np.float64)
        y = solve_triangular(L, root * self.z[active], lower=True, check_finite=False)
        return EffectsWithVariances(self, active, root, L, y)


@dataclass(frozen=True, eq=False)
class EffectsWithVariances:
    """Random effects with given variances, and the Cholesky factor of their covariance."""

    effects: Effects
    active: IntArray  # (s,) effects of positive variance
    root: Array  # (s,) standard deviations
    L: Array  # (s, s)
    y: Array  # (s,) L^-1 D^(1/2) z

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood of the variances."""
        return float(0.5 * self.y @ self.y - np.log(np.diagonal(self.L)).sum())

    def slope(self) -> tuple[Array, Array]:
        """Return its derivatives (n_kinds,) and their covariance (n_kinds, n_kinds)."""
        effects = self.effects
        projected = self.root[:, None] * effects.K[self.active]
        projected = solve_triangular(self.L, projected, lower=True, check_finite=False)
        conditional, y = effects.K - projected.T @ projected, effects.z - projected.T @ self.y
        membership = (effects.kind == np.arange(effects.n_kinds)[:, None]).astype(np.float64)
        slope = 0.5 * membership @ (y**2 - np.diagonal(conditional))
        return slope, np.asarray(
            0.5 * membership @ np.square(conditional, out=conditional) @ membership.T
        )


def estimate_variances(
    effects: Effects, least_gain: float, start: Array | None = None
) -> tuple[Array, float]:
    """Estimate the variances (n_kinds,) of random effects by restricted maximum likelihood.

    Also returns twice the log-likelihood that they gain over zero variances; with less than
    *least_gain*, all of them are zero. They are in the squared unit of the effects, and never
    negative. *start* (n_kinds,) is replaced by zeros where these are likelier.
    """
    variances = np.zeros(effects.n_kinds)
    best = effects.with_variances(variances)
    if start is not None and start.any():
        started = _with_variances(effects, start)
        if started is not None and started.log_likelihood > best.log_likelihood:
            variances, best = start, started
    for _ in range(_MAX_STEPS):
        slope, information = best.slope()
        step = _step(slope, information, variances > 0.0)
        before = best
        for halving in range(_HALVINGS):
            trial = np.maximum(variances + 0.5**halving * step, 0.0)
            candidate = _with_variances(effects, trial)
            if candidate is not None and candidate.log_likelihood >= best.log_likelihood:
                variances, best = trial, candidate
                break
        gained = best.log_likelihood - before.log_likelihood
        # As many more steps of this size would not reach the required gain.
        hopeless = gained < least_gain / (8.0 * _MAX_STEPS)
        if gained < _CONVERGED or (hopeless and best.log_likelihood < 0.25 * least_gain):
            break
    gain = 2.0 * best.log_likelihood
    return (variances if gain > least_gain else np.zeros_like(variances)), gain


def expected_variances(effects: Effects, variances: Array, kinds: Sequence[int]) -> Array:
    """Return the posterior means of the variances of some kinds of random effects.

    Each is the mean over its posterior given the others, in turn until convergence. The prior
    density of a standard deviation s is half-Cauchy, 1 / (1 + (s / s0)^2), with s0 the smallest
    typical effect of its kind that residuals resolve: nearly flat below s0, and with a finite mean
    from two effects on.

    *variances* (n_kinds,) are starting values, such as the likeliest ones; those of other *kinds*
    stay, and of a kind that is invisible to the residuals.

    Notes
    -----
    Half-Cauchy distributions of standard deviations: A. Gelman, Prior distributions for variance
    parameters in hierarchical models, Bayesian Analysis 1 (2006).
    """
    expected = variances.copy()
    prior = _NODES / (1.0 + _NODES**2)  # per unit of log s
    for _ in range(_MAX_ROUNDS):
        before = expected.copy()
        for kind in kinds:
            of_kind = effects.kind == kind
            others = _with_variances(
                effects, np.where(np.arange(len(expected)) == kind, 0.0, expected)
            )
            if others is None:
                return before
            projected = others.root[:, None] * effects.K[np.ix_(others.active, of_kind)]
            projected = solve_triangular(others.L, projected, lower=True, check_finite=False)
            eigenvalues, vectors = np.linalg.eigh(
                effects.K[np.ix_(of_kind, of_kind)] - projected.T @ projected
            )
            visible = eigenvalues > _MIN_EIGENVALUE * np.abs(effects.K).max()
            if np.count_nonzero(visible) < 2:
                continue
            k = eigenvalues[visible, None]
            squares = (vectors[:, visible].T @ (effects.z[of_kind] - projected.T @ others.y))[
                :, None
            ] ** 2
            v = _NODES**2 / k.mean()
            spread = 1.0 + k * v
            likelihood = 0.5 * np.sum(squares * v / spread - np.log(spread), axis=0)
            weight = prior * np.exp(likelihood - likelihood.max())
            expected[kind] = weight @ v / weight.sum()
        if np.all(np.abs(expected - before) <= _EXPECTED * expected.max()):
            break
    return expected


def _with_variances(effects: Effects, variances: Array) -> EffectsWithVariances | None:
    """Factor the effects; None where rounding of K makes the matrix indefinite."""
    try:
        return effects.with_variances(variances)
    except np.linalg.LinAlgError:
        return None


def _step(slope: Array, information: Array, inside: BoolArray) -> Array:
    """Fisher scoring step of the variances inside their bounds: none goes from zero downwards."""
    free = np.flatnonzero((inside | (slope > 0.0)) & (np.diagonal(information) > 0.0))
    step = np.zeros_like(slope)
    if len(free):
        block = information[np.ix_(free, free)]
        step[free] = np.linalg.lstsq(block, slope[free], rcond=1e-12)[0]
    return step
