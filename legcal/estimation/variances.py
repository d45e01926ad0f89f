"""Restricted maximum likelihood: how large random effects are, by what residuals say of them.

With b the effects, of which one unit has the whitened columns B, and M the projector onto what
a fit leaves of residuals, z = B^T M r holds all that the residuals r say of them, and K = B^T
M B. If b has the covariance D, z has K + K D K, and the logarithm of the likelihood, zero for D
= 0, is::

    L = -log det(1 + K D) / 2 + z^T (1 + D K)^-1 D z / 2

Its slope and its expected curvature are sums of squares of y = (1 + K D)^-1 z and of
(1 + K D)^-1 K. At D = 0 they are Rao's score test, and the first step are moments.

Few effects leave their variance uncertain, and a covariance with the likeliest variances in place
of the true ones is too small on average. :func:`expected_variances` are the means of all that the
residuals allow.
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
_NODES = np.geomspace(1e-3, 1e4, 512)  # of integrals over standard deviations, in their scale
_EXPECTED, _MAX_ROUNDS = 0.02, 10  # relative change of expected variances, and rounds over kinds
_SEEN = 1e-9  # of the largest eigenvalue of K: effects that the residuals show at all


@dataclass(frozen=True, eq=False)
class Effects:
    """What the residuals of a fit say of b random effects.

    Attributes
    ----------
    z : (b,) array
        Their scores where all of them are zero, the fit following.
    K : (b, b) array
        Covariance of the scores if all of them are zero.
    kind : (b,) array of int
        Effects of one kind have one variance.
    """

    z: Array
    K: Array
    kind: IntArray

    @property
    def n_kinds(self) -> int:
        """Number of variances."""
        return int(self.kind.max(initial=-1)) + 1

    def log_likelihood(self, variances: Array) -> float:
        """Return the logarithm of the likelihood of variances (n_kinds,), 0 for none."""
        return self.at(variances).log_likelihood

    def slope(self, variances: Array) -> tuple[Array, Array]:
        """Return its derivatives (n_kinds,) and their covariance (n_kinds, n_kinds)."""
        return self.at(variances).slope()

    def at(self, variances: Array) -> EffectsAt:
        """Return the effects at variances, L L^T = 1 + D^(1/2) K D^(1/2) of those that have one."""
        some = np.flatnonzero(variances[self.kind] > 0.0)
        root = np.asarray(np.sqrt(variances[self.kind[some]]))
        spread = root[:, None] * self.K[np.ix_(some, some)] * root
        L = np.asarray(np.linalg.cholesky(np.eye(len(some)) + spread), dtype=np.float64)
        y = solve_triangular(L, root * self.z[some], lower=True, check_finite=False)
        return EffectsAt(self, some, root, L, y)


@dataclass(frozen=True, eq=False)
class EffectsAt:
    """Random effects at some variances."""

    effects: Effects
    some: IntArray  # (s,) with a variance
    root: Array  # (s,) of it
    L: Array  # (s, s)
    y: Array  # (s,) L^-1 D^(1/2) z

    @property
    def log_likelihood(self) -> float:
        """The logarithm of their likelihood."""
        return float(0.5 * self.y @ self.y - np.log(np.diagonal(self.L)).sum())

    def slope(self) -> tuple[Array, Array]:
        """Return its derivatives (n_kinds,) and their covariance (n_kinds, n_kinds)."""
        effects = self.effects
        seen = self.root[:, None] * effects.K[self.some]
        seen = solve_triangular(self.L, seen, lower=True, check_finite=False)
        left, y = effects.K - seen.T @ seen, effects.z - seen.T @ self.y
        of_kind = (effects.kind == np.arange(effects.n_kinds)[:, None]).astype(np.float64)
        slope = 0.5 * of_kind @ (y**2 - np.diagonal(left))
        return slope, np.asarray(0.5 * of_kind @ np.square(left, out=left) @ of_kind.T)


def estimate_variances(
    effects: Effects, least_gain: float, start: Array | None = None
) -> tuple[Array, float]:
    """Return the variances of random effects by restricted maximum likelihood.

    Parameters
    ----------
    effects : Effects
    least_gain : float
        Twice the log-likelihood that the variances must gain over no effects at all; with less,
        all of them are zero.
    start : (n_kinds,) array, optional
        Variances nearby; none at all without it, or where it is less likely.

    Returns
    -------
    variances : (n_kinds,) array
        In the squared unit of the effects; never negative.
    gain : float
        Twice the log-likelihood gained.
    """
    variances = np.zeros(effects.n_kinds)
    best = effects.at(variances)
    if start is not None and start.any():
        near = _at(effects, start)
        if near is not None and near.log_likelihood > best.log_likelihood:
            variances, best = start, near
    for _ in range(_MAX_STEPS):
        slope, information = best.slope()
        step = _step(slope, information, variances > 0.0)
        before = best
        for halving in range(_HALVINGS):
            trial = np.maximum(variances + 0.5**halving * step, 0.0)
            there = _at(effects, trial)
            if there is not None and there.log_likelihood >= best.log_likelihood:
                variances, best = trial, there
                break
        gained = best.log_likelihood - before.log_likelihood
        # Even steps like this to the end would not gain enough.
        hopeless = gained < least_gain / (8.0 * _MAX_STEPS)
        if gained < _CONVERGED or (hopeless and best.log_likelihood < 0.25 * least_gain):
            break
    gain = 2.0 * best.log_likelihood
    return (variances if gain > least_gain else np.zeros_like(variances)), gain


def expected_variances(effects: Effects, variances: Array, kinds: Sequence[int]) -> Array:
    """Return the variances of some kinds of random effects that are expected, given residuals.

    Each is the mean over its distribution given the others, in turn until they agree. Before the
    residuals are seen a standard deviation s has the density 1 / (1 + (s / s0)^2), with s0 as small
    as the residuals show a typical effect of its kind: even below that, and with a mean for any
    number of effects from two on.

    Parameters
    ----------
    effects : Effects
    variances : (n_kinds,) array
        Nearby, such as the likeliest ones; those of other kinds are known.
    kinds : sequence of int
        Those to estimate; one that residuals do not show keeps its variance.

    Returns
    -------
    (n_kinds,) array
        In the squared unit of the effects.

    Notes
    -----
    Half-Cauchy distributions of standard deviations: A. Gelman, Prior distributions for variance
    parameters in hierarchical models, Bayesian Analysis 1 (2006).
    """
    found = variances.copy()
    beforehand = _NODES / (1.0 + _NODES**2)  # by the logarithm
    for _ in range(_MAX_ROUNDS):
        before = found.copy()
        for kind in kinds:
            own = effects.kind == kind
            others = _at(effects, np.where(np.arange(len(found)) == kind, 0.0, found))
            if others is None:
                return before
            seen = others.root[:, None] * effects.K[np.ix_(others.some, own)]
            seen = solve_triangular(others.L, seen, lower=True, check_finite=False)
            eigenvalues, vectors = np.linalg.eigh(effects.K[np.ix_(own, own)] - seen.T @ seen)
            known = eigenvalues > _SEEN * np.abs(effects.K).max()
            if np.count_nonzero(known) < 2:
                continue
            k = eigenvalues[known, None]
            squares = (vectors[:, known].T @ (effects.z[own] - seen.T @ others.y))[:, None] ** 2
            v = _NODES**2 / k.mean()
            spread = 1.0 + k * v
            likelihood = 0.5 * np.sum(squares * v / spread - np.log(spread), axis=0)
            weight = beforehand * np.exp(likelihood - likelihood.max())
            found[kind] = weight @ v / weight.sum()
        if np.all(np.abs(found - before) <= _EXPECTED * found.max()):
            break
    return found


def _at(effects: Effects, variances: Array) -> EffectsAt | None:
    """Return the effects at variances, None at such that the rounding of K exceeds one."""
    try:
        return effects.at(variances)
    except np.linalg.LinAlgError:
        return None


def _step(slope: Array, information: Array, inside: BoolArray) -> Array:
    """Return the scoring step of the variances that may move: not from zero downwards."""
    free = np.flatnonzero((inside | (slope > 0.0)) & (np.diagonal(information) > 0.0))
    step = np.zeros_like(slope)
    if len(free):
        block = information[np.ix_(free, free)]
        step[free] = np.linalg.lstsq(block, slope[free], rcond=1e-12)[0]
    return step
