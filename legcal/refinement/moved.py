"""Whether a machine is still the one that was calibrated, asked of a few new images.

The new images are fitted by themselves, with priors so wide that any plausible change fits, so
that nothing which moved is taken for a wrong outline. What they say of the parameters is then
compared with the earlier result: the difference has the covariance of both, and the weighted square
of it has an F distribution if nothing moved. Directions of which the new images know less than the
priors say nothing and do not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array
from legcal.refinement.changes import Change


@dataclass(frozen=True, eq=False)
class Explanation:
    """One thing that may have changed, and what would then be left unexplained.

    Attributes
    ----------
    change : Change
        What.
    values, sigma : (m,) array
        By how much, and the standard deviations [m or rad].
    remaining : float
        The statistic that is left.
    p_value : float
        Its probability if this is all that changed.
    """

    change: Change
    values: Array
    sigma: Array
    remaining: float
    p_value: float


@dataclass(frozen=True, eq=False)
class Movement:
    """What new images say of an earlier result.

    Attributes
    ----------
    statistic : float
        Weighted square of the difference of the parameters.
    dof, noise_dof : int
        Directions that are compared, and degrees of freedom of the noise of the new images.
    p_value : float
        Probability of such a statistic or a larger one if nothing moved.
    significance : float
        Something has moved if the probability is below.
    explanations : tuple of Explanation
        If something moved: what explains it, the best first.
    """

    statistic: float
    dof: int
    noise_dof: int
    p_value: float
    significance: float
    explanations: tuple[Explanation, ...]

    @property
    def moved(self) -> bool:
        """Whether something has moved."""
        return self.p_value < self.significance


@dataclass(frozen=True, eq=False)
class Difference:
    """What the new images say against the earlier result, in the directions that they determine.

    Attributes
    ----------
    directions : (k, p) array
        Derivatives of what is compared by the parameters, each counted in sigmas of its prior.
    values : (k,) array
        The difference along them.
    covariance : (k, k) array
        That of the difference if nothing moved.
    """

    directions: Array
    values: Array
    covariance: Array


def difference(
    values: Array,
    covariance: Array,
    prior: Array,
    old: Array,
    known: Array,
    worse: float = 1.0,
) -> Difference:
    """Return what new images say against the earlier result.

    Parameters
    ----------
    values : (p,) array
        Parameters by the new images and the priors.
    covariance : (p, p) array
        Their covariance, priors included.
    prior : (p,) array
        Standard deviations of the priors; their means are the earlier result.
    old : (p,) array
        Parameters of the earlier result.
    known : (p, p) array
        Their covariance.
    worse : float
        How many times the variance of the outlines is at least what a few new images make of it:
        theirs alone may look small by chance.

    Raises
    ------
    NotIdentifiable
        If the new images determine nothing.
    """
    # In units of the priors, S is what the new images add to them.
    scaled = covariance / np.outer(prior, prior)
    S = np.linalg.inv(scaled) - np.eye(len(prior))
    score = np.linalg.solve(scaled, (values - old) / prior)
    weight, vectors = np.linalg.eigh(0.5 * (S + S.T))
    tells = weight > 1.0
    if not tells.any():
        raise NotIdentifiable(
            "The earlier result could not be tested: the new images determine no direction of the "
            "parameters better than it is known without them; take more images, of more legs at "
            "once and at other poses."
        )
    directions = vectors[:, tells].T / prior
    return Difference(
        directions,
        vectors[:, tells].T @ score / weight[tells],
        np.diag(worse / weight[tells]) + directions @ known @ directions.T,
    )


def noise_dof(dof: int, covariance: Array, prior: Array) -> int:
    """Return the degrees of freedom that tell of the noise in a fit with wide priors.

    Parameters
    ----------
    dof : int
        Residuals, those of priors among them, less unknowns.
    covariance : (p, p) array
        Of the parameters that have the priors.
    prior : (p,) array
        Standard deviations of the priors.
    """
    # A prior that the images outdo has no residual of its own.
    outdone = len(prior) - float(np.trace(covariance / prior**2))
    return max(round(dof - outdone), 1)


def judge_movement(
    found: Difference,
    noise_dof: int,
    changes: Sequence[Sequence[Change]],
    significance: float,
) -> Movement:
    """Return whether something has moved, and if so what explains it.

    Parameters
    ----------
    found : Difference
        What the new images say against the earlier result.
    noise_dof : int
        Degrees of freedom from which the noise of the new images is known.
    changes : sequence of sequences of Change
        What may have moved, the simplest first.
    significance : float
        Probability of a false alarm.
    """
    whitening = np.linalg.inv(np.linalg.cholesky(found.covariance))
    residual = whitening @ found.values
    statistic, k = float(residual @ residual), len(residual)
    p_value = _p_value(statistic, k, noise_dof)
    explanations: list[Explanation] = []
    if p_value < significance:
        for of_kind in changes:
            tried = [
                _explain(whitening @ found.directions, residual, c, noise_dof) for c in of_kind
            ]
            explanations = sorted(tried, key=lambda explanation: explanation.remaining)
            enough = [e for e in explanations if e.p_value >= significance]
            if enough:
                explanations = enough
                break
    return Movement(statistic, k, noise_dof, p_value, significance, tuple(explanations))


def _explain(directions: Array, residual: Array, change: Change, noise_dof: int) -> Explanation:
    """Return what a change leaves of a whitened difference (k,)."""
    by_change = directions @ change.columns
    inverse = np.linalg.pinv(by_change, rcond=1e-9)
    values = inverse @ residual
    left = residual - by_change @ values
    remaining, dof = float(left @ left), len(residual) - int(np.linalg.matrix_rank(by_change))
    return Explanation(
        change,
        values,
        np.sqrt(np.sum(inverse**2, axis=1)),
        remaining,
        _p_value(remaining, dof, noise_dof),
    )


def _p_value(statistic: float, dof: int, noise_dof: int) -> float:
    """Return the probability of a statistic or a larger one, the noise estimated itself."""
    return float(fdtrc(dof, max(noise_dof, 1), statistic / dof)) if dof > 0 else 0.0
