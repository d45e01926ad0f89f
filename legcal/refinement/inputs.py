"""What the residuals need besides the unknowns, and their values at a state."""

import casadi as ca
import numpy as np

from legcal.geometry.types import Array
from legcal.refinement.loss import robust_loss
from legcal.refinement.problem import FitProblem
from legcal.refinement.residuals import Residual
from legcal.refinement.state import State


def inputs_of(problem: FitProblem, state: State, whitening: Array, k: float) -> tuple[Array, ...]:
    """Return what the residuals need besides the unknowns, one row a measurement.

    Parameters
    ----------
    problem : FitProblem
    state : State
        The reference: x = 0 is this state.
    whitening : (n_outlines, 2, 2) array
        Lower triangular T of each outline: T C T^T = 1 [1/px]; zero leaves an outline out.
    k : float
        Narrowness of the robust loss on outlines and axes.

    Returns
    -------
    tuple of array
        (n_outlines, 48), (n_readings, 22), (n_radii, 3) and (n_axes, 50).
    """
    o, e, prior = problem.outlines, problem.readings, problem.radius_prior
    camera = _frames(state.R_camera, state.t_camera)
    pose = _frames(state.R_pose, state.t_pose)
    of_outlines = np.column_stack(
        [
            state.base_joints[o.leg],
            state.platform_joints[o.leg],
            state.radii[o.radius],
            camera[o.view],
            pose[o.pose],
            o.feet.reshape(-1, 4),
            np.swapaxes(o.J_inverse_transposed, -1, -2).reshape(-1, 8),
            o.epsilon,
            whitening[:, 0, 0],
            whitening[:, 1, 0],
            whitening[:, 1, 1],
            np.full(len(o), k),
        ]
    )
    of_readings = np.column_stack(
        [
            state.base_joints[e.leg],
            state.platform_joints[e.leg],
            state.offsets[e.leg],
            pose[e.pose],
            e.length,
            np.full(len(e), 1.0 / e.sigma),
            np.zeros(len(e)),
        ]
    )
    of_prior = np.column_stack(
        [state.radii - prior.mean, 1.0 / prior.sigma, np.zeros(len(prior.mean))]
    )
    a = problem.axes
    row, column = np.triu_indices(4)
    of_axes = np.column_stack(
        [
            state.base_joints[a.leg],
            state.platform_joints[a.leg],
            camera[a.view],
            pose[a.pose],
            a.M,
            a.basis.reshape(-1, 6),
            a.whitening[:, column, row],  # the lower triangle, column by column
            np.full(len(a), k),
        ]
    )
    return of_outlines, of_readings, of_prior, of_axes


def parameter_of(inputs: tuple[Array, ...]) -> Array:
    """Return the parameter vector of the solver."""
    return np.concatenate([part.ravel() for part in inputs])


def evaluate(residual: Residual, inputs: Array) -> Array:
    """Return residuals (n, rows) at the reference, x = 0."""
    n = len(inputs)
    if n == 0:
        return np.zeros((0, residual.n_rows))
    r = residual.function.map(n)(
        ca.DM.zeros(residual.n_local, n), ca.DM(np.asfortranarray(inputs.T))
    )
    return np.asarray(r).T.copy()


def evaluate_jacobian(residual: Residual, inputs: Array) -> tuple[Array, Array]:
    """Return residuals (n, rows) and Jacobians (n, rows, locals) at the reference, x = 0."""
    n = len(inputs)
    if n == 0:
        return np.zeros((0, residual.n_rows)), np.zeros((0, residual.n_rows, residual.n_local))
    mapped = robust_loss(residual).jacobian.map(n)
    r, J = mapped(ca.DM.zeros(residual.n_local, n), ca.DM(np.asfortranarray(inputs.T)))
    columns = np.asarray(J).reshape(residual.n_rows, n, residual.n_local)
    return np.asarray(r).T.copy(), np.swapaxes(columns, 0, 1).copy()


def _frames(R: Array, t: Array) -> Array:
    """Return rotations, column by column, and translations as rows of 12."""
    return np.concatenate([np.swapaxes(R, -1, -2).reshape(-1, 9), t], axis=1)
