"""One fit of everything: all outlines in pixels and all readings, at once.

A wide robust loss first, so that wrong outlines cannot bend the way; then rounds in which the
noise of outlines is estimated, outlines that disagree are rejected, and the rest is fitted again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from legcal.errors import DidNotConverge, LegcalError, NotIdentifiable
from legcal.geometry.types import Array, BoolArray
from legcal.measurements import Measurements
from legcal.observations import Outlines
from legcal.refinement.covariance import check_counts, uncertainty
from legcal.refinement.inputs import inputs_of
from legcal.refinement.legs import FittedLegs
from legcal.refinement.loss import efficiency, width_to_k
from legcal.refinement.noise import NoiseModel
from legcal.refinement.normal import Linearization, information, linearize
from legcal.refinement.observed import has_offset, observed_outlines, readings
from legcal.refinement.problem import FitProblem, Prior, build_problem
from legcal.refinement.rounds import Fit, first_minimum, fit_in_rounds, offsets_of
from legcal.refinement.settings import DEFAULT_SETTINGS, RefinementSettings
from legcal.refinement.shared_errors import shared_errors
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
) -> FitProblem:
    """Build the fit of everything without solving it.

    Raises
    ------
    NotIdentifiable
        If there are fewer equations than unknowns.
    DatasetError
        If an outline cannot be used.
    """
    observed = observed_outlines(outlines, measurements, legs)
    encoders = readings(measurements, legs)
    seen = np.zeros(len(measurements.views), dtype=np.bool_)
    seen[observed.view] = True
    layout = lay_out(
        legs.frame_legs, has_offset(measurements), observed.parts, seen, measurements.n_poses
    )
    mean = np.array([legs.radii[part] for part in observed.parts])
    prior = Prior(layout.radius, mean, settings.radius_sigma * mean)
    problem = build_problem(layout, observed, encoders, prior, settings.max_iterations)
    check_counts(problem, measurements.n_rows)
    return problem


def refine(
    legs: FittedLegs,
    measurements: Measurements,
    outlines: Outlines,
    start: Start,
    settings: RefinementSettings = DEFAULT_SETTINGS,
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

    Returns
    -------
    Solution

    Raises
    ------
    NotIdentifiable
        If the data do not determine the parameters.
    DidNotConverge
        If the solver stops early, or most outlines disagree with what it found.
    DatasetError
        If an outline cannot be used.
    """
    problem = build_fit(legs, measurements, outlines, settings)
    candidate = _candidate(problem, legs, start, settings)
    return _refined(problem, legs, outlines, candidate, settings)


def refine_from_best(
    legs: FittedLegs,
    measurements: Measurements,
    outlines: Outlines,
    starts: Sequence[Start],
    settings: RefinementSettings = DEFAULT_SETTINGS,
) -> Solution:
    """Fit everything from several starts and keep the lowest cost (hazard 10 of the method).

    The first minima are compared; only the lowest is worked out, the others stand in for it if
    that fails. A start that fails is skipped with a note; between equal costs the earlier
    start wins.

    Raises
    ------
    NotIdentifiable, DidNotConverge
        If no start leads to a fit.
    """
    problem = build_fit(legs, measurements, outlines, settings)
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
    raise DidNotConverge(notes or ["The fit was given no starting values; it needs at least one."])


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
        # A fit that nothing determines has no minimum to converge to: say so if that is why.
        linear = linearize(problem, begin, NoiseModel().whitening(problem.outlines.covariance))
        normal = information(problem, linear, 1.0)
        uncertainty(problem, normal, _estimated_names(problem, legs), _size(begin))
        raise
    cost = _comparable_cost(problem, state, settings)
    return _Candidate(start.label, state, cost, iterations)


