"""The fit written out densely, by differences and without elimination, to check the solver by."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.linalg import null_space

from legcal.calibration.joint_fit.constraints import on_constraints
from legcal.calibration.joint_fit.problem import FitProblem, Linearization, linearize
from legcal.calibration.joint_fit.residuals import Places, Rows
from legcal.calibration.joint_fit.state import State
from legcal.geometry.types import Array
from legcal.machine import pose_equations

STEP = 1e-6


def residuals(problem: FitProblem, state: State, whitening: Array) -> Array:
    """Return all whitened residuals one below the other."""
    linear = linearize(problem, state, whitening)
    kinds = (linear.outlines, linear.readings, linear.axes)
    return np.concatenate([*(rows.r.ravel() for rows in kinds), linear.prior_r])


def jacobian(problem: FitProblem, linear: Linearization) -> Array:
    """Return the derivatives of all residuals by all unknowns, (n, size), as the fit has them."""
    kinds = (
        (problem.couplings.outlines, linear.outlines),
        (problem.couplings.readings, linear.readings),
        (problem.couplings.axes, linear.axes),
    )
    blocks = [_dense(problem, where, rows) for where, rows in kinds]
    priors = np.zeros((len(linear.prior_r), problem.layout.size))
    priors[:, : problem.layout.n_kept] = linear.prior_J
    return np.concatenate([*blocks, priors])


def free_move(problem: FitProblem, state: State, x: Array) -> State:
    """Return the state after a step, whatever its constraints say."""
    moved = state.moved(x, problem.layout)
    return replace(moved, legs=problem.tied(moved.legs))


def kept_move(problem: FitProblem, state: State, x: Array) -> State:
    """Return the state after a step, with poses put back on their constraints."""
    return on_constraints(free_move(problem, state, x), problem.legs.frame_legs)


def by_differences(
    problem: FitProblem,
    state: State,
    values: Callable[[State], Array],
    directions: Array,
    move: Callable[[FitProblem, State, Array], State] = free_move,
) -> Array:
    """Return the derivatives of values of a state along rows of directions."""
    columns = [
        values(move(problem, state, STEP * d)) - values(move(problem, state, -STEP * d))
        for d in directions
    ]
    return np.array(columns).T / (2.0 * STEP)


def violations(problem: FitProblem, state: State) -> Array:
    """Return how far poses are from what joints, lengths and the plane demand [m or rad]."""
    rows = pose_equations(state.legs, state.R_pose, state.t_pose)
    held = rows.values[:, ~rows.measured].ravel()
    if problem.legs.spatial:
        return held
    tilt = np.stack([state.R_pose[:, 2, 0], state.R_pose[:, 2, 1], state.t_pose[:, 2]], axis=1)
    return np.concatenate([held, (tilt - _HEIGHT).ravel()])


_HEIGHT = np.zeros(3)


def allowed(problem: FitProblem, state: State) -> Array:
    """Return an orthonormal basis (size, f) of the steps that constraints and holds leave."""
    eye = np.eye(problem.layout.size)
    C = by_differences(problem, state, lambda s: violations(problem, s), eye)
    C = np.concatenate([C, np.zeros((len(problem.held), problem.layout.size))])
    if len(problem.held):
        C[-len(problem.held) :, : problem.layout.n_kept] = problem.held
    return np.asarray(null_space(C, rcond=1e-6)) if len(C) else eye


def _dense(problem: FitProblem, where: Places, rows: Rows) -> Array:
    n, q, _ = rows.J.shape
    wide = np.zeros((n, q, problem.layout.size + 1))
    kept = np.where(where.index < problem.layout.n_kept, where.index, problem.layout.size)
    for i in range(n):
        for m, column in enumerate(kept[i]):
            wide[i, :, column] += rows.J[i, :, m]
        first = problem.layout.n_kept + 6 * where.pose[i]
        wide[i, :, first : first + 6] += rows.J_pose[i]
    return wide[..., :-1].reshape(n * q, problem.layout.size)
