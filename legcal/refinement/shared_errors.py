"""Errors that many outlines share: how large they are, and what they add to the covariance.

Shading treats an edge of a leg alike in all images of one camera. Such an error does not average
out over images, so independent noise of the same size would promise too much. The model
here is one unknown bias and one unknown tilt for each edge of each leg in each view, random with
variances that are estimated from the residuals (a score test, Rao's, and the moments that it is
made of). The fit stays what it is; its covariance grows by what these errors do to it.
"""

from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.refinement.covariance import reduced_jacobian
from legcal.refinement.normal import Linearization, NormalEquations, inverse_on_range
from legcal.refinement.problem import FitProblem

_SIGNIFICANT = 4.0  # standard deviations of the score without shared errors
_MODES = np.array([[1.0, 1.0], [-1.0, 1.0]])  # bias and tilt at both ends


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """Errors common to all images of one edge of a leg in a view.

    Attributes
    ----------
    bias_px, tilt_px : float
        Standard deviations of the parts that are equal and opposite at both ends [px]; 0 where
        the residuals do not show them.
    covariance : (n_kept, n_kept) array
        What they add to the covariance of the unknowns other than poses [mm^2, mrad^2].
    """

    bias_px: float
    tilt_px: float
    covariance: Array


def shared_errors(
    problem: FitProblem, linear: Linearization, normal: NormalEquations, whitening: Array
) -> SharedErrors:
    """Estimate the errors that outlines share, and what they mean for the unknowns.

    Parameters
    ----------
    problem : FitProblem
    linear : Linearization
        At the fit.
    normal : NormalEquations
        From :func:`legcal.refinement.normal.information` with this linearization.
    whitening : (n, 2, 2) array
        The whitening of the outlines [1/px]; zero for rejected ones.

    Returns
    -------
    SharedErrors
    """
    n_kept = problem.layout.n_kept
    if not np.any(whitening):
        return SharedErrors(0.0, 0.0, np.zeros((n_kept, n_kept)))
    group, n_groups = _groups(problem)
    size = 2 * n_groups
    n = len(group)
    # B (n, 2, 2 n_groups): whitened offsets by the bias and the tilt of each group.
    B = np.zeros((n, 2, size))
    shifts = whitening @ _MODES.T
    for mode in range(2):
        B[np.arange(n), :, group + mode * n_groups] = shifts[..., mode]
    G = reduced_jacobian(problem, linear, normal)
    A = np.einsum("nrk,nrb->kb", G, B, optimize=True)
    by_pose = np.zeros((len(problem.layout.pose), 6, size))
    np.add.at(by_pose, problem.outlines.pose, np.swapaxes(linear.outline_J[..., 13:], -1, -2) @ B)
    covariance = inverse_on_range(normal.reduced())
    response = covariance @ A
    K = np.einsum("nra,nrb->ab", B, B, optimize=True) - A.T @ response
    K -= np.einsum("kpa,kpq,kqb->ab", by_pose, normal.V_inverse, by_pose, optimize=True)
    score = np.einsum("nrb,nr->b", B, linear.outline_r, optimize=True)
    variances = _variances(score, K, n_groups)
    added = (response * np.repeat(variances, n_groups)) @ response.T
    bias, tilt = np.sqrt(variances)
    return SharedErrors(float(bias), float(tilt), added)


def _groups(problem: FitProblem) -> tuple[IntArray, int]:
    """Return the group of each outline, and how many there are: view, leg and edge."""
    o = problem.outlines
    keys = np.column_stack([o.view, o.radius, o.epsilon > 0.0])
    found, group = np.unique(keys, axis=0, return_inverse=True)
    return np.asarray(group.ravel(), dtype=np.intp), len(found)


def _variances(score: Array, K: Array, n_groups: int) -> Array:
    """Return the variances of bias and tilt [px^2] from the second moments of their scores.

    Without shared errors the scores have covariance K; variances s add sum_m s_m K_m K_m^T.
    """
    modes = [slice(0, n_groups), slice(n_groups, 2 * n_groups)]
    excess = np.array([np.sum(score[m] ** 2) - np.trace(K[m, m]) for m in modes])
    spread = np.array([np.sqrt(2.0 * np.sum(K[m, m] ** 2)) for m in modes])
    gain = np.array([[np.sum(K[a, b] ** 2) for b in modes] for a in modes])
    shown = excess > _SIGNIFICANT * spread
    variances = np.zeros(2)
    if shown.any():
        variances[shown] = np.linalg.solve(gain[np.ix_(shown, shown)], excess[shown])
    return np.maximum(variances, 0.0)