def _refined(
    problem: FitProblem,
    legs: FittedLegs,
    outlines: Outlines,
    candidate: _Candidate,
    settings: RefinementSettings,
) -> Solution:
    """Work out a first minimum with a problem that is already built."""
    fit = fit_in_rounds(problem, candidate.state, candidate.iterations, settings)
    _refuse_other_radii(problem, fit.state, legs)
    names = _estimated_names(problem, legs)
    return _solution(problem, fit, outlines, names, candidate.label, settings)


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


def _solution(
    problem: FitProblem,
    fit: Fit,
    outlines: Outlines,
    names: tuple[str, ...],
    label: str,
    settings: RefinementSettings,
) -> Solution:
    """Put together what was found."""
    claimed, k = problem.outlines.covariance, width_to_k(settings.loss_width)
    whitening = fit.noise.whitening(claimed, fit.accepted)
    linear = linearize(problem, fit.state, whitening)
    normal = information(problem, linear, efficiency(k))
    shared = shared_errors(problem, linear, normal, whitening)
    known = uncertainty(problem, normal, names, _size(fit.state), shared.covariance)
    offsets = offsets_of(problem, fit.state)
    used = offsets[fit.accepted]
    n_residuals = used.size + len(problem.readings) + len(problem.radius_prior.mean)
    parts = problem.layout.parts
    return Solution(
        parameters=fit.state.parameters,
        T_camera_Rb=fit.state.T_camera_Rb,
        T_Rb_Re=fit.state.T_Rb_Re,
        radii=dict(zip(parts, fit.state.radii.tolist(), strict=True)),
        sigma_radii=dict(zip(parts, known.sigma_radii.tolist(), strict=True)),
        names=names,
        covariance=known.covariance,
        sigma=np.sqrt(np.diagonal(known.covariance)),
        weak=known.weak,
        cost=_comparable_cost(problem, fit.state, settings),
        chi2=_chi2(linear),
        dof=n_residuals - problem.layout.size,
        rms_px=float(np.sqrt(np.mean(used**2))) if used.size else 0.0,
        noise=fit.noise,
        shared_bias_px=shared.bias_px,
        shared_tilt_px=shared.tilt_px,
        outlines=_with_rejections(outlines, problem, fit.accepted, offsets),
        start=label,
        iterations=fit.iterations,
    )


def _size(state: State) -> float:
    """Return the largest joint coordinate [m]."""
    return float(max(np.abs(state.base_joints).max(), np.abs(state.platform_joints).max()))


def _chi2(linear: Linearization) -> float:
    parts = (linear.outline_r, linear.encoder_r, linear.prior_r)
    return float(sum(np.sum(part**2) for part in parts))


def _comparable_cost(problem: FitProblem, state: State, settings: RefinementSettings) -> float:
    """Return the robust cost of all outlines with their claimed covariances."""
    whitening = NoiseModel().whitening(problem.outlines.covariance)
    inputs = inputs_of(problem, state, whitening, width_to_k(settings.loss_width))
    zero = ca.DM.zeros(problem.layout.size)
    return float(problem.cost(zero, *[np.asfortranarray(part.T) for part in inputs]))


def _with_rejections(
    outlines: Outlines, problem: FitProblem, accepted: BoolArray, offsets: Array
) -> Outlines:
    """Return the table with what the fit rejected, and by how much it disagrees."""
    used, reason = outlines.used.copy(), list(outlines.reason)
    worst = np.abs(offsets).max(axis=1, initial=0.0)
    for i in np.flatnonzero(~accepted):
        row = int(problem.outlines.index[i])
        used[row] = False
        reason[row] = f"disagrees with the fit by {worst[i]:.1f} px"
    return dataclasses.replace(outlines, used=used, reason=tuple(reason))


def _estimated_names(problem: FitProblem, legs: FittedLegs) -> tuple[str, ...]:
    """Return the names of the kinematic parameters that are unknowns of the fit."""
    is_free = problem.layout.offset < problem.layout.size
    joints = legs.parameter_names[: -legs.n_legs]
    offsets = legs.parameter_names[-legs.n_legs :]
    return (*joints, *(name for name, free in zip(offsets, is_free, strict=True) if free))
