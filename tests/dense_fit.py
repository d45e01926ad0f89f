"""The fit written out densely, by differences and without elimination, to check the solver by."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.linalg import null_space

from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.variables import State
from legcal.estimation import Linearization, Rows, linearize
from legcal.estimation.problem import Places
from legcal.geometry.types import Array
from legcal.machine import pose_equations

STEP = 1e-6


def whitened(problem: FitProblem, whitening: Array) -> FitProblem:
    """Return the problem with other weights (n, 2, 2) of outlines."""
    return problem.with_factors(replace(problem.factor("outlines"), whitening=whitening))


def residuals(problem: FitProblem, state: State, whitening: Array) -> Array:
    """Return all whitened residuals one below the other."""
    linear = linearize(whitened(problem, whitening), state)
    kinds = (linear["outlines"], linear["readings"], linear["axes"])
    return np.concatenate([*(rows.r.ravel() for rows in kinds), linear.prior_r])


def jacobian(problem: FitProblem, linear: Linearization) -> Array:
    """Return the derivatives of all residuals by all unknowns, (n, size), as the fit has them."""
    kinds = (
        (problem.places["outlines"], linear["outlines"]),
        (problem.places["readings"], linear["readings"]),
        (problem.places["axes"], linear["axes"]),
    )
    blocks = [_dense(problem, where, rows) for where, rows in kinds]
    priors = np.zeros((len(linear.prior_r), problem.size))
    priors[:, : problem.n_kept] = linear.prior_J
    return np.concatenate([*blocks, priors])


def free_move(problem: FitProblem, state: State, x: Array) -> State:
    """Return the state after a step, whatever its constraints say."""
    return problem.moved(state, x)


def kept_move(problem: FitProblem, state: State, x: Array) -> State:
    """Return the state after a step, with poses put back on their constraints."""
    return problem.projected(free_move(problem, state, x))


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
    rows = pose_equations(state.legs, *state.platform_pose)
    held = rows.values[:, ~rows.measured].ravel()
    if problem.legs.spatial:
        return held
    tilt = np.stack(
        [
            state.platform_pose.R[:, 2, 0],
            state.platform_pose.R[:, 2, 1],
            state.platform_pose.t[:, 2],
        ],
        axis=1,
    )
    return np.concatenate([held, (tilt - _HEIGHT).ravel()])


_HEIGHT = np.zeros(3)


def allowed(problem: FitProblem, state: State) -> Array:
    """Return an orthonormal basis (size, f) of the steps that constraints and holds leave."""
    eye = np.eye(problem.size)
    C = by_differences(problem, state, lambda s: violations(problem, s), eye)
    C = np.concatenate([C, np.zeros((len(problem.held), problem.size))])
    if len(problem.held):
        C[-len(problem.held) :, : problem.n_kept] = problem.held
    return np.asarray(null_space(C, rcond=1e-6)) if len(C) else eye


def _dense(problem: FitProblem, where: Places, rows: Rows) -> Array:
    n, q, _ = rows.J.shape
    wide = np.zeros((n, q, problem.size + 1))
    kept = np.where(where.index < problem.n_kept, where.index, problem.size)
    for i in range(n):
        for m, column in enumerate(kept[i]):
            wide[i, :, column] += rows.J[i, :, m]
        assert where.element is not None
        first = problem.n_kept + 6 * int(where.element[i])
        wide[i, :, first : first + 6] += rows.J_element[i]
    return wide[..., :-1].reshape(n * q, problem.size)
