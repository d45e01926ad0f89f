"""The joint fit: all outlines in pixels, or measured axes, and all readings and corners, at once.

A wide robust loss first, so that wrong outlines cannot bend the way; then rounds in which the
noise of outlines is estimated, outlines that disagree are rejected, and the rest is fitted again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from legcal.calibration.joint_fit.determinacy import (
    held_at_nominal,
    open_directions,
    refuse_undetermined_inliers,
)
from legcal.calibration.joint_fit.diagnostics import (
    arms_of_other_widths,
    naming_stated_values,
    refuse_contradicted_priors,
    refuse_contradicted_values,
    refuse_other_board,
    rejected_notes,
    wrong_arms,
    wrong_arms_in_words,
)
from legcal.calibration.joint_fit.factors import BoardCorners
from legcal.calibration.joint_fit.free_poses import (
    are_free,
    have_outliers,
    with_better_poses,
    with_free_poses,
)
from legcal.calibration.joint_fit.outline_errors import NoiseModel, noise_of_the_median
from legcal.calibration.joint_fit.parameter_choices import NO_CHOICES, Choices
from legcal.calibration.joint_fit.problem import FitProblem, build_fit
from legcal.calibration.joint_fit.rounds import first_minimum, fit_in_rounds
from legcal.calibration.joint_fit.scale import naming_missing_lengths
from legcal.calibration.joint_fit.solution import Solution, assemble_solution
from legcal.calibration.joint_fit.variables import (
    DEFAULT_SETTINGS,
    FittedLegs,
    RefinementSettings,
    Start,
    State,
)
from legcal.data.axes import LegAxes
from legcal.data.measurements import Measurements
from legcal.data.outlines import Outlines, are_of_arms
from legcal.data.reasons import Reason
from legcal.errors import DidNotConverge, LegcalError, NotIdentifiable
from legcal.estimation.problem import Residuals, linearize
from legcal.estimation.solver import Minimum, information
from legcal.estimation.uncertainty import named_covariance
from legcal.geometry.types import Array
from legcal.machine.leg import Leg

_MAX_RADIUS_CHANGE = 0.5
_COST_TOLERANCE = 1e-6  # relative: the same minimum
_POSE_ROUNDS = 8  # in which other poses are looked for, where readings leave them open
_PART_OF_MODEL = 0.1  # of the errors of a nominal model, which are left then
_SEED = 2001  # of other starts
_OTHER_MODEL = 0.005  # of the mean leg length, angles at it: errors of models that are tried
_SAME_COST = 0.01  # relative: the same minimum, by first minima
_ENOUGH_STARTS = 3  # that come to the same minimum: there is no better one near


def refine(
    legs: FittedLegs,
    measurements: Measurements,
    outlines: Outlines,
    start: Start | Sequence[Start],
    settings: RefinementSettings = DEFAULT_SETTINGS,
    *,
    axes: LegAxes | None = None,
    board: BoardCorners | None = None,
    choices: Choices = NO_CHOICES,
) -> Solution:
    """Fit kinematic parameters, cameras, platform poses and radii to all data at once.

    Of several starts the first minima are compared; only the lowest is refined, the next one if
    that fails. A start that fails is skipped with a note; between equal costs the earlier one wins.

    Parameters
    ----------
    legs : FittedLegs
        The mechanism (:func:`fitted_legs`).
    measurements : Measurements
        Views, poses and readings [m].
    outlines : Outlines
        Outlines in pixels; only the used ones enter.
    start : Start or sequence of Start
        Starting values.
    settings : RefinementSettings
        Settings of the fit.
    axes : LegAxes, optional
        Measured axes, beside outlines or instead of them (give
        :func:`legcal.data.outlines.no_outlines`). Their covariances are taken as they are.
    board : BoardCorners, optional
        A calibration board that stands still on the base, and its corners in images.
    choices : Choices
        Parameters that are fixed, freed or known beforehand.

    Returns
    -------
    Solution

    Raises
    ------
    NotIdentifiable
        If the data do not determine the parameters, from no start.
    DidNotConverge
        If the solver stops early from all starts, or most outlines or axes disagree with what it
        found.
    DatasetError
        If an outline or an axis cannot be used.
    """
    starts = [start] if isinstance(start, Start) else start

    def fitted(seen: Outlines) -> Solution:
        problem = build_fit(
            legs, measurements, seen, settings, axes=axes, board=board, choices=choices
        )
        problem.require_determined()
        with naming_missing_lengths(problem):
            return _best(problem, seen, starts)

    return _without_wrong_arms(fitted, outlines, legs.nominal)


def _without_wrong_arms(
    fitted: Callable[[Outlines], Solution], outlines: Outlines, legs: Sequence[Leg]
) -> Solution:
    """Return a fit without the arms that are no cylinders on their motors, each as a whole.

    The rods do without arms, and outlines of another shape bend the fit or raise the noise of all.
    So arms that a fit contradicts are left out, and all of them where it fails with them.
    """
    is_arm = are_of_arms(outlines, legs)
    notes, wrong = list[str](), arms_of_other_widths(outlines, is_arm)
    while True:
        if wrong:
            left_out = is_arm & np.isin(outlines.leg, list(wrong))
            outlines = outlines.reject(left_out, Reason.ARM_LEFT_OUT)
            notes.append(f"Arms were left out as a whole: {wrong_arms_in_words(wrong, legs)}")
        try:
            found = fitted(outlines)
            fit = found.posterior
            wrong = wrong_arms(fit.problem, fit.state, fit.noise, found.outlines)
        except (DidNotConverge, NotIdentifiable):
            seen = np.unique(outlines.leg[is_arm & outlines.used]).tolist()
            if not seen:
                raise
            wrong = dict.fromkeys(seen, "with whose outlines the joint fit fails")
        else:
            if not wrong:
                return dataclasses.replace(found, notes=(*notes, *found.notes))


def _called(start: Start) -> str:
    """Return where a start comes from, for sentences."""
    known = {"nominal": "the nominal model", "staged": "the four steps"}
    return known.get(start.label, f"the start '{start.label}'")


def _best(problem: FitProblem, outlines: Outlines, starts: Sequence[Start]) -> Solution:
    """Return the fit from the start with the least cost."""
    candidates: list[tuple[Start, Minimum[State]]] = []
    notes, details = list[str](), list[str]()
    failures: list[LegcalError] = []
    for start in starts:
        begun = _called(start)
        try:
            minimum = _first(problem, start)
        except (DidNotConverge, NotIdentifiable) as failure:
            failures.append(failure)
            notes.append(f"The joint fit could not start from {begun}. {failure}")
            continue
        if len(starts) > 1:
            cost = f"{minimum.cost:.6g}"
            details.append(f"Started from {begun}, the joint fit came to a cost of {cost}.")
        least = (1.0 + _COST_TOLERANCE) * minimum.cost
        place = sum(other.cost <= least for _, other in candidates)
        candidates.insert(place, (start, minimum))
    for start, minimum in candidates:
        try:
            found = _refined(problem, outlines, start, minimum)
        except (DidNotConverge, NotIdentifiable) as failure:
            failures.append(failure)
            notes.append(f"The joint fit started from {_called(start)} was given up. {failure}")
            continue
        if found.left_out or _shifted_px(found) > problem.settings.largest_rms_px:
            found = _from_other_starts(problem, outlines, start, minimum, found)
        _refuse_shifted(found, problem.settings.largest_rms_px)
        return dataclasses.replace(found, notes=(*found.notes, *notes), details=tuple(details))
    if failures and all(isinstance(failure, NotIdentifiable) for failure in failures):
        raise failures[0]
    problems = dict.fromkeys(problem for failure in failures for problem in failure.problems)
    raise DidNotConverge(
        list(problems) or "The fit was given no starting values; it needs at least one."
    )


def _from_other_starts(
    problem: FitProblem,
    outlines: Outlines,
    start: Start,
    first: Minimum[State],
    found: Solution,
) -> Solution:
    """Return what a fit that left out or moved a leg of a view finds from other models, if better.

    Outlines of one leg in one view are not wrong together by chance: they are of another leg, or
    the fit is at a wrong minimum, where it may pass through all others without an error. So nominal
    models that are wrong otherwise are tried, until the fit leaves out no leg of a view, or several
    starts come to the same minimum, which confirms that it is the outlines that are wrong.
    """
    rng, begin = np.random.default_rng(_SEED), problem.begin(start)
    n = problem.n_kinematic
    unit = np.array([begin.mean_length if unit == "m" else 1.0 for unit in problem.units[:n]])
    n_same = 0
    for _ in range(problem.settings.other_starts):
        step = np.zeros(problem.size)
        step[:n] = _OTHER_MODEL * unit * rng.normal(size=n)
        try:
            minimum = _first(problem, start, problem.moved(begin, step))
            if minimum.cost > (1.0 - _SAME_COST) * first.cost:
                n_same += minimum.cost < (1.0 + _SAME_COST) * first.cost
                if n_same == _ENOUGH_STARTS:
                    return dataclasses.replace(found, left_out=())
                continue
            found = _refined(problem, outlines, start, minimum)
        except (DidNotConverge, NotIdentifiable):
            continue
        if not found.left_out and _shifted_px(found) <= problem.settings.largest_rms_px:
            break
        first, n_same = minimum, 0
    return found


def _shifted_px(found: Solution) -> float:
    """Return how far a fit moves outlines together, one standard deviation [px]."""
    return max(found.quality.shared_px.values(), default=0.0)


def _refuse_shifted(found: Solution, most_px: float) -> None:
    """Raise DidNotConverge if a fit explains by light and blur what these cannot have done."""
    shifted = _shifted_px(found)
    if shifted > most_px:
        kind = max(found.quality.shared_px, key=found.quality.shared_px.__getitem__)
        raise DidNotConverge(
            f"The joint fit ended where outlines are off together ({kind}) by {shifted:.1f} px, "
            f"needed at most {most_px:g} px, which is more than light and blur "
            "do; check camera poses, readings and outlines, or start nearer to the truth."
        )


def _first(problem: FitProblem, start: Start, begin: State | None = None) -> Minimum[State]:
    """Return the first minimum that a start leads to, or another begin near it."""
    begin = problem.begin(start) if begin is None else begin
    try:
        if are_free(problem, begin):
            return _first_of_free_poses(problem, begin)
        return first_minimum(*_held_at_start(problem, begin))
    except DidNotConverge as failure:
        refuse_contradicted_values(problem, start, begin, with_priors=True)
        _refuse_undetermined(problem, begin)
        raise naming_stated_values(problem, failure) from None


def _first_of_free_poses(problem: FitProblem, begin: State) -> Minimum[State]:
    """Return the first minimum, with other poses where some suit their images badly."""

    def minimum(state: State, must_converge: bool = True) -> Minimum[State]:
        return first_minimum(*_held_at_start(problem, state), must_converge=must_converge)

    try:
        found = minimum(begin)
        if not have_outliers(problem, found.state):
            return found
    except DidNotConverge:
        found = None
    # Poses that suit nothing slide on for ever: what comes before the last minimum need not end.
    again = minimum(with_free_poses(problem, problem.projected(begin)), must_converge=False)
    found = again if found is None or again.cost < found.cost else found
    for k in range(_POSE_ROUNDS):
        if not have_outliers(problem, found.state):
            break
        state = with_better_poses(problem, found.state, _PART_OF_MODEL, seed=k)
        again = minimum(state, must_converge=False)
        found = again if again.cost < found.cost else found
    return found


def _held_at_start(
    problem: FitProblem, begin: State
) -> tuple[FitProblem, State, Mapping[str, Residuals] | None]:
    """Return problem and state with directions held that are open at the start, and known rows."""
    begin = problem.projected(begin)
    linear = linearize(problem, begin)
    try:
        held = open_directions(problem, begin, information(problem, begin, linear))
    except NotIdentifiable:  # by accident of the start, or to be said of the minimum
        return problem, begin, linear.rows
    if len(held.basis):
        return *held_at_nominal(problem, begin, held), None
    return problem, begin, linear.rows


def _refined(
    problem: FitProblem,
    outlines: Outlines,
    start: Start,
    first: Minimum[State],
) -> Solution:
    """Refine a first minimum: held directions, rounds, checks, result."""
    refuse_contradicted_values(problem, start, first.state)
    normal = information(problem, first.state, first.linear, problem.loss)
    held = open_directions(problem, first.state, normal)
    refuse_other_board(problem, first.state, normal)
    free, state = problem, first.state
    try:
        if len(held.basis):
            problem, state = held_at_nominal(problem, state, held)
            there = first_minimum(problem, state)
            state = there.state
            first = dataclasses.replace(there, iterations=first.iterations + there.iterations)
        fit = fit_in_rounds(problem, first)
        normal = information(fit.problem, fit.state, fit.minimum.linear, problem.loss)
        refuse_undetermined_inliers(fit.problem, fit.state, normal, held, fit.accepted)
        _refuse_other_radii(problem, fit.state)
    except (DidNotConverge, NotIdentifiable) as failure:
        refuse_contradicted_values(free, start, state, with_priors=True)
        _refuse_contradicted(free, state)
        _refuse_undetermined(free, state)
        if isinstance(failure, DidNotConverge):
            raise naming_stated_values(free, failure) from None
        raise
    if rejected_notes(fit.problem, fit.accepted):
        refuse_contradicted_values(free, start, state, with_priors=True)
    refuse_contradicted_priors(fit.problem, fit.state, normal)
    return assemble_solution(fit, normal, held, outlines, start.label)


def _refuse_undetermined(problem: FitProblem, state: State) -> None:
    """Raise NotIdentifiable if that is why there is no minimum to converge to."""
    open_directions(problem, state, information(problem, state, linearize(problem, state)))


def _refuse_contradicted(problem: FitProblem, state: State) -> None:
    """Raise DidNotConverge if stated priors are why a fit fails."""
    claimed = problem.outlines.covariance
    noise = NoiseModel()
    if len(claimed):
        noise = noise_of_the_median(problem.offsets(state), claimed)
    problem = problem.weighted(noise)
    linear = linearize(problem, state)
    refuse_contradicted_priors(problem, state, information(problem, state, linear))


def _refuse_other_radii(problem: FitProblem, state: State) -> None:
    """Raise DidNotConverge if the fit needs radii that are not those of the legs at all."""
    legs = problem.legs
    problems = [
        f"The joint fit ended with a radius of {1e3 * radius:.2f} mm for "
        f"{legs.names[leg]}.{part}, the model has {1e3 * legs.radii[leg, part]:.2f} mm; they must "
        "agree to a half; check the radius, and the outlines for edges that are swapped or "
        "belong to another leg."
        for (leg, part), radius in zip(problem.outlines.parts, state.radii, strict=True)
        if not abs(radius / legs.radii[leg, part] - 1.0) < _MAX_RADIUS_CHANGE
    ]
    if problems:
        raise DidNotConverge(problems)


def bound(problem: FitProblem, truth: Start, radii: Array | None = None) -> Array:
    """Return the Cramer-Rao bound: the inverse of the information of a fit's data at a state.

    Parameters
    ----------
    problem : FitProblem
        Built of data whose covariances count; of outlines and axes also the lines, as the place
        where these are written: exact ones for the bound to the letter.
    truth : Start
        The true legs, cameras and poses.
    radii : (n_radii,) array, optional
        The true radii [m]; nominal without it.

    Returns
    -------
    (n, n) array
        Covariance of ``problem.named`` with everything else unknown, priors used.

    Raises
    ------
    NotIdentifiable
        If the data do not determine what moves the platform.
    """
    state = problem.begin(truth)
    state = state if radii is None else dataclasses.replace(state, radii=radii)
    normal = information(problem, state, linearize(problem, state))
    open_directions(problem, state, normal)
    return named_covariance(problem, state, normal.kept_covariance())
