"""One fit of everything: all outlines in pixels, or measured axes, and all readings, at once.

A wide robust loss first, so that wrong outlines cannot bend the way; then rounds in which the
noise of outlines is estimated, outlines that disagree are rejected, and the rest is fitted again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from legcal.errors import DidNotConverge, LegcalError, NotIdentifiable
from legcal.observations.leg_axes import LegAxes
from legcal.observations.measurements import Measurements
from legcal.observations.outlines import Outlines
from legcal.refinement.assembly import (
    assemble_solution,
    comparable_cost,
    estimated_names,
    machine_size,
)
from legcal.refinement.covariance import check_counts, uncertainty
from legcal.refinement.legs import FittedLegs
from legcal.refinement.noise import NoiseModel
from legcal.refinement.normal import information, linearize
from legcal.refinement.observed import has_offset, observed_outlines, readings
from legcal.refinement.observed_axes import observed_axes
from legcal.refinement.problem import FitProblem, Prior, build_problem
from legcal.refinement.rounds import first_minimum, fit_in_rounds
from legcal.refinement.settings import DEFAULT_SETTINGS, RefinementSettings
from legcal.refinement.solution import Solution
from legcal.refinement.start import Start
from legcal.refinement.state import State, lay_out

_LARGEST_RADIUS_CHANGE = 0.5
_EQUAL_COSTS = 1e-6  # relative: the same minimum


def build_fit(
    legs: FittedLegs,
    measurements: Measurements,
    outlines: Outlines,
    settings: RefinementSettings = DEFAULT_SETTINGS,
    *,
    axes: LegAxes | None = None,
) -> FitProblem:
    """Build the fit of everything without solving it; arguments as in :func:`refine`.

    Raises
    ------
    NotIdentifiable
        If there are fewer equations than unknowns.
    DatasetError
        If an outline or an axis cannot be used.
    """
    observed = observed_outlines(outlines, measurements, legs)
    lines = observed_axes(axes, measurements, legs)
    encoders = readings(measurements, legs)
    seen = np.zeros(len(measurements.views), dtype=np.bool_)
    seen[observed.view] = seen[lines.view] = True
    layout = lay_out(
        legs.frame_legs, has_offset(measurements), observed.parts, seen, measurements.n_poses
    )
    mean = np.array([legs.radii[part] for part in observed.parts])
    prior = Prior(layout.radius, mean, settings.radius_sigma * mean)
    problem = build_problem(layout, observed, encoders, prior, lines, settings.max_iterations)
    check_counts(problem, measurements.n_rows)
    return problem


def refine(
    legs: FittedLegs,
    measurements: Measurements,
    outlines: Outlines,
    start: Start,
    settings: RefinementSettings = DEFAULT_SETTINGS,
    *,
    axes: LegAxes | None = None,
) -> Solution:
    """Fit kinematic parameters, cameras, platform poses and radii to all data at once.

    Parameters
    ----------
    legs : FittedLegs
        The mechanism (:func:`legcal.refinement.legs.fitted_legs`).
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
        :func:`legcal.observations.sets.no_outlines`). Their covariances are taken as they are.

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
    problem = build_fit(legs, measurements, outlines, settings, axes=axes)
    return solve_fit(problem, legs, outlines, start, settings)


def solve_fit(
    problem: FitProblem,
    legs: FittedLegs,
    outlines: Outlines,
    start: Start,
    settings: RefinementSettings = DEFAULT_SETTINGS,
) -> Solution:
    """Solve a fit that :func:`build_fit` built; otherwise the same as :func:`refine`."""
    candidate = _candidate(problem, legs, start, settings)
    return _refined(problem, legs, outlines, candidate, settings)


def refine_from_best(
    legs: FittedLegs,
    measurements: Measurements,
    outlines: Outlines,
    starts: Sequence[Start],
    settings: RefinementSettings = DEFAULT_SETTINGS,
    *,
    axes: LegAxes | None = None,
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
    problem = build_fit(legs, measurements, outlines, settings, axes=axes)
    candidates: list[_Candidate] = []
    notes: list[str] = []
    failures: list[LegcalError] = []
    for start in starts:
        try:
            candidate = _candidate(problem, legs, start, settings)
        except (DidNotConverge, NotIdentifiable) as failure:
            failures.append(failure)
            notes.append(f"The start {start.label} was skipped. {failure}")
            continue
        notes.append(f"The start {start.label} led to a cost of {candidate.cost:.6g}.")
        place = sum(other.cost <= (1.0 + _EQUAL_COSTS) * candidate.cost for other in candidates)
        candidates.insert(place, candidate)
    for candidate in candidates:
        try:
            found = _refined(problem, legs, outlines, candidate, settings)
        except (DidNotConverge, NotIdentifiable) as failure:
            failures.append(failure)
            notes.append(f"The start {candidate.label} was given up. {failure}")
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

    label: str
    state: State
    cost: float
    iterations: int


def _candidate(
    problem: FitProblem, legs: FittedLegs, start: Start, settings: RefinementSettings
) -> _Candidate:
    """Return the first minimum that a start leads to."""
    begin = start.state(problem.radius_prior.mean)
    try:
        state, iterations = first_minimum(problem, begin, settings)
    except DidNotConverge:
        _refuse_undetermined(problem, legs, begin)
        raise
    cost = comparable_cost(problem, state, settings)
    return _Candidate(start.label, state, cost, iterations)


def _refined(
    problem: FitProblem,
    legs: FittedLegs,
    outlines: Outlines,
    candidate: _Candidate,
    settings: RefinementSettings,
) -> Solution:
    """Work out a first minimum with a problem that is already built."""
    try:
        fit = fit_in_rounds(problem, candidate.state, candidate.iterations, settings)
    except DidNotConverge:
        _refuse_undetermined(problem, legs, candidate.state)
        raise
    _refuse_other_radii(problem, fit.state, legs)
    return assemble_solution(problem, fit, legs, outlines, candidate.label, settings)


def _refuse_undetermined(problem: FitProblem, legs: FittedLegs, state: State) -> None:
    """Raise NotIdentifiable if that is why there is no minimum to converge to."""
    linear = linearize(problem, state, NoiseModel().whitening(problem.outlines.covariance))
    normal = information(problem, linear, 0.0)
    uncertainty(problem, normal, estimated_names(problem, legs), machine_size(state))


def _refuse_other_radii(problem: FitProblem, state: State, legs: FittedLegs) -> None:
    """Raise DidNotConverge if the fit needs radii that are not those of the legs at all."""
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
