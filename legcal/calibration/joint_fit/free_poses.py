"""Starts of platform poses that readings do not give: the best of several in every image.

A few lines in an image allow several poses, and a joint fit keeps those next to which it begins.
So each pose is looked for from many places, cameras and legs held, before the fit and once more
after its first minimum. What the nominal model may be off counts as noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legcal.calibration.joint_fit.outline_errors import NoiseModel
from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.variables import LegConstraints, State
from legcal.estimation.loss import PseudoHuber
from legcal.estimation.problem import GaussianPrior, Linearization, linearize
from legcal.estimation.solver import minimise, normal_equations
from legcal.geometry.types import Array, BoolArray
from legcal.machine.equations import freedoms, pose_equations
from legcal.machine.rods import first_rods

_SEED, _DRAWN = 1965, 16  # places from which every pose is looked for, beside where it is
_TURN, _SHIFT = 0.4, 0.3  # of these from there [rad, mean leg lengths], one standard deviation
_STEPS = 25  # of a pose
_DAMPING, _SLOW = 1e-3, 0.999  # at first; part of its cost that a step must leave to go on
_MODEL_PX, _MODEL_LENGTH = 2.0, 0.005  # errors of the nominal model [px], mean leg lengths
_WIDTH = 3.0  # of the loss, in medians
_RANK = 1e-6  # of the largest singular value
_OUTLYING = 10.0  # medians of what the measurements of a pose cost
_OPEN = 0.1  # mean leg lengths [m, rad]: a pose no better known is not determined
_BETTER = 0.5  # of the cost of a pose, below which another one is better


def are_free(problem: FitProblem, state: State) -> bool:
    """Say whether readings and legs leave platform poses open."""
    columns = list(freedoms(problem.legs.frame_legs))
    R, t, q = (x[:1] for x in state.platform_pose)
    rows = pose_equations(state.legs, R, t, by_local=False, q=q if q.shape[1] else None)
    by_pose = rows.by_pose[0][:, columns] / np.where(np.array(columns) < 3, state.mean_length, 1.0)
    return len(by_pose) == 0 or int(np.linalg.matrix_rank(by_pose, tol=_RANK)) < len(columns)


def of_determined_poses(problem: FitProblem, state: State, accepted: BoolArray) -> BoolArray:
    """Return which of the accepted outlines (n,) are of poses that these and readings determine.

    A platform that readings leave free slides along what few legs leave open, for ever. What such
    an image shows of the machine is little, and it is left out.
    """
    element = problem.factor("outlines").element
    if element is None or not are_free(problem, state):
        return accepted
    return np.asarray(accepted & _are_determined(problem, state)[element])


def _are_determined(problem: FitProblem, state: State) -> BoolArray:
    """Return which poses their measurements determine, (n_poses,)."""
    V = normal_equations(problem, state, linearize(problem, state)).V
    moving = np.any(np.einsum("kff->kf", V) > 0.0, axis=0)
    least = np.linalg.eigvalsh(V[:, moving][:, :, moving])[:, 0]
    return np.asarray(least * (_OPEN * state.mean_length) ** 2 > 1.0)


def with_free_poses(problem: FitProblem, state: State) -> State:
    """Return a start with the best poses near it, and cameras that suit them, by the legs there."""
    n, length = problem.n_kinematic, state.mean_length
    soft = _softened(problem, 1.0, length)
    unit = np.array([length if unit == "m" else 1.0 for unit in problem.units[:n]])
    legs = problem.block("legs")
    near = GaussianPrior(np.arange(n, dtype=np.intp), legs.read(state.legs), _MODEL_LENGTH * unit)
    soft = soft.with_parts((replace(legs, prior=legs.prior + near),), ())
    for seed in range(2):
        state = with_better_poses(soft, state, seed=seed)
        loss = PseudoHuber(_width(soft, state))
        state = minimise(soft, state, loss, max_iterations=40, must_converge=False).state
    return state


def with_better_poses(problem: FitProblem, state: State, part: float = 0.0, seed: int = 0) -> State:
    """Return a state with other poses where these suit their images much better.

    All else is held. *part* of the errors of a nominal model counts as noise.
    """
    problem = _softened(problem, part, state.mean_length) if part else problem
    loss = PseudoHuber(_width(problem, state))
    rng, n = np.random.default_rng((_SEED, seed)), len(state.platform_pose.t)
    size = np.zeros(problem.d_element)  # the readings of a posture follow its pose
    size[:6] = np.repeat([_TURN, _SHIFT * state.mean_length], 3)
    size[np.setdiff1d(np.arange(6), freedoms(problem.legs.frame_legs))] = 0.0
    best, least = _settled(problem, state, loss)
    least = _BETTER * least
    for _ in range(_DRAWN):
        moved = state.platform_pose.moved(size * rng.normal(size=(n, len(size))))
        there = LegConstraints(problem.parameters).with_poses(state, moved)
        there, cost = _settled(problem, there, loss)
        best = best.with_chosen(cost < least, there.platform_pose)
        least = np.fmin(cost, least)
    return best


def have_outliers(problem: FitProblem, state: State) -> bool:
    """Say whether a pose at a minimum suits its measurements far worse than most do theirs."""
    loss = PseudoHuber(_width(problem, state))
    cost = _costs(problem, linearize(problem, state), loss, len(state.platform_pose.t))
    judged = cost[_are_determined(problem, state)]
    return bool(np.any(judged > _OUTLYING * np.median(cost)))


def _softened(problem: FitProblem, part: float, length: float) -> FitProblem:
    """Return the problem with a part of the errors of a nominal model added to the noise.

    The mean leg length is *length* [m].
    """
    off_m = part * _MODEL_LENGTH * length
    noise = NoiseModel(1.0, part * _MODEL_PX, part * _MODEL_PX)
    readings, of_actuators = problem.factor("readings"), problem.factor("actuator_readings")
    sigma = np.hypot(problem.readings.sigma, off_m)
    read, legs = problem.observed.actuator_readings, problem.legs.nominal
    off = np.array([legs[j].reading_of(off_m) for j in first_rods(legs)])
    own = np.hypot(read.sigma, off[read.actuator] if len(read) else 0.0)
    softer = (
        replace(readings, whitening=1.0 / sigma[:, None, None]),
        replace(of_actuators, whitening=1.0 / own[:, None, None]),
    )
    return problem.weighted(noise).with_parts((), softer)


def _width(problem: FitProblem, state: State) -> float:
    """Return the width of a loss that most measurements are inside."""
    linear = linearize(problem, state)
    norms = [
        np.sqrt(linear[factor.name].squared_norms)
        for factor in problem.factors
        if factor.robust and factor.n
    ]
    together = np.concatenate(norms) if norms else np.zeros(0)
    return _WIDTH * max(1.0, float(np.median(together)) if len(together) else 1.0)


@np.errstate(all="ignore")
def _settled(problem: FitProblem, state: State, loss: PseudoHuber) -> tuple[State, Array]:
    """Return a state with every pose at its own minimum, all else held, and their costs."""
    n = len(state.platform_pose.t)
    damping = np.full(n, _DAMPING)
    constraints = LegConstraints(problem.parameters)
    reach = state.posture_scale  # of a step
    linear = linearize(problem, state)
    cost = _costs(problem, linear, loss, n)
    for _ in range(_STEPS):
        # Where a leg is not before its camera nothing is finite, and the pose stays as it is.
        step = np.nan_to_num(normal_equations(problem, state, linear, loss).element_step(damping))
        own = step[problem.n_kept :].reshape(n, len(reach)) / reach
        own /= np.maximum(np.abs(own).max(axis=1, keepdims=True), 1.0)
        moved = constraints.with_poses(state, state.platform_pose.moved(own * reach))
        ahead = _costs(problem, linearize(problem, moved), loss, n)
        better = ahead < cost
        if np.all(ahead > _SLOW * cost) and np.all(better | (damping > 1.0)):
            break
        state = state.with_chosen(better, moved.platform_pose)
        damping = np.clip(np.where(better, 0.2 * damping, 8.0 * damping), 1e-9, 1e6)
        linear = linearize(problem, state)
        cost = _costs(problem, linear, loss, n)
    return state, cost


def _costs(problem: FitProblem, linear: Linearization, loss: PseudoHuber, n: int) -> Array:
    """Return what the measurements of each pose cost, (n,)."""
    found = np.zeros(n)
    for factor in problem.factors:
        if factor.element is None or not factor.n:
            continue
        s = linear[factor.name].squared_norms
        value = s / (1.0 + np.sqrt(1.0 + loss.k * s)) if factor.robust else 0.5 * s
        found += np.bincount(factor.element, value, minlength=n)
    return found
