"""Tests of stated priors, fixed values, cameras, radii and arms against the measurements.

A stated prior is tested against the estimate from measurements and other priors; a fixed value by
a second fit with the parameter free.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from legcal.calibration.joint_fit.determinacy import HeldDirections, undetermined_directions
from legcal.calibration.joint_fit.outline_errors import NoiseModel
from legcal.calibration.joint_fit.parameter_choices import Prior, board_scale
from legcal.calibration.joint_fit.problem import FitNormal, FitProblem
from legcal.calibration.joint_fit.rounds import Fit, first_minimum, fit_in_rounds
from legcal.calibration.joint_fit.variables import Start, State, intrinsic_of
from legcal.calibration.tuning import SCATTER_BY_CHANCE
from legcal.data.outlines import Outlines
from legcal.data.reasons import Reason
from legcal.errors import Code, DidNotConverge, NotIdentifiable, Problem
from legcal.estimation.solver import information, inverse_on_range
from legcal.estimation.uncertainty import marginal, named_information
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import LINKS, Leg, ParameterId, radius_name
from legcal.machine.parameters import list_in_words
from legcal.machine.rods import actuators_of
from legcal.vision.camera import intrinsic_names, intrinsic_unit

_SIGNIFICANT = 5.0  # standard deviations between a prior and the measurements
_MIN_INFORMATION = 1e-9  # least information of measurements for a test, over the prior's
_MIN_INFORMATION_WIDE = 1e-3  # the same for the wide prior in place of a fixed value
_MAX_SCALE_SIGMA = 0.05  # largest standard deviation of the size of a board for a test
_WIDE_SIGMA = 0.05  # mean leg lengths or rad: the wide prior in place of a fixed value
_WIDE_RADIUS = 0.2  # relative, of a radius
_MAX_VARIANCE_SHARE = 0.5  # posterior over prior variance, for a test
_NOMINAL_SIGMA = 0.01  # mean leg lengths: error of a nominal model along held directions
_MANY_REJECTED = 0.1  # of all outlines
_MOST_REJECTED = 0.5  # of the outlines of a leg or a view
# An arm that is no cylinder: its median outline error over that of rods (at most 1.8 for 204
# cylindrical arms in benchmarks/arm_misfits.py), and [px]
ARM_MISFIT, _ARM_MISFIT_PX = 2.0, 0.03
_MIN_COUNT = 3  # rejected outlines of a leg or a view, at least, before it is noted
MOST_SCATTER = 2.0  # of outlines, over the standard deviations that they came with
RADIUS_SIGMAS = 3.0  # between fitted and nominal radii with default priors
_MAX_NAMES = 4  # names listed; further ones are counted


def refuse_contradicted_priors(normal: FitNormal, by_model: Collection[str]) -> None:
    """Refuse stated priors that contradict the measurements.

    *normal* is the information at a minimum, *by_model* are lengths of which only the radii of the
    model say anything else.

    Raises DidNotConverge with one sentence for each prior.
    """
    problem = normal.problem
    if not problem.settings.judges_stated_values:
        return
    names = problem.choices.priors.keys()
    unit_of = dict(zip(problem.named, problem.units, strict=True))
    # A stated length stands beside the tolerance of its part: the narrower one is named.
    problems = {
        name: _contradiction(
            name,
            unit_of[name],
            (prior.mean, prior.sigma),
            estimate.mean,
            apart,
            by_model=name in by_model,
        )
        for name, prior, estimate, apart in sorted(
            _contradicted(normal, names), key=lambda one: -one[1].sigma
        )
    }
    if problems:
        raise DidNotConverge([Problem(one, code=Code.BAD_VALUE) for one in problems.values()])


def _contradiction(
    name: str,
    unit: str,
    stated: tuple[float, float],  # value and standard deviation, zero where it is fixed
    measured: float,
    apart: float,  # standard deviations
    *,
    by_model: bool = False,  # whether only the radii of the model contradict it
) -> str:
    """Describe a stated value that the measurements contradict."""
    mean, sigma = stated
    what, remedy = ("prior", "") if sigma else ("fixed value", "give it a prior, ")
    given = "stated or assumed" if sigma else "stated"  # of a twist without a choice
    in_words = f"{mean:.6g} +- {sigma:.2g} {unit}" if sigma else f"{mean:.6g} {unit}"
    against, by = "the measurements", "measured"
    correct = "correct it, or readings and camera files that contradict it, "
    if by_model:
        against, by = "the radii of the model", "by these"
        correct = (
            "either may be wrong: measure it again, and use the model of this machine's size, "
        )
    return (
        f"The {what} of {name} contradicts {against}: {given} {in_words}, {by} about "
        f"{measured:.4g} {unit}, {apart:.0f} standard deviations apart (limit {_SIGNIFICANT:g}); "
        f"{correct}{remedy}or free it (--set {name}=free)."
    )


def contradicted_boards(normal: FitNormal) -> list[Problem]:
    """Return calibration boards whose dimensions in the dataset contradict the measurements.

    Encoders and radii carry the scale too. A board with a stated prior is tested with the priors.
    *normal* is the information at a minimum.
    """
    board_of = {board_scale(link): "" if link == "base" else f" on the {link}" for link in LINKS}
    names = board_of.keys() - normal.problem.choices.priors.keys()
    found = [
        f"The dimensions of the calibration board{board_of[name]} contradict the readings and the "
        f"legs: the board is {estimate.mean:.4g} times the size stated in the dataset "
        f"({apart:.0f} standard deviations; assumed accuracy {1e2 * prior.sigma:.2g} %); "
        "measure the board and correct its dimensions in dataset.yaml, or the scale of the "
        f"readings if the board is right, or estimate the size of the board (--set {name}=free)."
        for name, prior, estimate, apart in _contradicted(normal, names)
        if estimate.sigma <= _MAX_SCALE_SIGMA
    ]
    return [Problem(one, code=Code.BAD_VALUE) for one in found]


def _contradicted(
    normal: FitNormal, names: Collection[str], most: float = _SIGNIFICANT
) -> Iterator[tuple[str, Prior, Prior, float]]:
    """Yield priors of named unknowns that the measurements contradict.

    Each with its name, the estimate without it, and their distance in standard deviations.

    The unknown is estimated without its prior; measurements that hardly depend on it say nothing.
    For the information I of the measurements, an estimate at a distance d from the prior mean moves
    to d (1 + 1 / (I sigma^2)) without the prior. The difference has the variance sigma^2 + 1 / I.
    """
    problem, information_of_named = normal.problem, named_information(normal)
    priors, coordinates = problem.priors, problem.coordinates(normal.state)
    for i, mean, sigma in zip(
        priors.unknown.tolist(), priors.mean.tolist(), priors.sigma.tolist(), strict=True
    ):
        if problem.named[i] not in names:
            continue
        measured = float(marginal(information_of_named, np.array([i]))[0, 0]) - 1.0 / sigma**2
        if measured < _MIN_INFORMATION / sigma**2:
            continue
        offset = (float(coordinates[i]) - mean) * (1.0 + 1.0 / (measured * sigma**2))
        apart = abs(offset) / float(np.sqrt(sigma**2 + 1.0 / measured))
        if apart > most:
            estimate = Prior(mean + offset, float(measured**-0.5))
            yield problem.named[i], Prior(mean, sigma), estimate, apart


def refuse_contradicted_values(
    problem: FitProblem,  # without held directions and edge biases
    start: Start,
    state: State,  # the minimum or the last state, with the values fixed
    *,
    with_priors: bool = False,  # also test stated priors
) -> None:
    """Refuse fixed values that contradict the measurements.

    The fit is repeated with the values free. It estimates the noise of outlines, so that too small
    claimed covariances do not refuse a right value. It starts from *start*, and from *state* if
    that fails; if both fail, nothing is refused.

    Raises DidNotConverge, one sentence for each value.
    """
    if not problem.settings.judges_stated_values:
        return
    choices, values = problem.choices, _values(problem, state)
    stated = {name: (values[name], 0.0) for name in _fixed_by_choice(problem)}
    if with_priors:
        stated |= {name: (p.mean, p.sigma) for name, p in choices.priors.items() if name in values}
    if not stated:
        return
    wide = {
        name: _wide_prior(problem, state, name, values[name], sigma)
        for name, (_, sigma) in stated.items()
    }
    wider_choices = replace(
        choices, fixed=choices.fixed - wide.keys(), priors={**choices.priors, **wide}
    )
    wider = problem.with_choices(wider_choices)
    # Parameters determined by ties stay fixed: no measurement depends on them.
    stated = {name: value for name, value in stated.items() if name in wider.named}
    if not stated:
        return
    comparisons: list[tuple[str, str, float, tuple[float, float]]] = []
    for start_state in (wider.begin(start), state):
        try:
            first = first_minimum(wider, start_state)
            held = undetermined_directions(information(first.linear, wider.loss))
            fit = fit_in_rounds(wider, first, held)
        except (DidNotConverge, NotIdentifiable):
            continue
        comparisons = _compare(fit, held, stated, wide)
        break
    for k in range(2):
        problems = [
            _contradiction(name, unit, stated[name], estimate, sigmas[k])
            for name, unit, estimate, sigmas in comparisons
            if sigmas[k] > _SIGNIFICANT
        ]
        if problems:
            raise DidNotConverge([Problem(one, code=Code.BAD_VALUE) for one in problems])


def _fixed_by_choice(problem: FitProblem) -> tuple[str, ...]:
    """Names of parameters fixed by choice: kinematic ones, radii, intrinsics with a value."""
    legs, choices = problem.legs, problem.choices
    radii = (radius_name(legs.names[leg], part) for leg, part in problem.outlines.parts)
    candidates = {*legs.parametrization.names, *radii, *choices.values}
    return tuple(sorted(choices.fixed & candidates))


def _values(problem: FitProblem, state: State) -> dict[str, float]:
    """Values of all parameters that can be stated, by name."""
    legs = problem.legs
    values = dict(zip(legs.parametrization.names, legs.vector(state.legs).tolist(), strict=True))
    for (leg, part), radius in zip(problem.outlines.parts, state.radii.tolist(), strict=True):
        values[radius_name(legs.names[leg], part)] = radius
    for view, camera in zip(problem.outlines.views, state.cameras, strict=True):
        for key in intrinsic_names(camera):
            values[f"{view}.{key}"] = intrinsic_of(camera, key)
    return values


def _wide_prior(problem: FitProblem, state: State, name: str, value: float, sigma: float) -> Prior:
    """Return a nearly uninformative prior around a value."""
    names, units = problem.legs.parametrization.names, problem.legs.parametrization.units
    parameter = ParameterId.parse(name)
    if name in names:
        wide = _WIDE_SIGMA * (state.mean_length if units[names.index(name)] == "m" else 1.0)
    elif parameter.kind == "radius":
        wide = _WIDE_RADIUS * value
    else:
        camera = state.cameras[problem.outlines.views.index(parameter.owner)]
        is_px = intrinsic_unit(parameter.kind) == "px"
        wide = _WIDE_SIGMA * (camera.K[0, 0] if is_px else 1.0)
    return Prior(value, max(float(wide), sigma))


def _compare(
    fit: Fit,
    held: HeldDirections,
    stated: Mapping[str, tuple[float, float]],
    wide: Mapping[str, Prior],
) -> list[tuple[str, str, float, tuple[float, float]]]:
    """Compare stated values with their estimates, where the measurements depend on them.

    Return names and units, estimates, and their differences in standard deviations: with the other
    stated values free, and with these right.

    M is the information of these parameters, including their wide priors P around w, and f the
    estimates. The measurements alone have the information K = M - P, and the gradient
    M f - P w - K m at the stated values m.
    """
    problem, state = fit.problem, fit.state
    total_information = named_information(information(fit.minimum.linear, problem.loss))
    total_information += _held_information(problem, held, state.mean_length)
    unknowns = np.array([problem.named.index(name) for name in stated], dtype=np.intp)
    fitted = problem.coordinates(state)[unknowns]
    M, P = (
        marginal(total_information, unknowns),
        np.array([wide[name].sigma ** -2 for name in stated]),
    )
    mean, sigma = np.array(list(stated.values())).T
    wide_mean = np.array([wide[name].mean for name in stated])
    covariance = inverse_on_range(M)
    slope = M @ (fitted - mean) - P * (wide_mean - mean)
    comparisons = []
    for i, name in enumerate(stated):
        measured = M[i, i] - P[i]
        if measured < _MIN_INFORMATION_WIDE * P[i]:
            continue
        joint_sigmas = abs(fitted[i] - mean[i]) / np.sqrt(covariance[i, i] + sigma[i] ** 2)
        together = float(joint_sigmas) if covariance[i, i] * P[i] < _MAX_VARIANCE_SHARE else 0.0
        alone = float(abs(slope[i] / measured) / np.sqrt(1.0 / measured + sigma[i] ** 2))
        unit = problem.units[unknowns[i]]
        comparisons.append((name, unit, float(fitted[i]), (together, alone)))
    return comparisons


def _held_information(problem: FitProblem, held: HeldDirections, length: float) -> Array:
    """Information (n_named, n_named) of the nominal model along held directions.

    A stated value may determine a direction that the fit holds at nominal, as a radius does the
    size of a translational 3-UPU; the measurements then do not contradict it.
    """
    n = problem.n_named
    rows, sigma = np.zeros((len(held.basis), n)), _NOMINAL_SIGMA * length * held.unit
    rows[:, np.setdiff1d(np.arange(n), problem.where("biases"))] = held.basis / sigma
    return rows.T @ rows


@dataclass(frozen=True, eq=False)
class Scatter:
    """Outlines about a fit, over the standard deviations that they came with."""

    squares: Array  # (n,) of each outline, by the number of its residuals
    used: BoolArray  # (n,) by the fit

    @classmethod
    def of(cls, problem: FitProblem, state: State) -> Scatter:
        """Return the scatter at a minimum."""
        claimed = problem.outlines.covariance
        squares = NoiseModel().squared_norms(problem.offsets(state), claimed) / 2.0
        whitening = np.asarray(problem.factor("outlines").whitening)
        used = np.asarray(np.any(whitening, axis=(1, 2)))
        return cls(squares, used)

    def ratio(self, of: BoolArray | bool = True) -> float:
        """Return the root mean square of some outlines, or of all that are used; 0 without any."""
        squares = self.squares[self.used & of]
        return float(np.sqrt(np.mean(squares))) if len(squares) else 0.0

    def is_beyond_chance(self, of: BoolArray, n_groups: int) -> bool:
        """Return whether outlines scatter more than one of so many groups does by chance."""
        squares = self.squares[self.used & of]
        chance = float(chdtrc(2.0 * len(squares), 2.0 * squares.sum())) if len(squares) else 1.0
        return n_groups * chance < SCATTER_BY_CHANCE


def rejected_notes(problem: FitProblem, accepted: BoolArray) -> tuple[str, ...]:
    """Return a note if many outlines, or most of a leg or of a view, were rejected."""
    o = problem.outlines
    legs = _mostly_rejected(o.leg, problem.legs.names, o.index, accepted | o.on_arm)
    views = _mostly_rejected(o.view, o.views, o.index, accepted)
    n, n_rejected = len(accepted), int(np.sum(~accepted))
    groups = [
        f"{rejected} of {total} of {name}" for name, (rejected, total) in (legs | views).items()
    ]
    groups = groups or list(legs_left_out(problem, accepted))
    if not groups and n_rejected <= _MANY_REJECTED * n:
        return ()
    note = (
        f"The fit rejected {n_rejected} of {n} outlines"
        f"{', ' + ', '.join(groups) if groups else ''}; the stated uncertainty is valid only if "
        "these outlines are wrong; check them and their reasons in observations.csv"
    )
    stated = [
        name
        for name in stated_parameters(problem)
        if any(ParameterId.parse(end).owner in legs for end in name.split(":"))
    ]
    if stated:
        note += f", and the stated values of {_first_names(stated)}"
    return (f"{note}.",)


def legs_left_out(problem: FitProblem, accepted: BoolArray) -> tuple[str, ...]:
    """Return the legs in views with most outlines rejected, and their numbers.

    Only rejections in several images of the view count: one wrong image is chance.
    """
    o, names = problem.outlines, problem.legs.names
    accepted = accepted | o.on_arm  # a bad arm says nothing about its rod
    leg_in_view = o.leg * len(o.views) + o.view
    labels = [f"{leg} in view {view}" for leg in names for view in o.views]
    return tuple(
        f"{rejected} of {total} of {labels[k]}"
        for k in np.unique(leg_in_view[~accepted]).tolist()
        if (rejected := int(np.sum(own := (leg_in_view == k) & ~accepted)))
        > _MOST_REJECTED * (total := int(np.sum(leg_in_view == k)))
        and len(np.unique(o.pose[own])) >= _MIN_COUNT
    )


def arms_of_other_widths(outlines: Outlines, is_arm: BoolArray) -> dict[int, str]:
    """Return the legs whose arms have another width than the model's in most images, with reasons.

    *is_arm* marks the outlines of arms in the table. Both edges of an arm of another shape or
    radius are detected in most images; the outlines in use passed the test by chance.
    """
    is_wide = outlines.rejected_for(Reason.WIDTH)
    reasons = dict[int, str]()
    for leg in np.unique(outlines.leg[is_arm & outlines.used]).tolist():
        of_leg = is_arm & (outlines.leg == leg)
        n_wrong, total = int(is_wide[of_leg].sum()), int((is_wide | outlines.used)[of_leg].sum())
        if n_wrong >= _MIN_COUNT and n_wrong > _MOST_REJECTED * total:
            reasons[leg] = f"{n_wrong} of {total} outlines have another width than the model's"
    return reasons


def wrong_arms_in_words(wrong: Mapping[int, str], legs: Sequence[Leg]) -> str:
    """Describe the wrong arms of :func:`wrong_arms`."""
    reasons: dict[str, list[str]] = {}
    for j, reason in wrong.items():
        reasons.setdefault(reason, []).append(str(legs[j].prismatic))
    description = "; ".join(
        f"{list_in_words(names)} ({reason})" for reason, names in reasons.items()
    )
    return (
        f"the arms of {description}. They are not the cylinders of the model: correct their radii, "
        "or model other shapes as boxes or meshes."
    )


def wrong_arms(
    problem: FitProblem, state: State, noise: NoiseModel, outlines: Outlines
) -> dict[int, str]:
    """Return the legs whose arms contradict the fit, each with a reason.

    Most outlines of such an arm were rejected, or its median outline error is much larger than
    that of the rods, in standard deviations of the estimated noise. *outlines* is the table with
    the rejections of the fit.
    """
    o = problem.outlines
    used, reasons = outlines.used[o.index], dict[int, str]()
    for leg, (times, offset_px) in arm_misfits(problem, state, noise).items():
        of_arm = o.on_arm & (o.leg == leg)
        total, rejected = int(of_arm.sum()), int(np.sum(of_arm & ~used))
        if rejected >= _MIN_COUNT and rejected > _MOST_REJECTED * total:
            reasons[leg] = f"{rejected} of {total} outlines disagree with the fit"
        elif times > ARM_MISFIT and offset_px > _ARM_MISFIT_PX:
            reasons[leg] = f"errors of outlines are {times:.1f} times as large as for rods"
    return reasons


def arm_misfits(
    problem: FitProblem, state: State, noise: NoiseModel
) -> dict[int, tuple[float, float]]:
    """Median outline error of each leg's arm: over that of rods, and [px].

    The ratio is of errors in standard deviations of the estimated noise. Empty without rods.
    """
    o = problem.outlines
    if not o.on_arm.any() or o.on_arm.all():
        return {}
    offsets, misfits = problem.offsets(state), dict[int, tuple[float, float]]()
    whitened = np.linalg.solve(noise.covariance(o.covariance), offsets[..., None])[..., 0]
    squares, distance = np.sum(offsets * whitened, axis=1), np.abs(offsets).max(axis=1)
    rod_median = float(np.median(squares[~o.on_arm]))
    for leg in np.unique(o.leg[o.on_arm]).tolist():
        of_arm = o.on_arm & (o.leg == leg)
        times = float(np.sqrt(np.median(squares[of_arm]) / rod_median)) if rod_median > 0.0 else 0.0
        misfits[leg] = times, float(np.median(distance[of_arm]))
    return misfits


def reversed_motors(problem: FitProblem, state: State) -> tuple[str, ...]:
    """Return a note on motors whose fitted axes are opposite to the model's."""
    pairs = zip(actuators_of(state.legs), actuators_of(problem.legs.nominal), strict=True)
    names = [fitted.joint for fitted, nominal in pairs if fitted.axis @ nominal.axis < 0.0]
    if not names:
        return ()
    return (
        f"The readings of {list_in_words(names)} have the opposite sign in the model (the fitted "
        "axes or directions are reversed); correct them in the model, or negate the readings (for "
        "a servo, the sign of us_per_deg).",
    )


