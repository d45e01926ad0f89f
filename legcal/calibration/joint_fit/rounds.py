"""Why outlines are rejected: by how much they disagree, and which other edge they lie on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from legcal.calibration.joint_fit.biases import (
    KINDS,
    N_KINDS,
    SharedShifts,
    estimated_shifts,
    possible_shifts,
    with_gamma,
)
from legcal.calibration.joint_fit.influence import explained_share, scores_of_shifts, with_shifts
from legcal.calibration.joint_fit.normal import information
from legcal.calibration.joint_fit.problem import (
    FitProblem,
    couple,
    linearize,
    offsets_of,
    with_biases,
)
from legcal.calibration.joint_fit.solver import Minimum, minimise, robust_cost, steadied
from legcal.calibration.joint_fit.state import RefinementSettings, State
from legcal.errors import DidNotConverge
from legcal.estimation import NoiseModel, estimate_noise, noise_of_the_median, width_to_k
from legcal.geometry import Array, BoolArray, IntArray
from legcal.vision import EPSILON

_MEDIAN_OF_2 = 2.0 * np.log(2.0)  # of the squared norm of two unit Gaussians
_LEAST_LEFT = 0.05  # of the equations of corners, beyond what the fit takes up
_SMALLEST_SCALE = 0.1
_NAMED = 4


def with_judged_corners(
    problem: FitProblem, state: State, whitening: Array, settings: RefinementSettings
) -> FitProblem:
    """Return a problem whose corners have the errors that residuals show, without wrong ones.

    Parameters
    ----------
    problem : FitProblem
    state : State
        Near a minimum.
    whitening : (n_outlines, 2, 2) array
        Of the outlines, zero for rejected ones [1/px].
    settings : RefinementSettings

    Raises
    ------
    DidNotConverge
        If most corners disagree with the fit.
    """
    board, of = problem.board, problem.couplings
    linear = linearize(problem, state, whitening)
    normal = information(problem, state, linear, width_to_k(settings.loss_width))
    share = explained_share(of.corners, linear.corners, normal)
    left = 1.0 - 0.5 * np.einsum("nqq->n", share)
    norms = linear.corners.squared_norms
    variance = float(np.median(norms)) / _MEDIAN_OF_2 / max(float(np.mean(left)), _LEAST_LEFT)
    scale = max(float(np.sqrt(variance)), _SMALLEST_SCALE)
    agrees = norms <= (scale * settings.rejection) ** 2
    kept = board.chosen(agrees).with_scale(scale)
    rejected = (
        *problem.rejected_corners,
        *zip(board.view[~agrees].tolist(), board.corner[~agrees].tolist(), strict=True),
    )
    rms = float(np.sqrt(np.mean((linear.corners.r * board.sigma[:, None]) ** 2)))
    if len(rejected) > len(kept) or np.median(norms * board.sigma**2) > settings.largest_rms_px**2:
        raise DidNotConverge(
            f"The fit of everything ended where the corners of the calibration board are "
            f"{rms:.1f} px off (rms), needed {settings.largest_rms_px:g} px for most; check that "
            "the board stood still, its dimensions, and the camera files."
        )
    couplings = couple(problem.layout, problem.outlines, problem.readings, problem.axes, kept)
    return replace(problem, board=kept, rejected_corners=rejected, couplings=couplings)


def corner_notes(problem: FitProblem) -> tuple[str, ...]:
    """Return what is to be said of corners that were left out, one sentence."""
    rejected = problem.rejected_corners
    if not rejected:
        return ()
    views = problem.outlines.views
    named = [f"{corner} in {views[view]}" for view, corner in sorted(rejected)[:_NAMED]]
    more = f" and {len(rejected) - _NAMED} more" if len(rejected) > _NAMED else ""
    n = len(rejected) + len(problem.board)
    return (
        f"Of {n} corners of the calibration board {len(rejected)} disagree with the fit and were "
        f"left out: {', '.join(named)}{more}.",
    )


_ROUNDED_PX = 1e-3  # smaller errors of outlines do not matter
_FURTHEST = 0.5  # of the largest error of outlines, in the last round
_MOST_CHANGED = 0.05  # of the accepted outlines


@dataclass(frozen=True, eq=False)
class Changes:
    """What a round changed.

    Attributes
    ----------
    before, after : (n,) array
        Standard deviations of the errors of outlines, as :func:`sizes` has them.
    n_changed : int
        Outlines that were accepted and are not, or the other way round.
    n_accepted : int
        Outlines that are accepted after it.
    """

    before: Array
    after: Array
    n_changed: int
    n_accepted: int

    def are_settled(self, settings: RefinementSettings) -> bool:
        """Say whether another round would change nothing that matters."""
        near = np.allclose(self.after, self.before, rtol=settings.settled, atol=_ROUNDED_PX)
        return near and self.n_changed <= settings.settled * self.n_accepted


NO_CHANGES = Changes(np.zeros(0), np.zeros(0), 0, 0)


def sizes(noise: NoiseModel, shifts: SharedShifts) -> Array:
    """Return all standard deviations of errors in one vector: a factor, the others [px]."""
    return np.array([noise.scale, noise.bias_px, noise.tilt_px, *shifts.sigma[: len(KINDS)]])


def unsettled(changes: Changes, claimed: Array, settings: RefinementSettings) -> tuple[str, ...]:
    """Return what the last round changed though it should have left it, nothing if it did.

    Parameters
    ----------
    changes : Changes
        Of the last round.
    claimed : (n, 2, 2) array
        Claimed covariances of the outlines [px^2].
    settings : RefinementSettings

    Raises
    ------
    DidNotConverge
        If that is a lot.
    """
    if changes.are_settled(settings):
        return ()
    unit = np.ones(len(changes.after))
    unit[0] = np.sqrt(0.5 * np.mean(np.trace(claimed, axis1=1, axis2=2)))
    before, after = unit * changes.before, unit * changes.after
    i = int(np.argmax(np.abs(after - before)))
    found = (
        f"the last round accepted or rejected {changes.n_changed} outlines anew, with "
        f"{changes.n_accepted} accepted, and changed the standard deviation of one kind of error "
        f"from {before[i]:.3f} px to {after[i]:.3f} px"
    )
    largest = max(float(before.max()), float(after.max()))
    most_changed = _MOST_CHANGED * changes.n_accepted
    if abs(after[i] - before[i]) > _FURTHEST * largest or changes.n_changed > most_changed:
        raise DidNotConverge(
            "The fit of everything could not settle which outlines are right and how large their "
            f"errors are: found that {found}, needed hardly any change; add images, or correct "
            "outlines that are wrong."
        )
    return (
        "The errors of the outlines are not quite settled, and the uncertainty of the result is "
        f"that unsure: {found}.",
    )


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


DISAGREES = "disagrees with the fit"  # the beginning of a reason
_ON_AN_EDGE = 1.5  # [px] at both ends
_MUCH_NEARER = 0.25  # of the distance from the outline that it was taken for


def rejection_reasons(
    problem: FitProblem, state: State, rejected: IntArray, offsets: Array
) -> list[str]:
    """Return why outlines disagree with a fit, in words.

    Parameters
    ----------
    problem : FitProblem
    state : State
        Where the fit ended.
    rejected : (m,) array of int
        The rejected ones of the problem's outlines.
    offsets : (n, 2) array
        How far both ends of all outlines are from where the fit puts them [px].
    """
    away = np.abs(offsets[rejected]).max(axis=1, initial=0.0)
    reasons = [f"{DISAGREES} by {distance:.1f} px" for distance in away.tolist()]
    names, from_edges = _distances_from_edges(problem, state, rejected)
    for i, distances in enumerate(from_edges):
        nearest = int(np.argmin(distances))
        if distances[nearest] < min(_ON_AN_EDGE, _MUCH_NEARER * away[i]):
            reasons[i] += f", lies on {names[nearest]}"
    return reasons


def _distances_from_edges(
    problem: FitProblem, state: State, rejected: IntArray
) -> tuple[list[str], Array]:
    """Return the names of all edges, and how far (m, n_edges) outlines are from each [px]."""
    o, names = problem.outlines, problem.legs.names
    part = np.repeat(np.arange(len(o.parts)), len(EPSILON))
    epsilon = np.tile(EPSILON, len(o.parts))
    edges = [
        f"edge {edge + 1} of {names[leg]}.{link}"
        for leg, link in o.parts
        for edge in range(len(EPSILON))
    ]
    outline, edge = np.repeat(rejected, len(edges)), np.tile(np.arange(len(edges)), len(rejected))
    constants = o.constants[outline].copy()
    constants[:, 8] = epsilon[edge]
    as_others = replace(
        o,
        index=o.index[outline],
        leg=np.array([leg for leg, _ in o.parts], dtype=np.intp)[part[edge]],
        view=o.view[outline],
        pose=o.pose[outline],
        radius=part[edge],
        feet=o.feet[outline],
        pixels=o.pixels[outline],
        constants=constants,
        covariance=o.covariance[outline],
        by_gamma=o.by_gamma[outline],
        bias_index=np.zeros((len(outline), 0), dtype=np.intp),
        bias_shift=np.zeros((len(outline), 0, 2)),
    )
    away = np.abs(offsets_of(replace(problem, outlines=as_others), state)).max(axis=1, initial=0.0)
    return edges, away.reshape(len(rejected), len(edges))
