"""What the residuals of a fit say of shifts that outlines share, the fit following them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import null_space

from legcal.calibration.joint_fit.biases import SharedShifts
from legcal.calibration.joint_fit.normal import NormalEquations, inverse_on_range, normal_equations
from legcal.calibration.joint_fit.problem import FitProblem, linearize, with_biases
from legcal.calibration.joint_fit.residuals import Places, Rows
from legcal.calibration.joint_fit.state import State
from legcal.geometry import Array


def reduced_jacobian(where: Places, rows: Rows, normal: NormalEquations) -> Array:
    """Return whitened residuals (n, q, n_kept) by the kept unknowns, poses following them."""
    n, q, _ = rows.J.shape
    G = np.zeros((n, q, where.n_kept + 1))
    measurement, row = np.arange(n)[:, None, None], np.arange(q)[None, :, None]
    np.add.at(G, (measurement, row, where.index[:, None, :]), rows.J)
    G = G[..., :-1]
    J_pose = rows.J_pose
    motion, pose = normal.tangent, where.pose
    if motion is not None:
        G = G + J_pose @ np.moveaxis(motion.Q, 0, 2)[pose]
        J_pose = J_pose @ motion.Z[pose]
    follow = normal.V_inverse @ np.moveaxis(normal.W, 0, 2)
    return np.asarray(G - J_pose @ follow[pose])


def explained_share(
    where: Places, rows: Rows, normal: NormalEquations, covariance: Array | None = None
) -> Array:
    """Return the covariance (n, q, q) of the predicted whitened residuals of every measurement.

    The residuals of a right fit have covariance one minus this, those of what it has not seen one
    plus this.

    Parameters
    ----------
    where, rows
        Of the measurements.
    normal : NormalEquations
        Of what tells their poses.
    covariance : (n_kept, n_kept) array, optional
        Of the kept unknowns, if it is not that of these equations.
    """
    G = reduced_jacobian(where, rows, normal)
    if covariance is None:
        covariance = normal.kept_covariance()
    J_pose = rows.J_pose
    if normal.tangent is not None:
        J_pose = J_pose @ normal.tangent.Z[where.pose]
    share = (G @ covariance) @ np.swapaxes(G, -1, -2)
    through_pose = J_pose @ normal.V_inverse[where.pose]
    return np.asarray(share + through_pose @ np.swapaxes(J_pose, -1, -2))


def response(where: Places, rows: Rows, normal: NormalEquations, change: Array) -> Array:
    """Return how a fit moves when what was measured changes.

    Parameters
    ----------
    where, rows
        Of the measurements that change; rows whitened, as the normal equations have them.
    normal : NormalEquations
    change : (n, q, c) array
        Whitened changes of their residuals, c different ones.

    Returns
    -------
    (n_kept, c) array
        Changes of the kept unknowns.
    """
    n, n_changes = len(change), change.shape[-1]
    gradient = np.zeros((where.n_kept + 1, n_changes))
    for member, column in where.groups:
        gradient[column] += np.einsum("nqm,nqc->mc", rows.J[member], change[member], optimize=True)
    gradient = gradient[:-1]
    of_pose = np.einsum("nqi,nqc->nic", rows.J_pose, change).reshape(n, 6 * n_changes)
    of_pose = (where.to_pose @ of_pose).reshape(where.n_poses, 6, n_changes)
    if normal.tangent is not None:
        gradient += np.einsum("akp,kpc->ac", normal.tangent.Q, of_pose, optimize=True)
        of_pose = np.swapaxes(normal.tangent.Z, 1, 2) @ of_pose
    gradient -= np.einsum("akf,kfc->ac", normal.W, normal.V_inverse @ of_pose, optimize=True)
    return np.asarray(-normal.kept_covariance() @ gradient)


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
        The same problem with all of these, :func:`legcal.calibration.joint_fit.build.with_biases`.

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
