"""The rounds of a fit: solve wide, reject what disagrees, estimate the noise, solve again."""

from dataclasses import dataclass

import numpy as np

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array, BoolArray
from legcal.refinement.covariance import explained_share
from legcal.refinement.inputs import evaluate, inputs_of
from legcal.refinement.loss import width_to_k
from legcal.refinement.noise import NoiseModel, estimate_noise, noise_of_the_median
from legcal.refinement.normal import information, linearize
from legcal.refinement.problem import FitProblem
from legcal.refinement.residuals import axis_residual, outline_residual
from legcal.refinement.settings import RefinementSettings
from legcal.refinement.solve import polish, solve
from legcal.refinement.state import State


@dataclass(frozen=True, eq=False)
class Fit:
    """A state with the noise and the outlines that it was fitted with."""

    state: State
    noise: NoiseModel
    accepted: BoolArray
    iterations: int


def first_minimum(
    problem: FitProblem, begin: State, settings: RefinementSettings
) -> tuple[State, int]:
    """Solve with all observations and claimed covariances: wide at first, then as all fits do.

    Parameters
    ----------
    problem : FitProblem
    begin : State
        Where to start.
    settings : RefinementSettings

    Returns
    -------
    state : State
        A minimum that depends on the start only if there are several.
    iterations : int
        Of IPOPT.

    Raises
    ------
    DidNotConverge
        If a solve fails.
    """
    claimed, noise = problem.outlines.covariance, NoiseModel()
    whitening = noise.whitening(claimed)
    s = noise.squared_norms(offsets_of(problem, begin), claimed)
    norms = np.sqrt(np.concatenate([s, squared_axis_norms(problem, begin)]))
    wide = max(settings.loss_width, float(np.median(norms))) if len(norms) else 1.0
    state, iterations = solve(problem, begin, whitening, width_to_k(wide))
    state, more = solve(problem, state, whitening, width_to_k(settings.loss_width))
    return state, iterations + more


def fit_in_rounds(
    problem: FitProblem, first: State, iterations: int, settings: RefinementSettings
) -> Fit:
    """Reject what disagrees until that settles, then estimate the noise and solve, in rounds.

    Outlines are rejected and their noise is estimated; of axes the claimed covariances are
    taken as they are, and the robust loss alone guards against wrong ones.

    Parameters
    ----------
    problem : FitProblem
    first : State
        What :func:`first_minimum` found.
    iterations : int
        What it needed.
    settings : RefinementSettings

    Returns
    -------
    Fit

    Raises
    ------
    DidNotConverge
        If a solve fails, or most outlines or axes disagree with what was found.
    """
    claimed, k, state = problem.outlines.covariance, width_to_k(settings.loss_width), first
    accepted, noise = np.ones(len(claimed), dtype=np.bool_), NoiseModel()
    for _ in range(settings.rejection_rounds if len(claimed) else 0):
        before = accepted
        noise = noise_of_the_median(offsets_of(problem, state)[before], claimed[before])
        accepted = _accepted(problem, state, noise, settings)
        if np.array_equal(before, accepted):
            break
        state, more = solve(problem, state, noise.whitening(claimed, accepted), k)
        iterations += more
    for _ in range(settings.noise_rounds if len(claimed) else 0):
        noise = _noise(problem, state, noise, accepted, settings)
        accepted = _accepted(problem, state, noise, settings)
        whitening = noise.whitening(claimed, accepted)
        state, more = solve(problem, state, whitening, k)
        state = polish(problem, state, whitening, k)
        iterations += more
    if len(claimed) == 0:
        state = polish(problem, state, noise.whitening(claimed), k)
    _refuse_disagreement(offsets_of(problem, state), accepted, settings)
    _refuse_disagreeing_axes(squared_axis_norms(problem, state), settings)
    return Fit(state, noise, accepted, iterations)


def _noise(
    problem: FitProblem,
    state: State,
    noise: NoiseModel,
    accepted: BoolArray,
    settings: RefinementSettings,
) -> NoiseModel:
    """Return the noise of the accepted outlines at a fit."""
    if not accepted.any():
        return noise
    claimed = problem.outlines.covariance
    linear = linearize(problem, state, noise.whitening(claimed, accepted))
    normal = information(problem, linear, width_to_k(settings.loss_width))
    L = np.linalg.cholesky(noise.covariance(claimed))
    explained = L @ explained_share(problem, linear, normal) @ np.swapaxes(L, -1, -2)
    offsets = np.einsum("nij,nj->ni", L, linear.outline_r)
    return estimate_noise(offsets[accepted], explained[accepted], claimed[accepted])


def offsets_of(problem: FitProblem, state: State) -> Array:
    """Return the offsets (n, 2) [px] of all outlines at a state."""
    unit = np.broadcast_to(np.eye(2), (len(problem.outlines), 2, 2))
    return evaluate(outline_residual(), inputs_of(problem, state, unit, 0.0)[0])


def squared_axis_norms(problem: FitProblem, state: State) -> Array:
    """Return the squared whitened norms (n,) of all axes at a state."""
    unused = np.zeros((len(problem.outlines), 2, 2))
    return np.asarray(
        np.sum(evaluate(axis_residual(), inputs_of(problem, state, unused, 0.0)[3]) ** 2, axis=-1)
    )


def _accepted(
    problem: FitProblem, state: State, noise: NoiseModel, settings: RefinementSettings
) -> BoolArray:
    """Return which outlines agree with a fit."""
    s = noise.squared_norms(offsets_of(problem, state), problem.outlines.covariance)
    return np.asarray(s <= settings.rejection**2)


def _refuse_disagreement(offsets: Array, accepted: BoolArray, settings: RefinementSettings) -> None:
    """Raise DidNotConverge where the fit does not pass through most of the outlines."""
    n, n_accepted = len(accepted), int(accepted.sum())
    rms = float(np.sqrt(np.mean(offsets[accepted] ** 2))) if n_accepted else 0.0
    if 2 * n_accepted < n or rms > settings.largest_rms_px:
        raise DidNotConverge(
            f"The fit of everything ended where {n - n_accepted} of {n} outlines disagree with it "
            f"and the others are {rms:.1f} px off; most must agree, to "
            f"{settings.largest_rms_px:g} px; check camera poses, readings and outlines."
        )


def _refuse_disagreeing_axes(s: Array, settings: RefinementSettings) -> None:
    """Raise DidNotConverge where the fit is not near most of the axes."""
    wrong = int(np.sum(s > settings.axis_disagreement**2))
    if 2 * wrong > len(s):
        raise DidNotConverge(
            f"The fit of everything ended where {wrong} of {len(s)} axes disagree with it by more "
            f"than {settings.axis_disagreement:g} of their standard deviations; most must agree; "
            "check the camera poses, the readings, and the units (rad, m) of axes and their sigmas."
        )
