"""Search for better platform poses: the best of several starts per pose.

Where readings do not determine a pose, a few lines in an image are consistent with several, and the
joint fit converges to the nearest. Each pose is therefore searched from random starts with cameras
and legs fixed, before the fit and again after its first minimum. Errors of the nominal model count
as noise. Where readings determine a pose, another assembly mode has the same readings.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legcal.calibration.joint_fit.outline_errors import NoiseModel
from legcal.calibration.joint_fit.problem import FitLinear, FitProblem
from legcal.calibration.joint_fit.variables import LegConstraints, State
from legcal.calibration.tuning import OUTLIER_POSE_COST
from legcal.estimation.loss import PseudoHuber
from legcal.estimation.problem import Frames, GaussianPrior, linearize
from legcal.estimation.solver import minimise, normal_equations
from legcal.geometry.types import Array, BoolArray
from legcal.machine.closing import solve_poses
from legcal.machine.equations import freedoms, pose_equations

_SEED, _N_DRAWS = 1965, 16  # random starts of every pose, besides its present value
_TURN, _SHIFT = 0.4, 0.3  # standard deviation of random starts [rad, mean leg lengths]
_STEPS = 25  # iterations for a pose
_DAMPING, _SLOW = 1e-3, 0.999  # first damping; ratio of costs of a step without progress
_MODEL_PX, _MODEL_LENGTH = 2.0, 0.005  # errors of the nominal model [px], mean leg lengths
_WIDTH = 3.0  # width of the loss in median residuals
_RANK = 1e-6  # relative to the largest singular value
_OPEN = 0.1  # mean leg lengths or rad: least uncertainty of an undetermined pose
_BETTER = 0.5  # ratio of costs, below which another pose is accepted


def are_free(problem: FitProblem, state: State) -> bool:
    """Whether readings and legs do not determine platform poses."""
    columns = list(freedoms(problem.legs.frame_legs))
    R, t, q = (x[:1] for x in state.platform_pose)
    rows = pose_equations(state.legs, R, t, by_local=False, q=q if q.shape[1] else None)
    by_pose = rows.by_pose[0][:, columns] / np.where(np.array(columns) < 3, state.mean_length, 1.0)
    return len(by_pose) == 0 or int(np.linalg.matrix_rank(by_pose, tol=_RANK)) < len(columns)


def of_determined_poses(problem: FitProblem, state: State, accepted: BoolArray) -> BoolArray:
    """Mask of accepted outlines (n,) in images that determine their pose, with the readings.

    Otherwise the pose drifts along the directions that its few legs leave open, without end. Such
    images carry little information on the machine and are left out.
    """
    element = problem.factor("outlines").element
    if element is None or not are_free(problem, state):
        return accepted
    return np.asarray(accepted & _are_determined(problem, state)[element])


def _are_determined(problem: FitProblem, state: State) -> BoolArray:
    """Mask of poses determined by their measurements, (n_poses,)."""
    V = normal_equations(linearize(problem, state)).V
    moving = np.any(np.einsum("kff->kf", V) > 0.0, axis=0)
    least = np.linalg.eigvalsh(V[:, moving][:, :, moving])[:, 0]
    return np.asarray(least * (_OPEN * state.mean_length) ** 2 > 1.0)


def with_free_poses(problem: FitProblem, state: State) -> State:
    """Improve the poses of a start, then cameras and legs, with a prior on the legs."""
    n, length = problem.n_kinematic, state.mean_length
    soft = _with_model_noise(problem, 1.0, length)
    unit = np.array([length if unit == "m" else 1.0 for unit in problem.units[:n]])
    legs = problem.block("legs")
    near = GaussianPrior(np.arange(n, dtype=np.intp), legs.read(state.legs), _MODEL_LENGTH * unit)
    soft = soft.with_parts((replace(legs, prior=legs.prior + near),), ())
    for seed in range(2):
        state = with_better_poses(soft, state, seed=seed)
        loss = PseudoHuber(_loss_width(linearize(soft, state)))
        state = minimise(soft, state, loss, max_iterations=40, must_converge=False).state
    return state


def with_better_poses(problem: FitProblem, state: State, part: float = 0.0, seed: int = 0) -> State:
    """Replace poses by ones with a much lower cost, all other variables fixed.

    *part* of the errors of a nominal model counts as noise.
    """
    problem = _with_model_noise(problem, part, state.mean_length) if part else problem
    loss = PseudoHuber(_loss_width(linearize(problem, state)))
    rng, n = np.random.default_rng((_SEED, seed)), len(state.platform_pose.t)
    spread = _spread_of_starts(problem, state)
    best, least = _minimise_poses(problem, state, loss)
    least = _BETTER * least
    for _ in range(_N_DRAWS):
        moved = state.platform_pose.moved(spread * rng.normal(size=(n, len(spread))))
        candidate = LegConstraints(problem.parameters).with_poses(state, moved)
        candidate, cost = _minimise_poses(problem, candidate, loss)
        best = best.with_chosen(cost < least, candidate.platform_pose)
        least = np.fmin(cost, least)
    return best


def in_other_assembly_modes(problem: FitProblem, state: State, part: float) -> State:
    """Move poses with a far larger cost than most to another assembly mode, if that fits better.

    Other poses with the same readings are found by forward kinematics from random starts, with
    cameras and legs fixed. *part* of the errors of a nominal model counts as noise.
    """
    rows = np.flatnonzero(outlier_poses(problem, state))
    if len(rows) == 0:
        return state
    problem = _with_model_noise(problem, part, state.mean_length)
    loss = PseudoHuber(_loss_width(linearize(problem, state)))

    def cost_at(trial: State) -> Array:
        return _cost_of_poses(linearize(problem, trial), loss)

    rng, now = np.random.default_rng(_SEED), state.platform_pose.frames
    several = np.tile(rows, _N_DRAWS)
    steps = rng.normal(size=(len(several), 6)) * _spread_of_starts(problem, state)[:6]
    starts = Frames(now.R[several], now.t[several]).moved(steps)
    solved = solve_poses(state.legs, problem.legs.frame_legs, *starts, problem.lengthening[several])
    best, least = state, _BETTER * cost_at(state)
    for draw in range(_N_DRAWS):
        drawn = slice(draw * len(rows), (draw + 1) * len(rows))
        R, t = now.R.copy(), now.t.copy()
        R[rows], t[rows] = solved.R[drawn], solved.t[drawn]
        postures = problem.postures(state.legs, Frames(R, t).motions)
        trial = LegConstraints(problem.parameters).with_poses(state, postures)
        cost = cost_at(trial)
        best = best.with_chosen(cost < least, trial.platform_pose)
        least = np.fmin(cost, least)
    return best


def have_outliers(problem: FitProblem, state: State) -> bool:
    """Whether a pose at a minimum has a far larger cost than most."""
    return bool(outlier_poses(problem, state).any())


def outlier_poses(problem: FitProblem, state: State) -> BoolArray:
    """Mask of determined poses with a far larger cost than most at a minimum, (n_poses,)."""
    linear = linearize(problem, state)
    cost = _cost_of_poses(linear, PseudoHuber(_loss_width(linear)))
    is_large = cost > OUTLIER_POSE_COST * np.median(cost)
    if not is_large.any():
        return np.asarray(is_large)
    return np.asarray(is_large & _are_determined(problem, state))


def _spread_of_starts(problem: FitProblem, state: State) -> Array:
    """Spread of the random starts of a posture, (6 + n,): standard deviations [rad, m]."""
    spread = np.zeros(problem.d_element)  # readings of a posture follow from its pose
    spread[:6] = np.repeat([_TURN, _SHIFT * state.mean_length], 3)
    spread[np.setdiff1d(np.arange(6), freedoms(problem.legs.frame_legs))] = 0.0
    return spread


def _with_model_noise(problem: FitProblem, part: float, length: float) -> FitProblem:
    """Add *part* of the errors of a nominal model to the noise; *length* is a leg's [m]."""
    off_m = part * _MODEL_LENGTH * length
    noise = NoiseModel(1.0, part * _MODEL_PX, part * _MODEL_PX)
    readings, legs = problem.readings, problem.legs.nominal
    off = [legs[j].reading_of(off_m) for j in readings.leg.tolist()]
    whitening = 1.0 / np.hypot(readings.sigma, off)[:, None, None]
    softened = replace(problem.factor("readings"), whitening=whitening)
    return problem.weighted(noise).with_factors(softened)


