"""A problem written out densely, by differences and without elimination, to check the solver by."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.linalg import null_space

from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.variables import State
from legcal.estimation.problem import EstimationProblem, Linearization, linearize
from legcal.geometry.types import Array
from legcal.machine.equations import posture_constraints

STEP = 1e-6


def residuals(problem: EstimationProblem[Any], state: Any) -> Array:
    """Return all whitened residuals one below the other, those of priors last."""
    linear = linearize(problem, state)
    of_factors = [linear[factor.name].r.ravel() for factor in problem.factors]
    return np.concatenate([*of_factors, linear.prior_r])


def jacobian(problem: EstimationProblem[Any], linear: Linearization[Any, Any]) -> Array:
    """Return the derivatives of all residuals by all unknowns as the solver has them, (n, size)."""
    found = []
    for factor in problem.factors:
        rows, index = linear[factor.name], problem.sparsity[factor.name].index
        n, q, _ = rows.J.shape
        wide = np.zeros((n, q, problem.size + 1))
        kept = np.where(index < problem.n_kept, index, problem.size)
        at = np.arange(n)[:, None, None], np.arange(q)[None, :, None]
        np.add.at(wide, (*at, kept[:, None]), rows.J)
        if factor.element is not None:
            d = problem.d_element
            elements = problem.n_kept + d * factor.element[:, None] + np.arange(d)
            np.add.at(wide, (*at, elements[:, None]), rows.J_element)
        found.append(wide[..., :-1].reshape(n * q, problem.size))
    priors = np.zeros((len(linear.prior_r), problem.size))
    priors[:, : problem.n_kept] = linear.prior_J
    return np.concatenate([*found, priors])


def projected_move(problem: FitProblem, state: State, x: Array) -> State:
    """Return the state after a step, with poses put back on their constraints."""
    return problem.projected(problem.moved(state, x))


def by_differences(
    problem: EstimationProblem[Any],
    state: Any,
    values: Callable[[Any], Array],
    directions: Array,
    move: Callable[[Any, Any, Array], Any] = EstimationProblem.moved,
) -> Array:
    """Return the derivatives of values of a state along rows of directions."""
    columns = [
        values(move(problem, state, STEP * d)) - values(move(problem, state, -STEP * d))
        for d in directions
    ]
    return np.array(columns).T / (2.0 * STEP)


def allowed(problem: FitProblem, state: State) -> Array:
    """Return an orthonormal basis (size, f) of the steps that constraints and holds leave."""

    def violations(state: State) -> Array:
        """Return the residuals of joints, constant lengths and the plane at all poses [m, rad]."""
        pose = state.platform_pose
        found = posture_constraints(state.legs, *pose).values.ravel()
        plane = np.stack([pose.R[:, 2, 0], pose.R[:, 2, 1], pose.t[:, 2]], axis=1)
        return found if problem.legs.spatial else np.concatenate([found, plane.ravel()])

    eye = np.eye(problem.size)
    C = by_differences(problem, state, violations, eye)
    held = np.zeros((len(problem.held_directions), problem.size))
    held[:, : problem.held_directions.shape[1]] = problem.held_directions
    C = np.concatenate([C, held])
    return np.asarray(null_space(C, rcond=1e-6)) if len(C) else eye
