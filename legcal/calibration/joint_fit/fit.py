"""One fit of everything: all outlines in pixels, or measured axes, and all readings, at once.

A wide robust loss first, so that wrong outlines cannot bend the way; then rounds in which the
noise of outlines is estimated, outlines that disagree are rejected, and the rest is fitted again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

from legcal.calibration.joint_fit.assembly import assemble_solution, comparable_cost
from legcal.calibration.joint_fit.build import build_fit
from legcal.calibration.joint_fit.choices import NO_CHOICES, Choices
from legcal.calibration.joint_fit.constraints import Start, on_constraints
from legcal.calibration.joint_fit.contradictions import (
    blaming_what_was_stated,
    refuse_contradicted_priors,
    refuse_contradicted_values,
    refuse_other_board,
    rejected_notes,
)
from legcal.calibration.joint_fit.determinacy import held_at_nominal, open_directions, refuse_lost
from legcal.calibration.joint_fit.normal import information
from legcal.calibration.joint_fit.observations import SeenBoard
from legcal.calibration.joint_fit.problem import FitProblem, linearize, offsets_of
from legcal.calibration.joint_fit.rounds import first_minimum, fit_in_rounds
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.joint_fit.solver import Minimum
from legcal.calibration.joint_fit.state import (
    DEFAULT_SETTINGS,
    FittedLegs,
    RefinementSettings,
    State,
)
from legcal.data import LegAxes, Measurements, Outlines
from legcal.errors import DidNotConverge, LegcalError, NotIdentifiable
from legcal.estimation import NoiseModel, noise_of_the_median, width_to_k

_LARGEST_RADIUS_CHANGE = 0.5
_EQUAL_COSTS = 1e-6  # relative: the same minimum


def refine(
    legs: FittedLegs,
    measurements: Measurements,
    outlines: Outlines,
    start: Start,
    settings: RefinementSettings = DEFAULT_SETTINGS,
    *,
    axes: LegAxes | None = None,
    board: SeenBoard | None = None,
    choices: Choices = NO_CHOICES,
) -> Solution:
    """Fit kinematic parameters, cameras, platform poses and radii to all data at once.

    Parameters
    ----------
    legs : FittedLegs
        The mechanism (:func:`legcal.calibration.joint_fit.state.fitted_legs`).
    measurements : Measurements
        Views, poses and readings [m].
    outlines : Outlines
        Outlines in pixels; only the used ones enter.
    start : Start
        Starting values.
    settings : RefinementSettings
        Choices of the fit.
    axes : LegAxes, optional
        Measured axes, beside outlines or instead of them (give
        :func:`legcal.data.outlines.no_outlines`). Their covariances are taken as they are.
    board : SeenBoard, optional
        A calibration board that stands still on the base, and its corners in images.
    choices : Choices
        Parameters that are fixed, freed or known beforehand.

    Returns
    -------
    Solution

    Raises
    ------
    NotIdentifiable
        If the data do not determine the parameters.
    DidNotConverge
        If the solver stops early, or most outlines or axes disagree with what it found.
    DatasetError
        If an outline or an axis cannot be used.
    """
    problem = build_fit(
        legs, measurements, outlines, settings, axes=axes, board=board, choices=choices
    )
    return solve_fit(problem, outlines, start, settings)


def solve_fit(
    problem: FitProblem,
    outlines: Outlines,
    start: Start,
    settings: RefinementSettings = DEFAULT_SETTINGS,
) -> Solution:
    """Solve a fit that :func:`build_fit` built; otherwise the same as :func:`refine`."""
    candidate = _candidate(problem, start, settings)
    return _refined(problem, outlines, candidate, settings)


def refine_from_best(
    legs: FittedLegs,
    measurements: Measurements,
    outlines: Outlines,
    starts: Sequence[Start],
    settings: RefinementSettings = DEFAULT_SETTINGS,
    *,
    axes: LegAxes | None = None,
    board: SeenBoard | None = None,
    choices: Choices = NO_CHOICES,
) -> Solution:
    """Fit everything from several starts and keep the lowest cost.

    The first minima are compared; only the lowest is worked out, the others stand in for it if
    that fails. A start that fails is skipped with a note; between equal costs the earlier
    start wins.

    Raises
    ------
    NotIdentifiable, DidNotConverge
        If no start leads to a fit.
    """
    problem = build_fit(
        legs, measurements, outlines, settings, axes=axes, board=board, choices=choices
    )
    candidates: list[_Candidate] = []
    notes: list[str] = []
    failures: list[LegcalError] = []
    for start in starts:
        try:
            candidate = _candidate(problem, start, settings)
        except (DidNotConverge, NotIdentifiable) as failure:
            failures.append(failure)
            notes.append(f"The start {start.label} was skipped. {failure}")
            continue
        if len(starts) > 1:
            notes.append(f"The start {start.label} led to a cost of {candidate.cost:.6g}.")
        place = sum(other.cost <= (1.0 + _EQUAL_COSTS) * candidate.cost for other in candidates)
        candidates.insert(place, candidate)
    for candidate in candidates:
        try:
            found = _refined(problem, outlines, candidate, settings)
        except (DidNotConverge, NotIdentifiable) as failure:
            failures.append(failure)
            notes.append(f"The start {candidate.start.label} was given up. {failure}")
            continue
        return dataclasses.replace(found, notes=(*found.notes, *notes))
    if failures and all(isinstance(failure, NotIdentifiable) for failure in failures):
        raise failures[0]
    problems = dict.fromkeys(problem for failure in failures for problem in failure.problems)
    raise DidNotConverge(
        list(problems) or "The fit was given no starting values; it needs at least one."
    )


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A first minimum."""

    start: Start
    minimum: Minimum
    cost: float


