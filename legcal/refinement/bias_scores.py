"""What the residuals of a fit say of shifts that outlines share, the fit following them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import null_space

from legcal.geometry.types import Array
from legcal.refinement.biases import SharedShifts
from legcal.refinement.linearize import linearize
from legcal.refinement.normal import inverse_on_range, normal_equations
from legcal.refinement.problem import FitProblem
from legcal.refinement.shifted import with_biases
from legcal.refinement.state import State


def with_shifts(
    problem: FitProblem, state: State, shifts: SharedShifts
) -> tuple[FitProblem, State]:
    """Return problem and state with these shifts in place of others, known ones as they are."""
    return with_biases(problem, shifts), _with_values(problem, state, shifts)


def scores_of_shifts(
    problem: FitProblem,
    state: State,
    whitening: Array,
    possible: SharedShifts,
    asked: FitProblem,
) -> tuple[Array, Array]:
    """Return the scores of shifts where all of them are zero, and their covariance if they are.

    Parameters
    ----------
    problem : FitProblem
        With or without shifts.
    state : State
        Of this problem, near a minimum; Gauss-Newton's step from there is taken into account.
    whitening : (n_outlines, 2, 2) array
        Of the outlines, zero for rejected ones [1/px].
    possible : SharedShifts
        The shifts that are asked for.
    asked : FitProblem
        The same problem with all of these, :func:`legcal.refinement.build.with_biases`.

    Returns
    -------
    z : (b,) array
        B^T M r with B the whitened shifts, r the residuals without any shift and M the projector
        onto what the fit leaves of residuals [1/px].
    K : (b, b) array
        B^T M B [1/px^2].
    """
    state = _with_values(problem, state, possible)
    linear = linearize(asked, state, whitening)
    normal = normal_equations(asked, state, linear, 0.0)
    S = normal.reduced()
    following = (normal.V_inverse @ normal.g_pose[..., None])[..., 0]
    g = normal.g_kept - np.einsum("akp,kp->a", normal.W, following)
    bias = asked.layout.bias
    others = np.setdiff1d(np.arange(len(S)), bias)
    of_prior = 1.0 / possible.sigmas**2
    S_others, S_mixed = S[np.ix_(others, others)], S[np.ix_(others, bias)]
    if len(normal.held):
        N = null_space(normal.held[:, others])
        inverse = N @ inverse_on_range(N.T @ S_others @ N) @ N.T
    else:
        inverse = inverse_on_range(S_others)
    K = S[np.ix_(bias, bias)] - np.diag(of_prior) - S_mixed.T @ inverse @ S_mixed
    # A difference of what nearly cancels where images determine little: rounded below zero.
    value, vector = np.linalg.eigh(0.5 * (K + K.T))
    K = (vector * np.maximum(value, 0.0)) @ vector.T
    left = g[bias] - of_prior * state.biases - S_mixed.T @ inverse @ g[others]
    return K @ state.biases - left, K


def _with_values(problem: FitProblem, state: State, shifts: SharedShifts) -> State:
    """Return a state of a problem with the values of these shifts, zero where it has none."""
    names = (problem.named[i] for i in problem.layout.bias)
    known = dict(zip(names, state.biases.tolist(), strict=True))
    return replace(state, biases=np.array([known.get(name, 0.0) for name in shifts.names]))
