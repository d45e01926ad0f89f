"""The rounds of a fit: solve wide, reject what disagrees, estimate the noise, solve again."""

from dataclasses import dataclass

import numpy as np

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array, BoolArray
from legcal.refinement.covariance import explained_share
from legcal.refinement.inputs import evaluate, inputs_of
from legcal.refinement.loss import efficiency, width_to_k
from legcal.refinement.noise import NoiseModel, estimate_noise, noise_of_the_median
from legcal.refinement.normal import information, linearize
from legcal.refinement.problem import FitProblem
from legcal.refinement.residuals import outline_residual
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


def fit_in_rounds(problem: FitProblem, begin: State, settings: RefinementSettings) -> Fit:
    """Solve wide, reject what disagrees until that settles, then estimate the noise and solve.

    Raises
    ------
    DidNotConverge
        If a solve fails, or most outlines disagree with what was found.
    """
    claimed = problem.outlines.covariance
    noise, k = NoiseModel(), width_to_k(settings.loss_width)
    first = noise.squared_norms(offsets_of(problem, begin), claimed)
    wide = max(settings.loss_width, float(np.sqrt(np.median(first)))) if len(first) else 1.0
    state, iterations = solve(problem, begin, noise.whitening(claimed), width_to_k(wide))
    accepted = np.ones(len(first), dtype=np.bool_)
    for _ in range(settings.rejection_rounds if len(first) else 0):
        before = accepted
        noise = noise_of_the_median(offsets_of(problem, state)[before], claimed[before])
        accepted = _accepted(problem, state, noise, settings)
        state, more = solve(problem, state, noise.whitening(claimed, accepted), k)
        iterations += more
        if np.array_equal(before, accepted):
            break
    for _ in range(settings.noise_rounds):
        noise = _noise(problem, state, noise, accepted, settings)
        accepted = _accepted(problem, state, noise, settings)
        whitening = noise.whitening(claimed, accepted)
        state, more = solve(problem, state, whitening, k)
        state = polish(problem, state, whitening, k)
        iterations += more
    _refuse_disagreement(offsets_of(problem, state), accepted, settings)
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
    normal = information(problem, linear, efficiency(width_to_k(settings.loss_width)))
    L = np.linalg.cholesky(noise.covariance(claimed))
    explained = L @ explained_share(problem, linear, normal) @ np.swapaxes(L, -1, -2)
    offsets = np.einsum("nij,nj->ni", L, linear.outline_r)
    return estimate_noise(offsets[accepted], explained[accepted], claimed[accepted])


def offsets_of(problem: FitProblem, state: State) -> Array:
    """Return the offsets (n, 2) [px] of all outlines at a state."""
    unit = np.broadcast_to(np.eye(2), (len(problem.outlines), 2, 2))
    return evaluate(outline_residual(), inputs_of(problem, state, unit, 0.0)[0])


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
