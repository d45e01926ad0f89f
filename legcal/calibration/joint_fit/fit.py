"""The joint fit (bundle adjustment): outlines, readings and corners of boards.

A first minimum with a wide robust loss, which outliers cannot lead astray; then rounds that
estimate the noise of outlines, reject outliers, and fit the inliers again.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from legcal.calibration.joint_fit.determinacy import (
    HeldDirections,
    held_at_nominal,
    refuse_undetermined_inliers,
    undetermined_directions,
)
from legcal.calibration.joint_fit.diagnostics import (
    arms_of_other_widths,
    contradicted_boards,
    refuse_contradicted_priors,
    refuse_contradicted_values,
    rejected_notes,
    wrong_arms,
    wrong_arms_in_words,
)
from legcal.calibration.joint_fit.factors import BoardCorners
from legcal.calibration.joint_fit.free_poses import (
    are_free,
    have_outliers,
    in_other_assembly_modes,
    with_better_poses,
    with_free_poses,
)
from legcal.calibration.joint_fit.held_out import Posterior
from legcal.calibration.joint_fit.outline_errors import NoiseModel, robust_noise
from legcal.calibration.joint_fit.parameter_choices import NO_CHOICES, Choices
from legcal.calibration.joint_fit.platform import expected_error, platform_by_parameters
from legcal.calibration.joint_fit.problem import FitProblem, build_fit
from legcal.calibration.joint_fit.rounds import first_minimum, fit_in_rounds
from legcal.calibration.joint_fit.scale import explaining_missing_scale, only_lengths
from legcal.calibration.joint_fit.solution import Solution, assemble_solution
from legcal.calibration.joint_fit.variables import (
    DEFAULT_SETTINGS,
    FittedLegs,
    RefinementSettings,
    Start,
    State,
)
from legcal.data.measurements import Measurements
from legcal.data.outlines import Outlines, are_of_arms
from legcal.data.reasons import Reason, Rejection
from legcal.errors import DidNotConverge, LegcalError, NotIdentifiable
from legcal.estimation.problem import linearize
from legcal.estimation.solver import (
    Minimum,
    information,
    minimise,
    normal_equations,
)
from legcal.machine.leg import Leg

_MAX_RADIUS_CHANGE = 0.5
_COST_TOLERANCE = 1e-6  # relative difference of costs of the same minimum
_POSE_ROUNDS = 8  # searches for better poses, where readings do not determine them
_PART_OF_MODEL = 0.1  # error of the model after a first minimum, over a nominal model's
_SEED = 2001  # of the random starts
_OTHER_MODEL = 0.005  # mean leg lengths or rad: perturbation of the random starts
_SAME_COST = 0.01  # relative difference of costs of the same first minimum
LEAST_GAIN = 0.01  # of the predicted error of the platform, for edges of bodies to be used
_ENOUGH_STARTS = 3  # reaching the same minimum: no better one is near


def refine(
    legs: FittedLegs,
    measurements: Measurements,
    outlines: Outlines,  # in pixels; only the used ones enter
    start: Start | Sequence[Start],
    settings: RefinementSettings = DEFAULT_SETTINGS,
    *,
    board: BoardCorners | None = None,  # boards fixed to base and platform, and their corners
    choices: Choices = NO_CHOICES,
    edges: Outlines | None = None,  # of bodies, parallel to their legs; only the used ones enter
) -> Solution:
    """Fit kinematic parameters, cameras, platform poses and radii jointly to all data.

    From several starts, the lowest first minimum is refined; if that fails, the next one. A start
    that fails is skipped with a note; between equal costs the earlier start wins.

    Raises NotIdentifiable if the data do not determine the parameters, from any start;
    DidNotConverge if the solver does not converge from any start, or most outlines are outliers of
    the fit; DatasetError if an outline cannot be used.
    """
    starts = [start] if isinstance(start, Start) else start

    def fitted(used: Outlines, edges: Outlines | None = edges) -> Solution:
        problem = build_fit(
            legs, measurements, used, settings, board=board, choices=choices, edges=edges
        )
        problem.require_determined()
        with explaining_missing_scale(problem):
            solution = _fit_from_best_start(problem, used, starts)
        if edges is None:
            return solution
        gain = _gain_by_edges(solution.posterior)
        if 0.0 < gain < LEAST_GAIN:
            why = Rejection(Reason.LITTLE_GAIN, f"{100.0 * gain:.2g} %")
            return fitted(used, edges.reject(edges.used, [why] * len(edges)))
        return _with_edges(solution, edges, gain)

    return _fit_without_wrong_arms(fitted, outlines, legs.nominal)


def _fit_without_wrong_arms(
    fitted: Callable[[Outlines], Solution], outlines: Outlines, legs: Sequence[Leg]
) -> Solution:
    """Fit; leave out arms that contradict the fit, with all their outlines, and fit again.

    Rods alone determine the fit, and outlines of arms that are not cylinders would bias it or raise
    the estimated noise. If the fit fails with arms, all of them are left out.
    """
    is_arm = are_of_arms(outlines, legs)
    notes, wrong = list[str](), arms_of_other_widths(outlines, is_arm)
    while True:
        if wrong:
            left_out = is_arm & np.isin(outlines.leg, list(wrong))
            outlines = outlines.reject(left_out, Reason.ARM_LEFT_OUT)
            notes.append(f"Arms were left out as a whole: {wrong_arms_in_words(wrong, legs)}")
        try:
            solution = fitted(outlines)
            fit = solution.posterior
            wrong = wrong_arms(fit.problem, fit.state, fit.noise, solution.outlines)
        except (DidNotConverge, NotIdentifiable):
            with_arms = np.unique(outlines.leg[is_arm & outlines.used]).tolist()
            if not with_arms:
                raise
            wrong = dict.fromkeys(with_arms, "the joint fit fails when their outlines are used")
        else:
            if not wrong:
                return dataclasses.replace(solution, notes=(*notes, *solution.notes))


def _gain_by_edges(fit: Posterior) -> float:
    """Return the part by which edges of bodies lower the predicted error of the platform.

    One where the rest does not determine it, or nothing is estimated; zero without such edges.
    """
    problem, state, n = fit.problem, fit.state, fit.problem.n_kinematic
    factor, legs = problem.factor("edges"), problem.legs
    if not np.any(factor.whitening):
        return 0.0
    without = problem.with_factors(
        dataclasses.replace(factor, whitening=np.zeros_like(factor.whitening))
    )
    try:
        by_parameters = platform_by_parameters(
            state.legs, legs.parametrization, legs.frame_legs, state.platform_pose.motions
        )[..., problem.free]
        errors = []
        for one in (problem, without):
            normal = normal_equations(linearize(one, state))
            undetermined_directions(normal)
            covariance = normal.kept_covariance()[:n, :n]
            errors.append(expected_error(by_parameters, covariance).mean_displacement)
    except NotIdentifiable:
        return 1.0
    return 1.0 - errors[0] / errors[1] if errors[1] > 0.0 else 1.0


def _with_edges(solution: Solution, edges: Outlines, gain: float) -> Solution:
    """Return a solution with the edges of bodies and their rejections, and a detail on them."""
    problem = solution.posterior.problem
    used, weight = problem.edges, np.ravel(problem.factor("edges").whitening)
    disagrees = np.zeros(len(edges), dtype=np.bool_)
    disagrees[used.index] = weight == 0.0
    sigma = solution.quality.edges_px
    if sigma is None:
        return dataclasses.replace(solution, edges=edges.reject(disagrees, Reason.DISAGREES))
    detail = (
        f"{np.count_nonzero(weight)} of {len(edges)} edges of bodies were used; one end of an "
        f"edge, seen from the other, is known to {sigma:.2f} px. "
        + (
            f"They lower the predicted error of the platform by {100.0 * gain:.0f} %."
            if gain < 1.0
            else "Without them the platform would not be determined."
        )
    )
    return dataclasses.replace(
        solution,
        edges=edges.reject(disagrees, Reason.DISAGREES),
        details=(*solution.details, detail),
    )


def _origin(start: Start) -> str:
    """Origin of a start, for messages."""
    origins = {"nominal": "the nominal model", "staged": "the four steps"}
    return origins.get(start.label, f"the start '{start.label}'")


def _fit_from_best_start(
    problem: FitProblem, outlines: Outlines, starts: Sequence[Start]
) -> Solution:
    """Fit from the start with the lowest first minimum."""
    candidates: list[tuple[Start, Minimum[State]]] = []
    notes, details = list[str](), list[str]()
    failures: list[LegcalError] = []
    for start in starts:
        origin = _origin(start)
        try:
            minimum = _first_minimum(problem, start)
        except (DidNotConverge, NotIdentifiable) as failure:
            failures.append(failure)
            notes.append(f"The joint fit failed from {origin}. {failure}")
            continue
        if len(starts) > 1:
            cost = f"{minimum.cost:.6g}"
            details.append(f"Starting from {origin}, the joint fit reached a cost of {cost}.")
        bound_of_ties = (1.0 + _COST_TOLERANCE) * minimum.cost
        rank = sum(other.cost <= bound_of_ties for _, other in candidates)
        candidates.insert(rank, (start, minimum))
    for start, minimum in candidates:
        try:
            solution = _refine_minimum(problem, outlines, start, minimum)
        except (DidNotConverge, NotIdentifiable) as failure:
            failures.append(failure)
            notes.append(f"The joint fit from {_origin(start)} was abandoned. {failure}")
            continue
        if solution.left_out or _common_mode_px(solution) > problem.settings.largest_rms_px:
            solution = _retry_from_other_starts(problem, outlines, start, minimum, solution)
        shifted, most_px = _common_mode_px(solution), problem.settings.largest_rms_px
        if shifted > most_px:
            kind = max(solution.quality.shared_px, key=solution.quality.shared_px.__getitem__)
            what, remedy = "", "check camera poses, readings and outlines, or the nominal model"
            if solution.camera_doubts:
                wrong = max(solution.camera_doubts, key=lambda one: one.apart)
                what, remedy = f"{wrong.what}, and ", wrong.remedy
            what += (
                f"many outlines are shifted together by {shifted:.1f} px ({kind}), where light and "
                f"blur explain at most {most_px:g} px"
            )
            raise DidNotConverge(f"{what[0].upper()}{what[1:]}; {remedy}.")
        return dataclasses.replace(
            solution, notes=(*solution.notes, *notes), details=tuple(details)
        )
    if failures and all(isinstance(failure, NotIdentifiable) for failure in failures):
        raise failures[0]
    problems = dict.fromkeys(problem for failure in failures for problem in failure.facts)
    raise DidNotConverge(
        list(problems) or "The fit was given no starting values; it needs at least one."
    )


def _retry_from_other_starts(
    problem: FitProblem,
    outlines: Outlines,
    start: Start,
    first: Minimum[State],
    best: Solution,
) -> Solution:
    """Retry from perturbed models after a fit that rejected a leg of a view; return the better fit.

    Outlines of one leg in one view are not wrong together by chance: they show another leg, or the
    fit is at a wrong minimum, possibly with small residuals elsewhere. Perturbed nominal models are
    tried until a fit rejects no leg of a view, or several starts reach the same minimum, which
    confirms that the outlines are wrong.
    """
    rng, start_state = np.random.default_rng(_SEED), problem.begin(start)
    n = problem.n_kinematic
    unit = np.array([start_state.mean_length if unit == "m" else 1.0 for unit in problem.units[:n]])
    n_same = 0
    for _ in range(problem.settings.other_starts):
        step = np.zeros(problem.size)
        step[:n] = _OTHER_MODEL * unit * rng.normal(size=n)
        try:
            minimum = _first_minimum(problem, start, problem.moved(start_state, step))
            if minimum.cost > (1.0 - _SAME_COST) * first.cost:
                n_same += minimum.cost < (1.0 + _SAME_COST) * first.cost
                if n_same == _ENOUGH_STARTS:
                    return dataclasses.replace(best, left_out=())
                continue
            best = _refine_minimum(problem, outlines, start, minimum)
        except (DidNotConverge, NotIdentifiable):
            continue
        if not best.left_out and _common_mode_px(best) <= problem.settings.largest_rms_px:
            break
        first, n_same = minimum, 0
    return best


def _common_mode_px(solution: Solution) -> float:
    """Largest standard deviation of common-mode edge biases [px]."""
    return max(solution.quality.shared_px.values(), default=0.0)


def _first_minimum(problem: FitProblem, start: Start, begin: State | None = None) -> Minimum[State]:
    """First minimum from a start, or from the state *begin* near it."""
    begin = problem.begin(start) if begin is None else begin
    try:
        if are_free(problem, begin):
            return _first_minimum_with_free_poses(problem, begin)
        return _in_best_assembly_modes(problem, _first_minimum_from(problem, begin))
    except DidNotConverge:
        refuse_contradicted_values(problem, start, begin, with_priors=True)
        _refuse_undetermined(problem, begin)
        raise


def _in_best_assembly_modes(problem: FitProblem, first: Minimum[State]) -> Minimum[State]:
    """First minimum with poses in another assembly mode where that lowers the cost.

    Forward kinematics of a start that is a few millimetres off may close in a wrong one, and no
    small step leads back: the images of such poses would be rejected as outliers.
    """
    state = in_other_assembly_modes(problem, first.state, _PART_OF_MODEL)
    if state is first.state:
        return first
    other = _first_minimum_from(problem, state, must_converge=False)
    return other if other.cost < first.cost else first


def _first_minimum_with_free_poses(problem: FitProblem, start_state: State) -> Minimum[State]:
    """First minimum, with a search for better poses of images with large residuals."""
    try:
        best = _first_minimum_from(problem, start_state)
        if not have_outliers(problem, best.state):
            return best
    except DidNotConverge:
        best = None
    # Poses of wrong images drift without end: only the last minimisation has to converge.
    state = with_free_poses(problem, problem.projected(start_state))
    candidate = _first_minimum_from(problem, state, must_converge=False)
    best = candidate if best is None or candidate.cost < best.cost else best
    for k in range(_POSE_ROUNDS):
        if not have_outliers(problem, best.state):
            break
        state = with_better_poses(problem, best.state, _PART_OF_MODEL, seed=k)
        candidate = _first_minimum_from(problem, state, must_converge=False)
        best = candidate if candidate.cost < best.cost else best
    return best


def _first_minimum_from(
    problem: FitProblem, begin: State, *, must_converge: bool = True
) -> Minimum[State]:
    """First minimum from a state, with the directions held that are open there."""
    begin = problem.projected(begin)
    with contextlib.suppress(NotIdentifiable):  # at the start only, or reported at the minimum
        held = undetermined_directions(information(linearize(problem, begin)))
        if len(held.basis):
            problem, begin = held_at_nominal(problem, begin, held)
    return first_minimum(problem, begin, must_converge=must_converge)


def _refine_minimum(
    problem: FitProblem,
    outlines: Outlines,
    start: Start,
    first: Minimum[State],
) -> Solution:
    """Refine a first minimum: held directions, rounds, checks, result."""
    refuse_contradicted_values(problem, start, first.state)
    # The first minimum may hold directions that are open at its start
    normal = information(dataclasses.replace(first.linear, problem=problem), problem.loss)
    held = undetermined_directions(normal)
    contradicted = contradicted_boards(normal)
    if contradicted:  # measurements that hardly tell the scale leave it where steps ended
        weighted = first.linear.problem
        settled = minimise(weighted, first.state, problem.loss, must_converge=False).linear
        at_minimum = information(dataclasses.replace(settled, problem=problem), problem.loss)
        contradicted = contradicted_boards(at_minimum)
    # Edges of photographs may share errors, by which radii seem to contradict a board: they are
    # estimated in the rounds
    if contradicted and not problem.choices.of_photographs:
        raise DidNotConverge(contradicted)
    while True:
        try:
            fit = fit_in_rounds(problem, first, held)
            normal = information(fit.minimum.linear, problem.loss)
            refuse_undetermined_inliers(normal, held, fit.accepted)
            _refuse_other_radii(problem, fit.state)
            break
        except (DidNotConverge, NotIdentifiable):
            if contradicted:
                raise DidNotConverge(contradicted) from None
            within, at = held_at_nominal(problem, first.state, held)
            if len(held.basis):
                at = first_minimum(within, at, must_converge=False).state
            more = _open_farther_on(problem, within, at, len(held.basis))
            if more is None:
                refuse_contradicted_values(problem, start, at, with_priors=True)
                _refuse_contradicted(problem, at)
                _refuse_undetermined(problem, at)
                raise
            held = more
    if contradicted and contradicted_boards(normal):
        raise DidNotConverge(contradicted)
    if rejected_notes(fit.problem, fit.accepted):
        refuse_contradicted_values(problem, start, first.state, with_priors=True)
    refuse_contradicted_priors(normal, only_lengths(problem))
    return assemble_solution(fit, normal, held, outlines, start.label)


def _open_farther_on(
    problem: FitProblem, held: FitProblem, state: State, n_held: int
) -> HeldDirections | None:
    """Return the open directions near the minimum if they are more than those held so far.

    Axes of a translational 3-UPU look determined where the first minimum has them, and are not
    where they are parallel.
    """
    with contextlib.suppress(DidNotConverge, NotIdentifiable):
        near = minimise(held, state, held.loss, must_converge=False).state
        found = undetermined_directions(information(linearize(problem, near)))
        return found if len(found.basis) > n_held else None
    return None


def _refuse_undetermined(problem: FitProblem, state: State) -> None:
    """Raise NotIdentifiable if open directions explain a failed fit."""
    undetermined_directions(information(linearize(problem, state)))


def _refuse_contradicted(problem: FitProblem, state: State) -> None:
    """Raise DidNotConverge if stated priors explain a failed fit."""
    claimed = problem.outlines.covariance
    noise = NoiseModel()
    if len(claimed):
        noise = robust_noise(problem.offsets(state), claimed)
    normal = information(linearize(problem.weighted(noise), state))
    refuse_contradicted_priors(normal, only_lengths(problem))


def _refuse_other_radii(problem: FitProblem, state: State) -> None:
    """Raise DidNotConverge if fitted radii are far from the model's."""
    legs = problem.legs
    problems = [
        f"The joint fit ended with a radius of {1e3 * radius:.2f} mm for "
        f"{legs.names[leg]}.{part}; the model has {1e3 * legs.radii[leg, part]:.2f} mm, and they "
        "must agree to 50 %; check the radius, and the outlines for edges that are swapped or "
        "belong to another leg."
        for (leg, part), radius in zip(problem.outlines.parts, state.radii, strict=True)
        if not abs(radius / legs.radii[leg, part] - 1.0) < _MAX_RADIUS_CHANGE
    ]
    if problems:
        raise DidNotConverge(problems)
