"""What keeps a first fit near its nominal model where the measurements do not say anything.

Steps along directions that are open cost nothing, and without a hold they go on: axes of a 3-UPU
that only translates end half a radian off, where the machine is another one and other directions
seem to be known. No nominal model is that bad, and a first fit may know it: what it leaves open is
held from there on, and all else is fitted again without this knowledge.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from legcal.calibration.joint_fit.constraints import on_constraints
from legcal.calibration.joint_fit.determinacy import mean_length, named_units
from legcal.calibration.joint_fit.normal import normal_equations
from legcal.calibration.joint_fit.problem import FitProblem, Linearization, Priors, linearize
from legcal.calibration.joint_fit.state import State
from legcal.errors import DidNotConverge
from legcal.estimation import cost_of, width_to_k
from legcal.geometry import Array

_FIRST_DAMPING = 1e-6
_LEAST_DAMPING = 1e-10
_MOST_DAMPING = 1e8
_SMALLEST_FALL = 1e-12  # of the cost, in squared standard deviations: the minimum is reached
_ROUNDING = 1e-13  # of the cost: below, its fall is not seen
_LARGEST_TURN = 0.3  # [rad] in one step
_MEDIANS = 5.0  # width of the loss while most measurements are beyond its final one
_SLOW = 0.5  # of the cost: if the next step lowers it by less, this loss has done its work
_NARROWING = 0.8  # of the width: smaller changes of the median do not change the loss
_DONE = 0.01  # of the cost: where a step lowers it by less, the loss is narrowed in any case
_HALF = 0.5  # of the width, then
_POSE_STEPS = 3
_SAFER = 3.0  # times a damping that failed is tried after one that did not
_FORGOTTEN = 0.3  # of a damping that failed, every step
_PATIENCE = 30  # steps before a minimum may be near enough


@dataclass(frozen=True, eq=False)
class Minimum:
    """A minimum of the robust cost.

    Attributes
    ----------
    state : State
    linear : Linearization
        There.
    cost : float
    iterations : int
        Steps that were tried.
    """

    state: State
    linear: Linearization
    cost: float
    iterations: int


def minimise(
    problem: FitProblem,
    state: State,
    whitening: Array,
    width: float,
    max_iterations: int = 200,
    near_enough: float = 0.0,
) -> Minimum:
    """Minimise the robust cost from a state.

    Parameters
    ----------
    problem : FitProblem
    state : State
        Where to start.
    whitening : (n_outlines, 2, 2) array
        Weights of the outlines, as in :func:`legcal.calibration.joint_fit.problem.linearize`.
    width : float
        Whitened distance at which the loss turns from quadratic to linear; infinite for none.
    max_iterations : int
        Steps to try.
    near_enough : float
        Fall of the cost, as a part of it, for which no more than some steps are tried: where
        measurements that are wrong altogether bend the cost, the last steps are many and lead to
        where these pull.

    Raises
    ------
    DidNotConverge
        If no step lowers the cost although it is not at rest, or the steps do not come to an end.
    """
    state = on_constraints(state, problem.legs.frame_legs)
    linear = linearize(problem, state, whitening)
    wide = _width(linear, width, np.inf)
    damping, failed, fall_before = _FIRST_DAMPING, 0.0, np.inf
    for iteration in range(1, max_iterations + 1):
        k = width_to_k(wide)
        cost = robust_cost(linear, k)
        step, promised = normal_equations(problem, state, linear, k).step(damping)
        at_rest = promised < _SMALLEST_FALL + _ROUNDING * cost
        trial = _tried(problem, state, step, whitening)
        if trial is not None and not at_rest and not robust_cost(trial[1], k) < cost:
            trial = _followed(problem, *trial, whitening, k, cost)
        fall = -np.inf if trial is None else cost - robust_cost(trial[1], k)
        if trial is not None and np.isfinite(fall) and (fall > 0.0 or at_rest):
            state, linear = trial
            damping = max(_next(damping, fall / max(promised, 1e-300)), _SAFER * failed)
            failed *= _FORGOTTEN
            rate = promised / fall_before if np.isfinite(fall_before) else 1.0
            expected = promised * min(rate, 1.0)
            narrower = wide
            if expected < _SLOW * (cost - fall):
                narrower = _width(linear, width, wide)
            if narrower == wide and expected < _DONE * (cost - fall):
                narrower = max(width, _HALF * wide)
            smallest = near_enough * (cost - fall) if iteration > _PATIENCE else 0.0
            if narrower == wide and (at_rest or expected < max(smallest, _SMALLEST_FALL)):
                return Minimum(state, linear, robust_cost(linear, k), iteration)
            fall_before = promised if narrower == wide else np.inf
            wide = narrower
            continue
        failed, damping = damping, 10.0 * damping
        fall_before = np.inf
        if damping > _MOST_DAMPING:
            break
    raise DidNotConverge(
        "The fit of everything did not converge: found a cost that still falls by "
        f"{promised:.2g} a step after {iteration} steps, needed a minimum; start nearer to the "
        "truth (joints to 5 mm, cameras to 2 cm and 2 deg) and check the camera poses, the "
        "readings and that outlines or axes are those of the right legs and edges."
    )


def robust_cost(linear: Linearization, k: float) -> float:
    """Return the cost: half the squares of readings and priors, the loss of everything else."""
    plain = np.sum(linear.readings.r**2) + np.sum(linear.prior_r**2)
    kinds = linear.outlines, linear.axes, linear.corners
    robust = (cost_of(rows.squared_norms, k) for rows in kinds)
    return float(0.5 * plain + sum(robust))


def _width(linear: Linearization, width: float, before: float) -> float:
    """Return the width of the loss: some medians while most measurements are far off."""
    medians = [0.0]
    for rows in (linear.outlines, linear.axes, linear.corners):
        norms = rows.squared_norms[rows.squared_norms > 0.0]
        medians += [float(np.sqrt(np.median(norms)))] if len(norms) else []
    median = max(medians)  # corners agree with each other before anything else does
    wanted = width if median <= width else _MEDIANS * median
    return wanted if wanted == width or wanted < _NARROWING * before else before


def _next(damping: float, gain: float) -> float:
    """Return the damping after a step that gave that part of what it promised."""
    if gain > 0.75:
        return max(0.1 * damping, _LEAST_DAMPING)
    return damping if gain > 0.25 else 4.0 * damping


def _tried(
    problem: FitProblem, state: State, step: Array, whitening: Array
) -> tuple[State, Linearization] | None:
    """Return where a step leads, shortened where it turns too far; None if nowhere."""
    if not np.all(np.isfinite(step)):
        return None
    layout = problem.layout
    turns = [step[layout.n_kept :].reshape(-1, 6)[:, :3].ravel()]
    turns += [step[layout.camera[layout.camera[:, 0] < layout.size][:, :3]].ravel()]
    turns += [step[layout.board[layout.board < layout.size][:3]]]
    largest = float(np.abs(np.concatenate(turns)).max(initial=0.0))
    moved = state.moved(step * min(1.0, _LARGEST_TURN / max(largest, 1e-300)), layout)
    if np.any(moved.radii <= 0.0):
        return None
    moved = replace(moved, legs=problem.tied(moved.legs))
    try:
        moved = on_constraints(moved, problem.legs.frame_legs)
    except DidNotConverge:
        return None
    return moved, linearize(problem, moved, whitening)


def _followed(
    problem: FitProblem,
    state: State,
    linear: Linearization,
    whitening: Array,
    k: float,
    cost: float,
) -> tuple[State, Linearization] | None:
    """Return where poses come to rest after a step that has not lowered the cost.

    Readings are exact beside outlines, and curved: a long straight step leaves them, and the poses
    bring them back where the rest of the step was right.
    """
    there: tuple[State, Linearization] | None = (state, linear)
    for _ in range(_POSE_STEPS):
        if there is None or not np.isfinite(robust_cost(there[1], k)):
            return None
        step = normal_equations(problem, *there, k).pose_step()
        there = _tried(problem, there[0], step, whitening)
        if there is not None and robust_cost(there[1], k) < cost:
            return there
    return there


_NOMINAL_SIGMA = 0.1  # of the mean leg length, angles at it


def steadied(problem: FitProblem, state: State) -> FitProblem:
    """Return a problem that knows that no nominal model is wrong by a large part of a leg.

    Parameters
    ----------
    problem : FitProblem
    state : State
        Where its fit begins; it tells the mean leg length.
    """
    layout, legs, n = problem.layout, problem.legs, problem.layout.n_kinematic
    nominal = legs.vector(legs.nominal)[layout.kinematic < layout.size]
    sigma = _NOMINAL_SIGMA * mean_length(state) * named_units(problem, state)[:n]
    priors = Priors(
        layout,
        np.concatenate([problem.priors.position, np.arange(n, dtype=np.intp)]),
        np.concatenate([problem.priors.mean, nominal]),
        np.concatenate([problem.priors.sigma, sigma]),
    )
    return replace(problem, priors=priors)
