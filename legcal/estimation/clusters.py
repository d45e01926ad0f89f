"""Cluster-robust covariance: eliminated elements as clusters of measurements with common errors.

Measurements of one element (the corners of an image) share errors that their residuals do not show:
bent paper, sharpening, compression. Such errors show as disagreement between elements. Element i
has a score s_i = J^T r and an information A_i of the kept unknowns, its own unknowns marginalised
out; N is the sum of all A_i and the information of the priors. With the claimed errors, s_i would
have the covariance V_i = A_i - A_i N^-1 A_i at the minimum. The actual errors are larger by a
common factor, Birge's ratio between elements, weighted by the shift N^-1 s_i of the unknowns::

    f = sum_i s_i^T N^-1 s_i / sum_i trace(N^-1 V_i)

A few elements determine f, since each has many scores; the sandwich estimator would be singular or
far too small. The covariance is N^-1 (f sum_i A_i + priors) N^-1, with f scaled by v / (v - 2) for
v degrees of freedom of f: the variance of Student's distribution.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from legcal.estimation.loss import LEAST_SQUARES, Loss
from legcal.estimation.solver import NormalEquations, inverse_on_range
from legcal.geometry.types import Array, BoolArray, IntArray

_RANGE = 1e-9  # relative to the trace of a covariance: added against rounding
_MIN_DOF = 4.0  # degrees of freedom, below which the ratio is not estimated


@dataclass(frozen=True, eq=False)
class Clusters:
    """Scores and information of each eliminated element and of the priors, at a state."""

    score: Array  # (n, k) gradient of the cost
    information: Array  # (n, k, k) the element marginalised out
    prior: Array  # (k, k)
    prior_score: Array  # (k,)

    def choose(self, which: IntArray | BoolArray) -> Clusters:
        """Select elements by index or mask."""
        return replace(self, score=self.score[which], information=self.information[which])

    def best(self) -> Array:
        """Step (k,) of the kept unknowns to the minimum of elements and priors."""
        return np.asarray(-self.normal_inverse @ (self.score.sum(axis=0) + self.prior_score))

    def moved(self, step: Array) -> Clusters:
        """Update the scores for a step (k,) of the kept unknowns, to first order."""
        return replace(
            self,
            score=self.score + self.information @ step,
            prior_score=self.prior_score + self.prior @ step,
        )

    def freed(self, direction: Array) -> tuple[Clusters, Array, Array]:
        """Free a shift along *direction* (k,) in each element and move to the new minimum.

        Also return the shift of each element at that minimum and its information, (n,) each.
        """
        pull = self.information @ direction
        information = np.maximum(pull @ direction, 1e-300)
        eliminated = replace(
            self,
            score=self.score - pull * (self.score @ direction / information)[:, None],
            information=self.information
            - pull[:, :, None] * pull[:, None, :] / information[:, None, None],
        )
        step = eliminated.best()
        change = -(self.moved(step).score @ direction) / information
        return eliminated.moved(step), change, information

    def contradiction(
        self, which: BoolArray, ratio: float, directions: Array | None = None
    ) -> Array:
        """Squared Mahalanobis distance (n,) of each element from the minimum of a group.

        The group is *which*, *ratio* is f. With *directions* (k, c), only the components of the
        scores along these unit changes of the kept unknowns are tested.
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
        """Covariance (k, k) of the kept unknowns for the claimed errors."""
        return inverse_on_range(self.information.sum(axis=0) + self.prior)

    def ratio(self) -> float:
        """Birge ratio f with its correction v / (v - 2); 1 where v is too small."""
        N = self.normal_inverse
        leverage = self.information @ N
        leverage = leverage - leverage @ leverage  # V_i N^-1
        expected = float(np.trace(leverage, axis1=1, axis2=2).sum())
        squared_leverage = float(np.einsum("nij,nji->", leverage, leverage))
        dof = expected**2 / max(squared_leverage, 1e-300)
        if not (expected > 0.0 and dof > _MIN_DOF):
            return 1.0
        squared_score = float(np.einsum("nk,kl,nl->", self.score, N, self.score))
        return squared_score / expected * dof / (dof - 2.0)

    def covariance(self, ratio: float) -> Array:
        """Covariance (k, k) of the kept unknowns for a ratio f."""
        C = self.normal_inverse
        return np.asarray(C @ (ratio * self.information.sum(axis=0) + self.prior) @ C)


def clustered(normal: NormalEquations[Any, Any], loss: Loss = LEAST_SQUARES) -> Clusters:
    """Compute the score and the information that each eliminated element has of the kept unknowns.

    Every element is at its minimum, of the same loss.
    """
    problem, linear = normal.problem, normal.linear
    n, k = problem.n_elements, problem.n_kept
    score, U = np.zeros((n, k + 1)), np.zeros((n, k + 1, k + 1))
    for factor in problem.factors:
        rows, element = linear[factor.name], factor.element
        if element is None:
            continue
        r, J = rows.r, rows.J
        if factor.robust and np.isfinite(loss.width):
            r, J = loss.softened(r, J)
        index = problem.sparsity[factor.name].index
        np.add.at(score, (element[:, None], index), np.einsum("nqk,nq->nk", J, r))
        cells = element[:, None, None], index[:, :, None], index[:, None, :]
        np.add.at(U, cells, np.swapaxes(J, 1, 2) @ J)
    prior_J = linear.prior_J
    return Clusters(
        score[:, :k],
        U[:, :k, :k] - normal.contributions(),
        prior_J.T @ prior_J,
        prior_J.T @ linear.prior_r,
    )
