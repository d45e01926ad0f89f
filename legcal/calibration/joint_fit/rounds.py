"""From the first minimum to the final one: outlier rejection and estimation of noise, in rounds.

Rounds reject outliers until the set of inliers is stable. They start at the minimum of all
outlines, and weights are a smooth function of the distance, so that an outline never stays rejected
only because it was rejected before. Then the noise of outlines and the variances of common-mode
edge biases are estimated by restricted maximum likelihood and the fit is repeated, until
convergence. The last fit uses posterior means of these variances, since the likeliest values are
too small on average.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from legcal.calibration.joint_fit.determinacy import HeldDirections, held_at_nominal
from legcal.calibration.joint_fit.free_poses import of_determined_poses
from legcal.calibration.joint_fit.outlier_readings import (
    reject_outlier_readings,
    restore_inlier_readings,
    with_inflated_reading_noise,
    with_rejected_readings_of,
)
from legcal.calibration.joint_fit.outline_errors import (
    KINDS,
    MEDIAN_OF_1,
    MEDIAN_OF_2,
    N_KINDS,
    PLACES,
    EdgeBiases,
    NoiseModel,
    estimate_noise,
    estimated_biases,
    expected_biases,
    least_at_places,
    least_in_views,
    possible_biases,
    robust_noise,
    shifts_at_places,
    sigmas_at_places,
    with_gamma,
)
from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.variables import RefinementSettings, State
from legcal.calibration.tuning import FIRST_MINIMUM_SIGMA, REJECTION_TAPER
from legcal.data.reasons import Reason, Rejection
from legcal.errors import DidNotConverge
from legcal.estimation.problem import GaussianPrior, linearize
from legcal.estimation.solver import Minimum, information, minimise, normal_equations, robust_cost
from legcal.estimation.uncertainty import leverage, response, score_test, scores_of_block
from legcal.files.schema import few
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.vision.cylinder import EPSILON

_BOARD_ROUNDS = 3
_READING_ROUNDS = 8  # each rejects at most one reading per pose
_REJECTION_TOLERANCE = 0.005  # relative decrease of the cost, in rounds that reject outliers
_INTERMEDIATE_TOLERANCE = 1e-6  # tolerance of intermediate minima, in squared sigmas
_ACCEPTED = 0.5  # weight at the rejection distance
_MIN_REDUNDANCY = 0.05  # mean redundancy of corners
_MIN_SCALE = 0.1
_MIN_ERROR_PX = 1e-3  # absolute tolerance of standard deviations of errors
_MAX_ERROR_CHANGE = 0.5  # of the largest error of outlines, in the last round
_TURNS_OF_NOISE = 4  # rounds after which noise keeps its kinds
_MAX_CHANGED = 0.05  # of the accepted outlines


@dataclass(frozen=True, eq=False)
class Fit:
    """A minimum with the noise, biases and weights of its outlines."""

    problem: FitProblem  # with the common-mode biases
    minimum: Minimum[State]
    noise: NoiseModel
    edge_biases: EdgeBiases
    weight: Array  # (n_outlines,) from 1 for inliers to 0 for outliers
    # Errors that the fit absorbs, not estimated as biases: their sizes by kind [px], and what they
    # add to the covariance of the kept unknowns; None without any
    absorbed: tuple[dict[str, float], Array] | None = None
    notes: tuple[str, ...] = ()  # changes of the last round, if not converged
    edge_scale: float = 1.0  # of the standard deviations of edges of bodies

    @property
    def state(self) -> State:
        """State at the minimum."""
        return self.minimum.state

    @cached_property
    def accepted(self) -> BoolArray:
        """Mask of inlier outlines, (n_outlines,)."""
        return np.asarray(self.weight >= _ACCEPTED)

    def weighted(self, noise: NoiseModel) -> Fit:
        """Set the noise of outlines, and weight them anew."""
        weight = _weights(self.problem, self.state, noise)
        problem = self.problem.weighted(noise, weight)
        return replace(self, problem=problem, noise=noise, weight=weight)

    def with_edge_biases(self, biases: EdgeBiases) -> Fit:
        """Replace the common-mode edge biases."""
        problem, state = with_edge_biases(self.problem, self.state, biases)
        minimum = replace(self.minimum, state=state)
        return replace(self, problem=problem, minimum=minimum, edge_biases=biases)

    def reoptimised(self, relative_tolerance: float = 0.0) -> Fit:
        """Approach the minimum of the problem from the minimum for other weights."""
        return replace(
            self, minimum=_approach_minimum(self.problem, self.minimum, relative_tolerance)
        )

    @property
    def shared_px(self) -> dict[str, float]:
        """Standard deviations of common-mode errors by kind [px]."""
        return self.edge_biases.sizes | ({} if self.absorbed is None else self.absorbed[0])


def first_minimum(
    problem: FitProblem, begin: State, *, must_converge: bool = True
) -> Minimum[State]:
    """Solve with all observations and claimed covariances, regularised towards the nominal model.

    Steps along open directions are free and would not stop: axes of a translational 3-UPU end half
    a radian off, where other directions look determined. Nominal models are not wrong by a large
    part of a leg. The returned cost and derivatives are without this prior. Without
    *must_converge*, the best state is returned if the steps do not converge.
    """
    original, all_outlines = problem, np.ones(len(problem.outlines), dtype=np.bool_)
    is_rough = problem.legs.is_redundant
    claimed = with_inflated_reading_noise(problem.weighted(NoiseModel()))
    chosen = of_determined_poses(claimed, begin, all_outlines)
    problem, loss = claimed.weighted(NoiseModel(), chosen), claimed.loss
    legs, n = problem.legs, problem.n_kinematic
    nominal = legs.vector(legs.nominal)[problem.free]
    length = begin.mean_length
    metre = np.array([1.0 if unit == "m" else 1.0 / length for unit in problem.units[:n]])
    nominal_prior = GaussianPrior(
        np.arange(n, dtype=np.intp), nominal, FIRST_MINIMUM_SIGMA * length * metre
    )
    block = problem.block("legs")
    regularised = problem.with_parts((replace(block, prior=block.prior + nominal_prior),), ())
    minimum = minimise(
        regularised,
        begin,
        loss,
        max_iterations=problem.settings.max_iterations,
        tolerance=_INTERMEDIATE_TOLERANCE,
        relative_tolerance=_REJECTION_TOLERANCE,
        must_converge=must_converge,
    )
    determined = of_determined_poses(claimed, minimum.state, all_outlines)
    problem = original.weighted(NoiseModel(), determined)
    linear = linearize(problem, minimum.state)
    cost = robust_cost(linear, loss)
    if is_rough:  # one wrong reading would outweigh all else
        rough = with_inflated_reading_noise(problem)
        cost = robust_cost(linearize(rough, minimum.state), loss)
    return Minimum(minimum.state, linear, cost, minimum.iterations)


def fit_in_rounds(problem: FitProblem, first: Minimum[State], held: HeldDirections) -> Fit:
    """Reject outliers until the inliers are stable, then estimate noise and fit, in rounds.

    *first* is the result of :func:`first_minimum`. Directions in *held* are set to nominal first,
    and the first minimum is computed again. Readings of redundant motors that contradict
    each other in many images bend a fit until outlines contradict it: they get rough standard
    deviations then, so that what is wrong with them can be named.

    Raises DidNotConverge if a minimisation fails, most outlines are outliers, or the rounds do not
    converge.
    """
    if len(held.basis):
        problem, state = held_at_nominal(problem, first.state, held)
        continued = first_minimum(problem, state)
        first = replace(continued, iterations=first.iterations + continued.iterations)
    try:
        return _fit_in_rounds(problem, first)
    except DidNotConverge:
        if not problem.legs.is_redundant:
            raise
        rough = with_inflated_reading_noise(problem)
        return _fit_in_rounds(rough, replace(first, linear=linearize(rough, first.state)))


def _fit_in_rounds(problem: FitProblem, first: Minimum[State]) -> Fit:
    """Fit with the noise of readings as it is."""
    possible = possible_biases(problem.outlines, problem.legs.names)
    least = np.zeros(N_KINDS)
    least[: len(KINDS)] = [problem.choices.least_shared_px.get(kind, 0.0) for kind in KINDS]
    none = possible.of_sizes(with_gamma(np.zeros(N_KINDS)))
    all_weights = np.ones(len(problem.outlines))
    begin = Fit(problem, first, NoiseModel(), none, all_weights).with_edge_biases(none)
    fit, changes = _with_estimated_errors(_without_outliers(begin), possible, least)
    if fit.edge_biases.are_shown:
        scores = _scores_of_biases(fit, possible)
        fit = fit.with_edge_biases(expected_biases(possible, *scores, fit.edge_biases, least))
    fit = replace(fit, minimum=_minimise_near(fit.problem, fit.minimum))
    _refuse_disagreement(fit)
    return replace(
        fit,
        absorbed=_absorbed_errors(fit, possible),
        notes=check_convergence(changes, problem.outlines.covariance, problem.settings),
    )


def _without_outliers(fit: Fit) -> Fit:
    """Reject outliers among readings, outlines and corners, with a robust noise estimate."""
    given, settings, claimed = fit.problem, fit.problem.settings, fit.problem.outlines.covariance
    # Wrong readings go first, before they bias the fit: the first minimum has inflated noise.
    if given.legs.is_redundant:
        rough, tolerance = with_inflated_reading_noise(given), _REJECTION_TOLERANCE
        rough, minimum = _without_wrong_readings(rough, rough, fit.minimum, tolerance)
        fit = replace(
            fit, problem=with_rejected_readings_of(given, rough), minimum=minimum
        ).reoptimised(tolerance)
    for _ in range(settings.rejection_rounds if len(claimed) else 0):
        before, offsets = fit.accepted, fit.problem.offsets(fit.state)
        fit = fit.weighted(robust_noise(offsets[before], claimed[before]))
        if np.sum(before != fit.accepted) <= settings.error_tolerance * fit.accepted.sum():
            break  # left to the rounds of noise estimation
        fit = fit.reoptimised(_REJECTION_TOLERANCE)
    _refuse_disagreement(fit)
    for _ in range(_BOARD_ROUNDS if any(map(len, given.boards)) else 0):
        judged = _with_corner_noise(fit.problem, fit.state)
        fit = replace(fit, problem=judged).reoptimised(_REJECTION_TOLERANCE)
    if given.legs.is_redundant:
        fit = fit.reoptimised()
        problem, minimum = _without_wrong_readings(fit.problem, given, fit.minimum)
        fit = replace(fit, problem=problem, minimum=minimum)
    return fit


def _with_estimated_errors(fit: Fit, possible: EdgeBiases, least: Array) -> tuple[Fit, Changes]:
    """Estimate noise and common-mode biases and fit, until convergence; also return last changes.

    *possible* are the candidate biases, *least* (N_KINDS,) lower bounds of their sizes.
    """
    settings, changes, are_white = fit.problem.settings, NO_CHANGES, False
    fit = _linearized(fit)
    for turn in range(settings.noise_rounds if len(fit.accepted) else 1):
        # Two kinds of noise that are told apart by a hair would take turns.
        included = fit.noise if turn >= _TURNS_OF_NOISE else NoiseModel()
        before, fit = fit, _with_edge_noise(fit.weighted(_noise(fit, included)))
        changes = Changes.of(before, fit)
        if are_white and changes.converged(settings):
            fit = _linearized(fit)
            break
        if fit.accepted.any():
            biases = estimated_biases(
                possible, *_scores_of_biases(fit, possible), least, near=fit.edge_biases
            )
            are_white = not len(biases) and not len(fit.state.biases)
            fit = fit.with_edge_biases(biases)
        fit = fit.reoptimised()
        if not fit.accepted.any():
            break
        changes = Changes.of(before, fit)
        if changes.converged(settings):
            break
    return fit, changes


def _linearized(fit: Fit) -> Fit:
    """Linearise with the present weights."""
    linear = linearize(fit.problem, fit.state)
    return replace(fit, minimum=replace(fit.minimum, linear=linear))


def _scores_of_biases(fit: Fit, possible: EdgeBiases) -> tuple[Array, Array]:
    """Scores of all candidate biases at the minimum for the noise of a fit."""
    return scores_of_block(linearize(*with_edge_biases(fit.problem, fit.state, possible)), "biases")


def _without_wrong_readings(
    problem: FitProblem,
    complete: FitProblem,
    minimum: Minimum[State],
    relative_tolerance: float = 0.0,
) -> tuple[FitProblem, Minimum[State]]:
    """Reject wrong readings and minimise, until none is left.

    Readings of the *complete* problem that agree after the others are rejected are restored, once.
    """
    may_restore = True
    for _ in range(_READING_ROUNDS):
        problem, is_changed = reject_outlier_readings(problem, minimum.state)
        if not is_changed and may_restore:
            problem, is_changed = restore_inlier_readings(problem, complete, minimum.state)
            may_restore = False
        if not is_changed:
            break
        minimum = _approach_minimum(problem, minimum, relative_tolerance)
    return problem, minimum


def _absorbed_errors(fit: Fit, possible: EdgeBiases) -> tuple[dict[str, float], Array] | None:
    """Return errors that the fit absorbs, and their effect on the covariance; None without any.

    Errors at places are estimated where residuals show biases at all; those of polished parts are
    there anyway. In photographs, biases of a leg in a view have a least size beside their estimate,
    and edges of bodies errors that they keep in all images of a view.
    """
    problem, linear = fit.problem, fit.minimum.linear
    whitening, o = problem.factor("outlines").whitening, problem.outlines
    sizes, shifts = dict[str, float](), [np.zeros((len(o), 2, 0))]
    if fit.edge_biases.are_shown or o.polished:
        at_places = shifts_at_places(o, fit.accepted)
        sigma = least_at_places(o, at_places)
        if fit.edge_biases.are_shown and at_places.size:
            columns = {"outlines": whitening @ at_places}
            shown = sigmas_at_places(*score_test(normal_equations(linear), columns))
            sigma = np.maximum(np.repeat(shown, at_places.shape[2] // len(shown)), sigma)
        if sigma.any():
            shifts.append(at_places * sigma)
            mean = np.sqrt(np.mean(sigma.reshape(len(PLACES), -1) ** 2, axis=1))
            sizes |= dict(zip(PLACES, mean.tolist(), strict=True))
    if problem.choices.of_photographs:
        claimed = o.covariance[fit.accepted]
        least = np.maximum(least_in_views(fit.noise, claimed), fit.edge_biases.sigma)
        beyond = possible.of_sizes(np.sqrt(least**2 - fit.edge_biases.sigma**2))
        if len(beyond):
            shifts.append(beyond.shifts)
            sizes |= beyond.of_sizes(least).sizes
    errors = problem.unknown_errors(np.concatenate(shifts, axis=2))
    if not any(columns.any() for columns in errors.values()):
        return None
    moved = response(information(linear, problem.loss), errors)
    return sizes, moved @ moved.T


def _approach_minimum(
    problem: FitProblem, near: Minimum[State], relative_tolerance: float = 0.0
) -> Minimum[State]:
    """Approach the minimum of a problem from the minimum for other weights."""
    return _minimise_near(
        problem,
        near,
        tolerance=_INTERMEDIATE_TOLERANCE,
        relative_tolerance=relative_tolerance,
        rate=near.rate,
    )


def _minimise_near(problem: FitProblem, near: Minimum[State], **options: Any) -> Minimum[State]:
    """Minimise from a minimum nearby; iterations are added up."""
    minimum = minimise(
        problem,
        near.state,
        problem.loss,
        is_near=True,
        max_iterations=problem.settings.max_iterations,
        **options,
    )
    return replace(minimum, iterations=near.iterations + minimum.iterations)


def with_edge_biases(
    problem: FitProblem, state: State, biases: EdgeBiases
) -> tuple[FitProblem, State]:
    """Replace the biases of problem and state; biases of the same name keep their value."""
    value_of = dict(zip(problem.block("biases").labels, state.biases.tolist(), strict=True))
    values = np.array([value_of.get(name, 0.0) for name in biases.names])
    return problem.with_biases(biases), replace(state, biases=values)


def _noise(fit: Fit, included: NoiseModel) -> NoiseModel:
    """Estimate the noise of outlines at a fit, with the kinds of another included."""
    problem, linear, weight = fit.problem, fit.minimum.linear, fit.weight
    if not fit.accepted.any():
        return fit.noise
    claimed, used = problem.outlines.covariance, weight > 0.0
    normal = information(linear, problem.loss)
    L = np.linalg.cholesky(fit.noise.covariance(claimed))[used]
    share = leverage(normal, "outlines")[used]
    explained = L @ share @ np.swapaxes(L, -1, -2)  # weighted, as the squares are
    offsets = np.einsum("nij,nj->ni", L, linear["outlines"].r[used])
    return estimate_noise(offsets, explained, claimed[used], weight[used], included)


def _with_edge_noise(fit: Fit) -> Fit:
    """Estimate the noise of edges of bodies from their residuals, by their median.

    Outliers keep their place: the weight of an edge falls to zero beyond the rejection distance.
    """
    edges, settings = fit.problem.edges, fit.problem.settings
    if not len(edges):
        return fit
    share = leverage(information(fit.minimum.linear, fit.problem.loss), "edges")[:, 0, 0]
    offsets = edges.rows(fit.problem.keys, fit.state).r[:, 0] / edges.sigma
    scale = _scale_by_median(offsets**2, MEDIAN_OF_1, share)
    agrees = np.abs(offsets) <= settings.rejection * scale
    whitening = (agrees / (scale * edges.sigma))[:, None, None]
    factor = replace(fit.problem.factor("edges"), whitening=whitening)
    return replace(fit, problem=fit.problem.with_factors(factor), edge_scale=scale)


def _weights(problem: FitProblem, state: State, noise: NoiseModel) -> Array:
    """Weights of outlines at a fit; zero in images with an undetermined pose.

    The weight falls smoothly around the rejection distance, so that the fit is a continuous
    function of the measurements, and rejection has no hysteresis.
    """
    s = noise.squared_norms(problem.offsets(state), problem.outlines.covariance)
    begin, end = (
        problem.settings.rejection * (1.0 - REJECTION_TAPER),
        problem.settings.rejection * (1.0 + REJECTION_TAPER),
    )
    part = np.clip((end - np.sqrt(s)) / (end - begin), 0.0, 1.0)
    weight = np.asarray(part**2 * (3.0 - 2.0 * part))
    used = of_determined_poses(problem.weighted(noise, weight), state, weight > 0.0)
    return np.asarray(np.where(used, weight, 0.0))


def _refuse_disagreement(fit: Fit) -> None:
    """Raise DidNotConverge if most outlines are outliers, or inliers have large residuals."""
    accepted, most_px = fit.accepted, fit.problem.settings.largest_rms_px
    n, n_accepted = len(accepted), int(accepted.sum())
    used = fit.problem.offsets(fit.state)[accepted]
    rms = float(np.sqrt(np.mean(used**2))) if n_accepted else 0.0
    if 2 * n_accepted < n or rms > most_px:
        raise DidNotConverge(
            f"The joint fit ended with {n - n_accepted} of {n} outlines rejected and an error of "
            f"{rms:.1f} px (rms) of the others; more than half must agree within {most_px:g} px. "
            "Check camera poses, readings and outlines."
        )


def _with_corner_noise(problem: FitProblem, state: State) -> FitProblem:
    """Estimate the noise of corners from their residuals, and reject outliers."""
    linear, settings = linearize(problem, state), problem.settings
    normal, judged = information(linear, problem.loss), problem
    for board in problem.boards:
        if not len(board):
            continue
        rows, share = linear[board.name], leverage(normal, board.name)
        norms = rows.squared_norms
        scale = _scale_by_median(norms, MEDIAN_OF_2, 0.5 * np.einsum("nqq->n", share))
        agrees = norms <= (scale * settings.rejection) ** 2
        judged = judged.with_corners(board.chosen(agrees, scale), board.keys(~agrees))
        rms = float(np.sqrt(np.mean((rows.r * board.sigma[:, None]) ** 2)))
        is_far = np.median(norms * board.sigma**2) > settings.largest_rms_px**2
        on_base = board.link == "base"
        n_rejected = sum((pose < 0) == on_base for _, pose, _ in judged.rejected_corners)
        if n_rejected > int(agrees.sum()) or is_far:
            board_name = "" if board.link == "base" else f" on the {board.link}"
            raise DidNotConverge(
                f"The joint fit ended with an error of {rms:.1f} px (rms) of the corners of the "
                f"calibration board{board_name}; most must agree within "
                f"{settings.largest_rms_px:g} px. Check that the board did not move on its link, "
                "its dimensions, and the camera files."
            )
    return judged


def _scale_by_median(squares: Array, of_unit: float, explained: Array) -> float:
    """Return the factor on standard deviations by the median of squares, *of_unit* for right ones.

    *explained* (n,) are the shares of the errors that the fit absorbs.
    """
    redundancy = max(1.0 - float(np.mean(explained)), _MIN_REDUNDANCY)
    return max(float(np.sqrt(np.median(squares) / of_unit / redundancy)), _MIN_SCALE)


def corner_notes(problem: FitProblem) -> tuple[str, ...]:
    """Return a note on rejected corners, if any."""
    rejected = problem.rejected_corners
    if not rejected:
        return ()
    views, images = problem.outlines.views, problem.images
    listed = few(
        [
            f"corner {corner} in {views[view]}" + (f", {images[view, pose]}" if pose >= 0 else "")
            for view, pose, corner in sorted(rejected)
        ]
    )
    n = len(rejected) + sum(map(len, problem.boards))
    return (
        f"{len(rejected)} of {n} corners of the calibration board disagree with the fit and were "
        f"rejected: {listed}.",
    )


@dataclass(frozen=True, eq=False)
class Changes:
    """Changes between two rounds."""

    before: Array  # (n,) standard deviations of the errors of outlines: a factor, the others [px]
    after: Array
    n_changed: int  # outlines newly accepted or rejected
    n_accepted: int  # after the round

    @classmethod
    def of(cls, before: Fit, after: Fit) -> Changes:
        """Compare two successive fits to the same outlines."""
        n_changed = int(np.sum(after.accepted != before.accepted))
        return cls(_sizes(before), _sizes(after), n_changed, int(after.accepted.sum()))

    def converged(self, settings: RefinementSettings) -> bool:
        """Whether the rounds have converged."""
        near = np.allclose(
            self.after, self.before, rtol=settings.error_tolerance, atol=_MIN_ERROR_PX
        )
        return near and self.n_changed <= settings.error_tolerance * self.n_accepted


NO_CHANGES = Changes(np.zeros(0), np.zeros(0), 0, 0)


def _sizes(fit: Fit) -> Array:
    """All standard deviations of errors: a factor, the others [px]."""
    noise, biases = fit.noise, fit.edge_biases
    sizes = noise.scale, noise.bias_px, noise.tilt_px, *biases.sigma[: len(KINDS)]
    return np.array([*sizes, fit.edge_scale] if len(fit.problem.edges) else sizes)


def check_convergence(
    changes: Changes, claimed: Array, settings: RefinementSettings
) -> tuple[str, ...]:
    """Return a note on the changes of the last round, none if it converged.

    *claimed* are the covariances (n, 2, 2) of the outlines [px^2].

    Raises DidNotConverge if these changes are large.
    """
    if changes.converged(settings):
        return ()
    unit = np.ones(len(changes.after))
    unit[0] = np.sqrt(0.5 * np.mean(np.trace(claimed, axis1=1, axis2=2)))
    before, after = unit * changes.before, unit * changes.after
    i = int(np.argmax(np.abs(after - before)))
    last_change = (
        f"in the last round, {changes.n_changed} outlines were newly accepted or rejected "
        f"({changes.n_accepted} are accepted), and one standard deviation of errors changed from "
        f"{before[i]:.3f} px to {after[i]:.3f} px"
    )
    largest = max(float(before.max()), float(after.max()))
    most_changed = _MAX_CHANGED * changes.n_accepted
    if abs(after[i] - before[i]) > _MAX_ERROR_CHANGE * largest or changes.n_changed > most_changed:
        raise DidNotConverge(
            "The joint fit did not converge on the inliers and the noise of outlines: "
            f"{last_change}; add images, or correct wrong outlines."
        )
    return (
        "The noise of the outlines has not converged; the stated uncertainty may be wrong: "
        f"{last_change}.",
    )


_ON_EDGE_PX = 1.5  # [px] at both ends
_NEARER = 0.25  # of the distance from the edge that it was assigned to


def rejection_reasons(
    problem: FitProblem, state: State, rejected: IntArray, offsets: Array
) -> list[Rejection]:
    """Return the reasons of rejection of outlines (m,): their offset, and another edge nearby.

    *offsets* (n, 2) of all outlines are from their prediction [px].
    """
    offset_sizes = np.abs(offsets[rejected]).max(axis=1, initial=0.0)
    details = [f"{distance:.1f} px" for distance in offset_sizes.tolist()]
    o, names = problem.outlines, problem.legs.names
    part = np.repeat(np.arange(len(o.parts)), len(EPSILON))
    edges = [
        f"edge {edge + 1} of {names[leg]}.{link}"
        for leg, link in o.parts
        for edge in range(len(EPSILON))
    ]
    # Every rejected outline, assigned to every edge.
    outline, edge = np.repeat(rejected, len(edges)), np.tile(np.arange(len(edges)), len(rejected))
    as_others = o.at(outline)
    legs = np.array([leg for leg, _ in o.parts], dtype=np.intp)
    radius, epsilon = part[edge], np.tile(EPSILON, len(o.parts))[edge]
    as_others = replace(as_others, leg=legs[radius], radius=radius, epsilon=epsilon)
    distances_to_edges = np.abs(as_others.offsets(problem.keys, state)).max(axis=1, initial=0.0)
    for i, distances in enumerate(distances_to_edges.reshape(len(rejected), len(edges))):
        nearest = int(np.argmin(distances))
        if distances[nearest] < min(_ON_EDGE_PX, _NEARER * offset_sizes[i]):
            details[i] += f", lies on {edges[nearest]}"
    return [Rejection(Reason.DISAGREES, detail) for detail in details]
