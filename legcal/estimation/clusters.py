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

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from legcal.estimation.loss import LEAST_SQUARES, Loss
from legcal.estimation.problem import Linearization, Problem, S
from legcal.estimation.solver import NormalEquations, inverse_on_range
from legcal.geometry.types import Array, BoolArray, IntArray

_RANGE = 1e-9  # of an information: what is smaller is rounding
_MIN_DOF = 4.0  # of a ratio that is believed


@dataclass(frozen=True, eq=False)
class Clusters:
    """Scores and information of each eliminated element at a state, and those of the priors."""

    score: Array  # (n, k) gradient of the cost
    information: Array  # (n, k, k) the element following
    prior: Array  # (k, k)
    prior_score: Array  # (k,)

    def choose(self, which: IntArray | BoolArray) -> Clusters:
        """Return some of the elements."""
        return replace(self, score=self.score[which], information=self.information[which])

    def best(self) -> Array:
        """Return the step (k,) of the kept unknowns to the minimum of the elements and priors."""
        return np.asarray(-self.normal_inverse @ (self.score.sum(axis=0) + self.prior_score))

    def moved(self, step: Array) -> Clusters:
        """Return the same after a step (k,) of the kept unknowns, to first order."""
        return replace(
            self,
            score=self.score + self.information @ step,
            prior_score=self.prior_score + self.prior @ step,
        )

    def freed(self, direction: Array) -> tuple[Clusters, Array, Array]:
        """Return the same with a change along *direction* (k,) free in each element.

        Beside it, at the minimum of what is left, that change and its information, (n,) each.
        """
        pull = self.information @ direction
        own = np.maximum(pull @ direction, 1e-300)
        left = replace(
            self,
            score=self.score - pull * (self.score @ direction / own)[:, None],
            information=self.information - pull[:, :, None] * pull[:, None, :] / own[:, None, None],
        )
        step = left.best()
        change = -(self.moved(step).score @ direction) / own
        return left.moved(step), change, own

    def contradiction(
        self, which: BoolArray, ratio: float, directions: Array | None = None
    ) -> Array:
        """Return how far each element contradicts the others of a group, in squared sigmas (n,).

        At the minimum of the group *which*, for errors of a ratio f; along unit changes
        *directions* (k, c) of the kept unknowns alone where these are given.
        """
        A = self.information
        N = inverse_on_range(A[which].sum(axis=0) + self.prior)
        V = A + np.where(which, -1.0, 1.0)[:, None, None] * (A @ N @ A)
        s = self.score
        if directions is not None:
            s, V = s @ directions, directions.T @ V @ directions
        V = V + _RANGE * np.einsum("nii->ni", V)[:, :, None] * np.eye(V.shape[1])
        V = V + 1e-300 * np.eye(V.shape[1])
        return (
            np.asarray(np.einsum("ni,ni->n", s, np.linalg.solve(V, s[..., None])[..., 0])) / ratio
        )

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
    return Clusters(
        score[:, :k],
        U[:, :k, :k] - normal.contributions(),
        prior_J.T @ prior_J,
        prior_J.T @ linear.prior_r,
    )