def _loss_width(linear: FitLinear) -> float:
    """Width of the loss in which most residuals are inliers."""
    norms = [
        np.sqrt(linear[factor.name].squared_norms)
        for factor in linear.problem.factors
        if factor.robust and factor.n
    ]
    together = np.concatenate(norms) if norms else np.zeros(0)
    return _WIDTH * max(1.0, float(np.median(together)) if len(together) else 1.0)


@np.errstate(all="ignore")
def _minimise_poses(problem: FitProblem, state: State, loss: PseudoHuber) -> tuple[State, Array]:
    """Minimise over each pose, all other variables fixed; return the state and costs (n_poses,)."""
    n = len(state.platform_pose.t)
    damping = np.full(n, _DAMPING)
    constraints = LegConstraints(problem.parameters)
    step_limit = state.posture_scale
    linear = linearize(problem, state)
    cost = _cost_of_poses(linear, loss)
    for _ in range(_STEPS):
        # Steps are not finite where a leg is behind its camera; such a pose stays.
        step = np.nan_to_num(normal_equations(linear, loss).element_step(damping))
        scaled_step = step[problem.n_kept :].reshape(n, len(step_limit)) / step_limit
        scaled_step /= np.maximum(np.abs(scaled_step).max(axis=1, keepdims=True), 1.0)
        moved = constraints.with_poses(state, state.platform_pose.moved(scaled_step * step_limit))
        trial_cost = _cost_of_poses(linearize(problem, moved), loss)
        better = trial_cost < cost
        if np.all(trial_cost > _SLOW * cost) and np.all(better | (damping > 1.0)):
            break
        state = state.with_chosen(better, moved.platform_pose)
        damping = np.clip(np.where(better, 0.2 * damping, 8.0 * damping), 1e-9, 1e6)
        linear = linearize(problem, state)
        cost = _cost_of_poses(linear, loss)
    return state, cost


def _cost_of_poses(linear: FitLinear, loss: PseudoHuber) -> Array:
    """Robust cost of the measurements of each pose, (n,)."""
    costs = np.zeros(linear.problem.n_elements)
    for factor in linear.problem.factors:
        if factor.element is None or not factor.n:
            continue
        s = linear[factor.name].squared_norms
        value = s / (1.0 + np.sqrt(1.0 + loss.k * s)) if factor.robust else 0.5 * s
        costs += np.bincount(factor.element, value, minlength=len(costs))
    return costs