def _candidate(problem: FitProblem, start: Start, settings: RefinementSettings) -> _Candidate:
    """Return the first minimum that a start leads to."""
    begin = problem.begin(start)
    try:
        found = first_minimum(*_held_at_start(problem, begin), settings)
    except DidNotConverge as failure:
        refuse_contradicted_values(problem, start, begin, settings, with_priors=True)
        _refuse_undetermined(problem, begin)
        raise blaming_what_was_stated(problem, failure) from None
    cost = comparable_cost(problem, found.state, settings)
    return _Candidate(start, found, cost)


def _held_at_start(problem: FitProblem, begin: State) -> tuple[FitProblem, State]:
    """Return problem and state with what the measurements seem to leave open held, for now."""
    begin = on_constraints(begin, problem.legs.frame_legs)
    linear = linearize(problem, begin, NoiseModel().whitening(problem.outlines.covariance))
    try:
        held = open_directions(problem, begin, information(problem, begin, linear, 0.0))
    except NotIdentifiable:  # by accident of the start, or to be said of the minimum
        return problem, begin
    return held_at_nominal(problem, begin, held) if len(held.basis) else (problem, begin)


def _refined(
    problem: FitProblem,
    outlines: Outlines,
    candidate: _Candidate,
    settings: RefinementSettings,
) -> Solution:
    """Work out a first minimum with a problem that is already built."""
    first = candidate.minimum
    refuse_contradicted_values(problem, candidate.start, first.state, settings)
    k = width_to_k(settings.loss_width)
    normal = information(problem, first.state, first.linear, k)
    held = open_directions(problem, first.state, normal)
    refuse_other_board(problem, first.state, normal, settings)
    free, state, iterations = problem, first.state, first.iterations
    try:
        if len(held.basis):
            problem, state = held_at_nominal(problem, state, held)
            there = first_minimum(problem, state, settings)
            state, iterations = there.state, iterations + there.iterations
        fit = fit_in_rounds(problem, state, iterations, settings)
        normal = information(fit.problem, fit.state, fit.minimum.linear, k)
        refuse_lost(fit.problem, fit.state, normal, held)
        _refuse_other_radii(problem, fit.state)
    except (DidNotConverge, NotIdentifiable) as failure:
        refuse_contradicted_values(free, candidate.start, state, settings, with_priors=True)
        _refuse_contradicted(free, state)
        _refuse_undetermined(free, state)
        if isinstance(failure, DidNotConverge):
            raise blaming_what_was_stated(free, failure) from None
        raise
    if rejected_notes(fit.problem, fit.accepted):
        refuse_contradicted_values(free, candidate.start, state, settings, with_priors=True)
    return assemble_solution(fit.problem, fit, held, outlines, candidate.start.label, settings)


def _refuse_undetermined(problem: FitProblem, state: State) -> None:
    """Raise NotIdentifiable if that is why there is no minimum to converge to."""
    linear = linearize(problem, state, NoiseModel().whitening(problem.outlines.covariance))
    open_directions(problem, state, information(problem, state, linear, 0.0))


def _refuse_contradicted(problem: FitProblem, state: State) -> None:
    """Raise DidNotConverge if stated priors are why a fit fails."""
    claimed = problem.outlines.covariance
    noise = NoiseModel()
    if len(claimed):
        noise = noise_of_the_median(offsets_of(problem, state), claimed)
    linear = linearize(problem, state, noise.whitening(claimed))
    refuse_contradicted_priors(problem, state, information(problem, state, linear, 0.0))


def _refuse_other_radii(problem: FitProblem, state: State) -> None:
    """Raise DidNotConverge if the fit needs radii that are not those of the legs at all."""
    legs = problem.legs
    problems = [
        f"The fit of everything ended with a radius of {1e3 * radius:.2f} mm for "
        f"{legs.names[leg]}.{part}, the model has {1e3 * legs.radii[leg, part]:.2f} mm; they must "
        "agree to a half; check the radius, and the outlines for edges that are swapped or "
        "belong to another leg."
        for (leg, part), radius in zip(problem.layout.parts, state.radii, strict=True)
        if not abs(radius / legs.radii[leg, part] - 1.0) < _LARGEST_RADIUS_CHANGE
    ]
    if problems:
        raise DidNotConverge(problems)