def contradicted_radii(normal: FitNormal) -> list[str]:
    """Return a note on nominal radii, with default priors, that contradict the measurements."""
    problem = normal.problem
    radii = {radius_name(problem.legs.names[leg], part) for leg, part in problem.outlines.parts}
    names = radii - problem.choices.priors.keys()
    contradictions = [
        f"{name} {1e3 * estimate.mean:.2f} mm against {1e3 * prior.mean:.2f} +- "
        f"{1e3 * prior.sigma:.2f} mm ({apart:.0f} standard deviations)"
        for name, prior, estimate, apart in _contradicted(normal, names, RADIUS_SIGMAS)
    ]
    if not contradictions:
        return []
    return [
        f"The measurements contradict radii of the model: {'; '.join(contradictions)}; limit "
        f"{RADIUS_SIGMAS:g} standard deviations; measure these parts and correct the model."
    ]


def stated_parameters(problem: FitProblem) -> list[str]:
    """Names of parameters with a stated prior or value; not twists with a nominal prior."""
    legs = problem.legs
    nominal = zip(legs.parametrization.names, legs.vector(legs.nominal).tolist(), strict=True)
    nominal_twists = {
        name: value for name, value in nominal if ParameterId.parse(name).kind == "twist"
    }
    priors = sorted(problem.choices.priors.items())
    return [
        *(name for name, prior in priors if nominal_twists.get(name) != prior.mean),
        *_fixed_by_choice(problem),
    ]


def _first_names(names: list[str]) -> str:
    """List the first names and count the others."""
    n_more = len(names) - _MAX_NAMES
    return ", ".join(names[:_MAX_NAMES]) + (f" and {n_more} more" if n_more > 0 else "")


def _mostly_rejected(
    group: IntArray, names: Sequence[str], row: IntArray, accepted: BoolArray
) -> dict[str, tuple[int, int]]:
    """Rejected and total outlines of groups with most rejected, in the order of the table."""
    total = np.bincount(group, minlength=len(names))
    rejected = np.bincount(group[~accepted], minlength=len(names))
    selected = np.flatnonzero(
        (rejected >= _MIN_COUNT) & (rejected > _MOST_REJECTED * total)
    ).tolist()
    selected.sort(key=lambda i: int(row[group == i].min()))
    return {names[i]: (int(rejected[i]), int(total[i])) for i in selected}
