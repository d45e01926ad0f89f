"""What each eliminated element says of the kept unknowns, and a covariance that believes these.

Measurements of one element (the corners of an image) share errors that their residuals do not show:
what bends paper, sharpening, compression. They do show where elements disagree. Element i has a
score s_i = J^T r and an information A_i of the kept unknowns, itself following; N is the sum of all
A_i and of the priors. If errors were as claimed, s_i would have the covariance
V_i = A_i - A_i N^-1 A_i at the minimum. They are larger by one factor, Birge's ratio between
elements, with each weighted as it moves the unknowns by N^-1 s_i::

    f = sum_i s_i^T N^-1 s_i / sum_i trace(N^-1 V_i)

Few elements determine it, having many numbers each, where a sandwich of their scores is singular
or far too small. The covariance is N^-1 (f sum_i A_i + priors) N^-1, with f times v / (v - 2) where
f is known with v degrees of freedom: that of Student's distribution.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from legcal.estimation.loss import LEAST_SQUARES, Loss
from legcal.estimation.problem import Linearization, Problem, S
from legcal.estimation.solver import NormalEquations, inverse_on_range
from legcal.geometry import Array

_MIN_DOF = 4.0  # of a ratio that is believed


@dataclass(frozen=True, eq=False)
class Clusters:
    """Scores and information of each eliminated element at a state, and those of the priors."""

    score: Array  # (n, k) gradient of the cost
    information: Array  # (n, k, k) the element following
    prior: Array  # (k, k)

    @cached_property
    def normal_inverse(self) -> Array:
        """The covariance if errors were as claimed, (k, k)."""
        return inverse_on_range(self.information.sum(axis=0) + self.prior)

    def ratio(self) -> float:
        """Return f with what its own error adds; 1 where elements cannot disagree."""
        N = self.normal_inverse
        by_score = self.information @ N
        by_score = by_score - by_score @ by_score  # V_i N^-1
        expected = float(np.trace(by_score, axis1=1, axis2=2).sum())
        squares = float(np.einsum("nij,nji->", by_score, by_score))
        dof = expected**2 / max(squares, 1e-300)
        if not (expected > 0.0 and dof > _MIN_DOF):
            return 1.0
        found = float(np.einsum("nk,kl,nl->", self.score, N, self.score))
        return found / expected * dof / (dof - 2.0)

    def covariance(self, ratio: float) -> Array:
        """Return the covariance (k, k) of the kept unknowns for a ratio f."""
        C = self.normal_inverse
        return np.asarray(C @ (ratio * self.information.sum(axis=0) + self.prior) @ C)


def clustered(
    problem: Problem[S],
    linear: Linearization,
    normal: NormalEquations,
    loss: Loss = LEAST_SQUARES,
) -> Clusters:
    """Return what each eliminated element says of the kept unknowns.

    Parameters
    ----------
    problem, linear
        At a state where all elements are at their minimum.
    normal : NormalEquations
        Of the same problem, state and loss.
    loss : Loss
        On the factors that are robust.
    """
    n, k = problem.n_elements, problem.n_kept
    score, U = np.zeros((n, k + 1)), np.zeros((n, k + 1, k + 1))
    for factor in problem.factors:
        rows, at = linear[factor.name], factor.element
        if at is None:
            continue
        r, J = rows.r, rows.J
        if factor.robust and np.isfinite(loss.width):
            r, J = loss.softened(r, J)
        index = problem.places[factor.name].index
        np.add.at(score, (at[:, None], index), np.einsum("nqk,nq->nk", J, r))
        where = at[:, None, None], index[:, :, None], index[:, None, :]
        np.add.at(U, where, np.swapaxes(J, 1, 2) @ J)
    prior_J = linear.prior_J
    return Clusters(score[:, :k], U[:, :k, :k] - normal.contributions(), prior_J.T @ prior_J)
