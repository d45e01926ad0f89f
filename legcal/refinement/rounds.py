"""The rounds of a fit: solve wide, reject what disagrees, estimate the errors, solve again."""

from dataclasses import dataclass

import numpy as np

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array, BoolArray
from legcal.refinement.bias_scores import scores_of_shifts, with_shifts
from legcal.refinement.biases import (
    KINDS,
    N_KINDS,
    SharedShifts,
    estimated_shifts,
    possible_shifts,
    with_gamma,
)
from legcal.refinement.influence import explained_share
from legcal.refinement.judged_corners import with_judged_corners
from legcal.refinement.linearize import linearize, offsets_of
from legcal.refinement.loss import width_to_k
from legcal.refinement.minimise import Minimum, minimise, robust_cost
from legcal.refinement.noise import NoiseModel, estimate_noise, noise_of_the_median
from legcal.refinement.normal import information
from legcal.refinement.problem import FitProblem
from legcal.refinement.settings import RefinementSettings
from legcal.refinement.settling import NO_CHANGES, Changes, sizes, unsettled
from legcal.refinement.shifted import with_biases
from legcal.refinement.state import State
from legcal.refinement.steady import steadied

_BOARD_ROUNDS = 3
_NEAR_ENOUGH = 0.005  # of the cost a step: rejecting need not wait for the rest


@dataclass(frozen=True, eq=False)
class Fit:
    """A minimum with the errors and the outlines that it was fitted with.

    Attributes
    ----------
    problem : FitProblem
        With the shifts that outlines share, if they do.
    minimum : Minimum
    noise : NoiseModel
    shifts : SharedShifts
    accepted : (n_outlines,) array of bool
    iterations : int
    notes : tuple of str
        What the last round still changed, if that was more than it should.
    """

    problem: FitProblem
    minimum: Minimum
    noise: NoiseModel
    shifts: SharedShifts
    accepted: BoolArray
    iterations: int
    notes: tuple[str, ...]

    @property
    def state(self) -> State:
        """Where the fit ended."""
        return self.minimum.state


def first_minimum(problem: FitProblem, begin: State, settings: RefinementSettings) -> Minimum:
    """Solve with all observations and claimed covariances, kept near the nominal model.

    What is kept of the minimum, its cost and its derivatives, is without that knowledge.

    Raises
    ------
    DidNotConverge
        If the solver does not come to rest.
    """
    whitening = NoiseModel().whitening(problem.outlines.covariance)
    width, n_steps = settings.loss_width, settings.max_iterations
    steady = steadied(problem, begin)
    found = minimise(steady, begin, whitening, width, n_steps, _NEAR_ENOUGH)
    linear = linearize(problem, found.state, whitening)
    cost = robust_cost(linear, width_to_k(width))
    return Minimum(found.state, linear, cost, found.iterations)


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
        If a solve fails, most outlines or axes disagree with what was found, or the rounds do not
        settle.
    """
    claimed, noise = problem.outlines.covariance, NoiseModel()
    accepted = np.ones(len(claimed), dtype=np.bool_)
    possible = possible_shifts(problem.outlines, problem.legs.names)
    least = np.zeros(N_KINDS)
    least[: len(KINDS)] = [problem.choices.least_shared_px.get(kind, 0.0) for kind in KINDS]
    shifts = possible.of_sizes(with_gamma(np.zeros(N_KINDS)))
    problem, state = with_shifts(problem, first, shifts)

    def solved(near_enough: float = 0.0) -> Minimum:
        whitening = noise.whitening(claimed, accepted)
        width, n_steps = settings.loss_width, settings.max_iterations
        return minimise(problem, state, whitening, width, n_steps, near_enough)

    for _ in range(settings.rejection_rounds if len(claimed) else 0):
        before = accepted
        noise = noise_of_the_median(offsets_of(problem, state)[before], claimed[before])
        accepted = _accepted(problem, state, noise, settings)
        if np.array_equal(before, accepted):
            break
        minimum = solved(_NEAR_ENOUGH)
        state, iterations = minimum.state, iterations + minimum.iterations
    _refuse_disagreement(offsets_of(problem, state), accepted, settings)
    for _ in range(_BOARD_ROUNDS if len(problem.board) else 0):
        whitening = noise.whitening(claimed, accepted)
        problem = with_judged_corners(problem, state, whitening, settings)
        minimum = solved(_NEAR_ENOUGH)
        state, iterations = minimum.state, iterations + minimum.iterations
    asked, changes = with_biases(problem, possible), NO_CHANGES
    for _ in range(settings.noise_rounds if len(claimed) else 1):
        errors_before, accepted_before = sizes(noise, shifts), accepted
        noise = _noise(problem, state, noise, accepted, settings)
        accepted = _accepted(problem, state, noise, settings)
        minimum = solved()
        state, iterations = minimum.state, iterations + minimum.iterations
        if not accepted.any():
            break
        whitening = noise.whitening(claimed, accepted)
        scores = scores_of_shifts(problem, state, whitening, possible, asked)
        shifts = estimated_shifts(possible, *scores, least)
        if len(shifts) or len(state.biases):
            problem, state = with_shifts(problem, state, shifts)
            minimum = solved()
            state, iterations = minimum.state, iterations + minimum.iterations
        errors = sizes(noise, shifts)
        n_changed = int(np.sum(accepted != accepted_before))
        changes = Changes(errors_before, errors, n_changed, int(accepted.sum()))
        if changes.are_settled(settings):
            break
    _refuse_disagreement(offsets_of(problem, state), accepted, settings)
    _refuse_disagreeing_axes(minimum.linear.axes.squared_norms, settings)
    notes = unsettled(changes, claimed, settings)
    return Fit(problem, minimum, noise, shifts, accepted, iterations, notes)


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
    normal = information(problem, state, linear, width_to_k(settings.loss_width))
    L = np.linalg.cholesky(noise.covariance(claimed))
    share = explained_share(problem.couplings.outlines, linear.outlines, normal)
    explained = L @ share @ np.swapaxes(L, -1, -2)
    offsets = np.einsum("nij,nj->ni", L, linear.outlines.r)
    return estimate_noise(offsets[accepted], explained[accepted], claimed[accepted])


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
