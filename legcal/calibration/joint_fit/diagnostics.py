"""Stated priors and fixed values against the measurements: refused or noted where they contradict.

A stated prior is tested with the information that measurements and other priors have of its
parameter; a fixed value by a wider fit in which it is free.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri, ndtr

from legcal.calibration.joint_fit.determinacy import (
    HeldDirections,
    held_at_nominal,
    open_directions,
)
from legcal.calibration.joint_fit.outline_errors import NoiseModel
from legcal.calibration.joint_fit.parameter_choices import Prior, board_scale
from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.rounds import Fit, first_minimum, fit_in_rounds
from legcal.calibration.joint_fit.variables import Start, State, intrinsic_of
from legcal.data.outlines import Outlines
from legcal.data.reasons import Reason
from legcal.errors import DidNotConverge, LegcalError, NotIdentifiable
from legcal.estimation.solver import NormalEquations, information, inverse_on_range
from legcal.estimation.uncertainty import marginal, named_information
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.directions import list_in_words
from legcal.machine.leg import Leg, radius_name
from legcal.machine.parameter_id import ParameterId
from legcal.machine.rods import actuators_of
from legcal.vision.board import LINKS, Link
from legcal.vision.camera import intrinsic_names, intrinsic_unit

_SIGNIFICANT = 5.0  # standard deviations between a prior and the measurements
_MIN_INFORMATION = 1e-9  # of a prior's information: what measurements must have for a test
_MIN_INFORMATION_WIDE = 1e-3  # the same of a wide prior in place of what was fixed
_MAX_SCALE_SIGMA = 0.05  # of the size of a board, for a test of the dataset's
_WIDE_SIGMA = 0.05  # of the mean leg length, angles at it: the prior of what was fixed
_WIDE_RADIUS = 0.2  # of the radius
_MAX_VARIANCE_SHARE = 0.5  # of the variance of that prior, after the measurements, for a test
_NOMINAL_SIGMA = 0.01  # of the mean leg length: how far a nominal model is off along what is held
_MIN_SHARE = 0.01  # of the variance that a camera file states, which measurements must remove
_MANY_REJECTED = 0.1  # of all outlines
_MOST_REJECTED = 0.5  # of those of a leg or a view
# Of an arm that is no cylinder: how far off its median outline is, over that of rods (1.8 is the
# most of 204 arms that are cylinders in benchmarks/arm_misfits.py), and [px]
ARM_MISFIT, _ARM_MISFIT_PX = 2.0, 0.03
_MIN_COUNT = 3  # rejected outlines of a leg or a view, at least, before it is noted
RADIUS_SIGMAS = 3.0  # between radii and the model's, of whose prior nobody said a word
_MAX_NAMES = 4  # names, before they are only counted


def refuse_contradicted_priors(problem: FitProblem, state: State, normal: NormalEquations) -> None:
    """Refuse stated priors that contradict the measurements.

    *normal* is the information at *state*, a minimum.

    Raises
    ------
    DidNotConverge
        With one sentence for each prior.
    """
    if not problem.settings.judges_stated_values:
        return
    priors, problems = problem.priors, []
    for i, mean, sigma in zip(
        priors.unknown.tolist(), priors.mean.tolist(), priors.sigma.tolist(), strict=True
    ):
        if problem.named[i] not in problem.choices.priors:
            continue
        found = estimate_without_prior(problem, state, normal, i, mean, sigma)
        if found is not None and found.apart > _SIGNIFICANT:
            unit = problem.units[i]
            problems.append(
                f"The prior of {problem.named[i]} contradicts the measurements: it says {mean:.6g} "
                f"+- {sigma:.2g} {unit}, they say about {found.value:.4g} {unit}, "
                f"{found.apart:.0f} standard deviations apart; at most {_SIGNIFICANT:g} are "
                "accepted; correct the prior or leave it out."
            )
    if problems:
        raise DidNotConverge(problems)


def refuse_other_board(problem: FitProblem, state: State, normal: NormalEquations) -> None:
    """Refuse a calibration board of other dimensions than the dataset says, without a stated prior.

    Encoders and radii carry the scale too; a board that was taken for larger than it is puts
    cameras further away. *normal* is the information at *state*, a first minimum.
    """
    for link in LINKS:
        name = board_scale(link)
        if name in problem.named and name not in problem.choices.priors:
            _refuse_other_size(problem, state, normal, link)


def _refuse_other_size(
    problem: FitProblem,
    state: State,
    normal: NormalEquations,
    link: Link,
) -> None:
    """Refuse the calibration board on a link if it has other dimensions than the dataset says."""
    name = board_scale(link)
    place, priors = problem.named.index(name), problem.priors
    for i in np.flatnonzero(priors.unknown == place).tolist():
        mean, sigma = float(priors.mean[i]), float(priors.sigma[i])
        found = estimate_without_prior(problem, state, normal, place, mean, sigma)
        if found is None or found.sigma > _MAX_SCALE_SIGMA or found.apart <= _SIGNIFICANT:
            continue
        choices = replace(problem.choices, free=problem.choices.free | {name})
        try:
            free = first_minimum(problem.with_choices(choices), state)
            size = f"{free.state.board_scale[LINKS.index(link)]:.4g} times as large as"
        except (DidNotConverge, NotIdentifiable):
            size = "of another size than"
        which = "" if link == "base" else f" on the {link}"
        raise DidNotConverge(
            f"The calibration board{which} does not fit the readings and the legs: found that it "
            f"is {size} the dataset says ({found.apart:.0f} standard deviations away), needed its "
            f"dimensions to {1e2 * sigma:.2g} %; measure the board and correct its dimensions in "
            f"dataset.yaml, or let the fit find them (--set {name}=free)."
        )


@dataclass(frozen=True)
class EstimateWithoutPrior:
    """A parameter by everything but its prior."""

    value: float
    sigma: float
    apart: float  # standard deviations from the prior


def estimate_without_prior(
    problem: FitProblem, state: State, normal: NormalEquations, i: int, mean: float, sigma: float
) -> EstimateWithoutPrior | None:
    """Return a named unknown by the measurements alone; None if they say nothing of it.

    With the information I that they have of it, an estimate that its own prior leaves at a distance
    d from the mean would be d (1 + 1 / (I sigma^2)) away without it, with the variance sigma^2 +
    1 / I of prior and measurements together.
    """
    all_of_it = named_information(problem, state, normal)
    known = float(marginal(all_of_it, np.array([i]))[0, 0]) - 1.0 / sigma**2
    if known < _MIN_INFORMATION / sigma**2:
        return None
    away = (float(problem.coordinates(state)[i]) - mean) * (1.0 + 1.0 / (known * sigma**2))
    variance = 1.0 / known
    apart = abs(away) / float(np.sqrt(sigma**2 + variance))
    return EstimateWithoutPrior(mean + away, float(np.sqrt(variance)), apart)


@dataclass(frozen=True)
class _Comparison:
    """A stated value beside that of the measurements."""

    name: str
    unit: str
    mean: float
    sigma: float  # zero where it is fixed
    found: float
    together: float  # standard deviations apart if all stated values are tested at once
    alone: float  # if the other stated values are right

    def __str__(self) -> str:
        apart = self.together if self.together > _SIGNIFICANT else self.alone
        stated = f"{self.mean:.6g} {self.unit}"
        if self.sigma:
            stated = f"{self.mean:.6g} +- {self.sigma:.2g} {self.unit}"
        return (
            f"The {'prior' if self.sigma else 'fixed value'} of {self.name} contradicts the "
            f"measurements: it is {stated}, they say about {self.found:.4g} {self.unit}, "
            f"{apart:.0f} standard deviations apart; at most {_SIGNIFICANT:g} are accepted; "
            f"correct it, {'' if self.sigma else 'give it a prior, '}or let it free."
        )


def refuse_contradicted_values(
    problem: FitProblem,
    start: Start,
    state: State,
    *,
    with_priors: bool = False,
) -> None:
    """Refuse fixed values that contradict the measurements.

    The errors of outlines are those that the wider fit estimates, so that claimed covariances
    that are too small do not refuse a right value. It begins at the start, as if nothing
    had been stated, and where that fails at the state; where both fail nothing is refused.

    Parameters
    ----------
    problem : FitProblem
        Without anything held, and without edge biases.
    start, state
        Where the fit began, and a minimum with the values fixed or where it is looked for.
    with_priors : bool
        Whether stated priors are tested as well.

    Raises
    ------
    DidNotConverge
        With one sentence for each value.
    """
    if not problem.settings.judges_stated_values:
        return
    choices, now = problem.choices, _values(problem, state)
    stated = {name: (now[name], 0.0) for name in _fixed_by_choice(problem)}
    if with_priors:
        stated |= {name: (p.mean, p.sigma) for name, p in choices.priors.items() if name in now}
    if not stated:
        return
    wide = {
        name: _wide_prior(problem, state, name, now[name], sigma)
        for name, (_, sigma) in stated.items()
    }
    wider_choices = replace(
        choices, fixed=choices.fixed - wide.keys(), priors={**choices.priors, **wide}
    )
    wider = problem.with_choices(wider_choices)
    # What ties hold wholly stays fixed: nothing measured says anything of it.
    stated = {name: known for name, known in stated.items() if name in wider.named}
    if not stated:
        return
    comparisons: list[_Comparison] = []
    for begin in (wider.begin(start), state):
        try:
            fit, held = _fitted(wider, begin)
        except (DidNotConverge, NotIdentifiable):
            continue
        comparisons = _compared(fit, held, stated, wide)
        break
    found = [comparison for comparison in comparisons if comparison.together > _SIGNIFICANT]
    found = found or [comparison for comparison in comparisons if comparison.alone > _SIGNIFICANT]
    if found:
        raise DidNotConverge([str(comparison) for comparison in found])


def _fixed_by_choice(problem: FitProblem) -> tuple[str, ...]:
    """Return what is fixed by choice: kinematic parameters, radii, intrinsics at values."""
    legs, choices = problem.legs, problem.choices
    radii = (radius_name(legs.names[leg], part) for leg, part in problem.outlines.parts)
    own = {*legs.parametrization.names, *radii, *choices.values}
    return tuple(sorted(choices.fixed & own))


def _values(problem: FitProblem, state: State) -> dict[str, float]:
    """Return the values of all that may be stated."""
    legs = problem.legs
    values = dict(zip(legs.parametrization.names, legs.vector(state.legs).tolist(), strict=True))
    for (leg, part), radius in zip(problem.outlines.parts, state.radii.tolist(), strict=True):
        values[radius_name(legs.names[leg], part)] = radius
    for view, camera in zip(problem.outlines.views, state.cameras, strict=True):
        for key in intrinsic_names(camera):
            values[f"{view}.{key}"] = intrinsic_of(camera, key)
    return values


def _wide_prior(problem: FitProblem, state: State, name: str, value: float, sigma: float) -> Prior:
    """Return a prior around a value that holds hardly any information."""
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


def _fitted(problem: FitProblem, state: State) -> tuple[Fit, HeldDirections]:
    """Fit again with the fixed parameters free; return the fit and the directions it holds."""
    first = first_minimum(problem, state)
    normal = information(problem, first.state, first.linear, problem.loss)
    held = open_directions(problem, first.state, normal)
    if len(held.basis):
        problem, state = held_at_nominal(problem, first.state, held)
        there = first_minimum(problem, state)
        first = replace(there, iterations=first.iterations + there.iterations)
    return fit_in_rounds(problem, first), held


def _compared(
    fit: Fit,
    held: HeldDirections,
    stated: Mapping[str, tuple[float, float]],
    wide: Mapping[str, Prior],
) -> list[_Comparison]:
    """Return every stated value beside that of the measurements, where these have any.

    With M the information of these parameters, their wide priors P around w in it, and f where the
    fit puts them, the measurements alone have the information K = M - P, and the slope
    M f - P w - K m at what was stated, m.
    """
    problem, state = fit.problem, fit.state
    normal = information(problem, state, fit.minimum.linear, problem.loss)
    of_all = named_information(problem, state, normal) + _held_information(
        problem, held, state.mean_length
    )
    where = np.array([problem.named.index(name) for name in stated], dtype=np.intp)
    found = problem.coordinates(state)[where]
    M, P = marginal(of_all, where), np.array([wide[name].sigma ** -2 for name in stated])
    mean, sigma = np.array(list(stated.values())).T
    around = np.array([wide[name].mean for name in stated])
    covariance = inverse_on_range(M)
    slope = M @ (found - mean) - P * (around - mean)
    comparisons = []
    for i, name in enumerate(stated):
        alone = M[i, i] - P[i]
        if alone < _MIN_INFORMATION_WIDE * P[i]:
            continue
        together = abs(found[i] - mean[i]) / np.sqrt(covariance[i, i] + sigma[i] ** 2)
        comparisons.append(
            _Comparison(
                name,
                problem.units[where[i]],
                float(mean[i]),
                float(sigma[i]),
                float(found[i]),
                float(together) if covariance[i, i] * P[i] < _MAX_VARIANCE_SHARE else 0.0,
                float(abs(slope[i] / alone) / np.sqrt(1.0 / alone + sigma[i] ** 2)),
            )
        )
    return comparisons


def _held_information(problem: FitProblem, held: HeldDirections, length: float) -> Array:
    """Return the normal matrix (n_named, n_named) of a nominal model along what is held.

    Where the fit holds a direction at nominal that stated values would determine, as radii do the
    size of a 3-UPU that only translates, the measurements do not contradict them.
    """
    n = problem.n_named
    rows, known = np.zeros((len(held.basis), n)), _NOMINAL_SIGMA * length * held.unit
    rows[:, np.setdiff1d(np.arange(n), problem.where("biases"))] = held.basis / known
    return rows.T @ rows


@dataclass(frozen=True)
class DoubtedCamera:
    """A camera whose intrinsics the measurements move too far for what its file states."""

    view: str  # the first one by name if several have the camera
    key: str  # of the intrinsic that moves farthest for what is known of it
    given: float  # in the camera file
    sigma: float  # by the covariance of the file
    found: float  # by the fit
    apart: float  # standard deviations of that change

    def __str__(self) -> str:
        unit = f" {intrinsic_unit(self.key)}".rstrip()
        return (
            f"The camera of {self.view} does not agree with its covariance: the measurements move "
            f"{self.key} from {self.given:.6g} +- {self.sigma:.2g}{unit} to {self.found:.6g}{unit},"
            f" {self.apart:.0f} standard deviations of such a change; the stated uncertainty knows "
            "nothing of it; calibrate the camera again at the same focus and zoom."
        )


def doubted_cameras(
    problem: FitProblem, state: State, covariance: Array
) -> tuple[DoubtedCamera, ...]:
    """Return the cameras whose intrinsics the measurements move too far for their covariances.

    In units in which what a file states has unit covariance, a fit that leaves the covariance P of
    these moves them by a vector of covariance 1 - P. *covariance* is that of the kept unknowns.
    """
    block, values = problem.block("cameras"), problem.coordinates(state)
    prior, first = block.prior, int(problem.where("cameras")[0]) if block.n_unknowns else 0
    of_file = np.isin(first + prior.unknown, problem.calibrated)
    views = np.array([ParameterId.parse(block.labels[i]).owner for i in prior.unknown.tolist()])
    found = []
    for view in dict.fromkeys(views[of_file].tolist()):
        rows = np.flatnonzero(of_file & (views == view))
        own, sigma = first + prior.unknown[rows], prior.sigma[rows]
        whitening = np.eye(len(prior.mean)) if prior.whitening is None else prior.whitening
        T = whitening[np.ix_(rows, rows)] / sigma
        moved, left = values[own] - prior.mean[rows], covariance[np.ix_(own, own)]
        share, vector = np.linalg.eigh(np.eye(len(rows)) - T @ left @ T.T)
        tested = share > _MIN_SHARE
        squared = float(np.sum((vector[:, tested].T @ T @ moved) ** 2 / share[tested]))
        if squared <= chdtri(max(int(tested.sum()), 1), 2.0 * ndtr(-_SIGNIFICANT)):
            continue
        spread = np.sqrt(np.maximum(sigma**2 - np.diagonal(left), _MIN_SHARE * sigma**2))
        k = int(np.argmax(np.abs(moved) / spread))
        key = ParameterId.parse(problem.named[own[k]]).kind
        numbers = prior.mean[rows[k]], sigma[k], values[own[k]], abs(moved[k]) / spread[k]
        found.append(DoubtedCamera(view, key, *map(float, numbers)))
    return tuple(found)


def rejected_notes(problem: FitProblem, accepted: BoolArray) -> tuple[str, ...]:
    """Return a note where many outlines, or most of a leg or of a view, disagree with the fit."""
    o = problem.outlines
    legs = _mostly_rejected(o.leg, problem.legs.names, o.index, accepted | o.on_arm)
    views = _mostly_rejected(o.view, o.views, o.index, accepted)
    n, n_rejected = len(accepted), int(np.sum(~accepted))
    of = [f"{rejected} of {total} of {name}" for name, (rejected, total) in (legs | views).items()]
    of = of or list(legs_left_out(problem, accepted))
    if not of and n_rejected <= _MANY_REJECTED * n:
        return ()
    words = (
        f"The fit left out {n_rejected} of {n} outlines that disagree with it"
        f"{', ' + ', '.join(of) if of else ''}; the stated uncertainty holds only if it is these "
        "that are wrong; look at them and their reasons in the table of observations"
    )
    stated = [
        name
        for name in stated_parameters(problem)
        if any(ParameterId.parse(end).owner in legs for end in name.split(":"))
    ]
    if stated:
        words += f", and at what was stated of {_listed(stated)}"
    return (f"{words}.",)


def legs_left_out(problem: FitProblem, accepted: BoolArray) -> tuple[str, ...]:
    """Return the legs of views most of whose outlines disagree with the fit, and how many do.

    They do so in several images of the view: what is wrong in one is a matter of chance.
    """
    o, names = problem.outlines, problem.legs.names
    accepted = accepted | o.on_arm  # an arm that is no cylinder says nothing of its rod
    together = o.leg * len(o.views) + o.view
    shown = [f"{leg} in view {view}" for leg in names for view in o.views]
    return tuple(
        f"{rejected} of {total} of {shown[k]}"
        for k in np.unique(together[~accepted]).tolist()
        if (rejected := int(np.sum(own := (together == k) & ~accepted)))
        > _MOST_REJECTED * (total := int(np.sum(together == k)))
        and len(np.unique(o.pose[own])) >= _MIN_COUNT
    )


def arms_of_other_widths(outlines: Outlines, is_arm: BoolArray) -> dict[int, str]:
    """Return the legs whose arms are seen with other widths than the model's, and how often.

    *is_arm* says which outlines of the table are of arms. Both edges of another shape, or of
    another radius, are found in most images, and those that are used pass by chance.
    """
    is_wide = outlines.rejected_for(Reason.WIDTH)
    found = dict[int, str]()
    for leg in np.unique(outlines.leg[is_arm & outlines.used]).tolist():
        own = is_arm & (outlines.leg == leg)
        n_wrong, total = int(is_wide[own].sum()), int((is_wide | outlines.used)[own].sum())
        if n_wrong >= _MIN_COUNT and n_wrong > _MOST_REJECTED * total:
            found[leg] = f"{n_wrong} of whose {total} outlines show another width than the model's"
    return found


def wrong_arms_in_words(wrong: Mapping[int, str], legs: Sequence[Leg]) -> str:
    """Return which arms are wrong and how, as :func:`wrong_arms` does, in words."""
    reasons: dict[str, list[str]] = {}
    for j, why in wrong.items():
        reasons.setdefault(why, []).append(str(legs[j].prismatic))
    said = "; ".join(f"{list_in_words(names)}, {why}" for why, names in reasons.items())
    return (
        f"found those of {said}, needed straight cylinders as the model draws them; correct their "
        "radii, or draw other shapes as boxes or meshes."
    )


def wrong_arms(
    problem: FitProblem, state: State, noise: NoiseModel, outlines: Outlines
) -> dict[int, str]:
    """Return the legs whose arms a fit contradicts, and how, after the name of the motor.

    Such an arm has most of its outlines rejected, or the median one lies much further off than that
    of the rods, in standard deviations of the noise that was found. *outlines* are those of the
    table, with the verdicts of the fit.
    """
    o = problem.outlines
    used, found = outlines.used[o.index], dict[int, str]()
    for leg, (times, away_px) in arm_misfits(problem, state, noise).items():
        own = o.on_arm & (o.leg == leg)
        total, rejected = int(own.sum()), int(np.sum(own & ~used))
        if rejected >= _MIN_COUNT and rejected > _MOST_REJECTED * total:
            found[leg] = f"{rejected} of whose {total} outlines disagree with the fit"
        elif times > ARM_MISFIT and away_px > _ARM_MISFIT_PX:
            found[leg] = f"whose outlines lie {times:.1f} times as far off as those of rods"
    return found


def arm_misfits(
    problem: FitProblem, state: State, noise: NoiseModel
) -> dict[int, tuple[float, float]]:
    """Return how far off the median outline of arms is, by their legs: over that of rods, and [px].

    The former counts in standard deviations of the noise that was found. Without rods there is
    nothing to compare with.
    """
    o = problem.outlines
    if not o.on_arm.any() or o.on_arm.all():
        return {}
    offsets, found = problem.offsets(state), dict[int, tuple[float, float]]()
    whitened = np.linalg.solve(noise.covariance(o.covariance), offsets[..., None])[..., 0]
    squares, away = np.sum(offsets * whitened, axis=1), np.abs(offsets).max(axis=1)
    usual = float(np.median(squares[~o.on_arm]))
    for leg in np.unique(o.leg[o.on_arm]).tolist():
        own = o.on_arm & (o.leg == leg)
        times = float(np.sqrt(np.median(squares[own]) / usual)) if usual > 0.0 else 0.0
        found[leg] = times, float(np.median(away[own]))
    return found


def reversed_motors(problem: FitProblem, state: State) -> tuple[str, ...]:
    """Return a note on motors whose axes or directions come out opposite to the model's."""
    pairs = zip(actuators_of(state.legs), actuators_of(problem.legs.nominal), strict=True)
    names = [found.joint for found, nominal in pairs if found.axis @ nominal.axis < 0.0]
    if not names:
        return ()
    return (
        f"The readings of {list_in_words(names)} count the other way than the model says: "
        "found axes or directions that came out reversed; correct them in the model, or reverse "
        "the readings (of a servo give us_per_deg the other sign).",
    )


def contradicted_radii(problem: FitProblem, state: State, normal: NormalEquations) -> list[str]:
    """Return a note on the radii of the model that the measurements contradict.

    *normal* is the information at *state*. They have a prior of their own, which nobody stated.
    """
    radii = {radius_name(problem.legs.names[leg], part) for leg, part in problem.outlines.parts}
    priors, said = problem.priors, []
    for i, mean, sigma in zip(
        priors.unknown.tolist(), priors.mean.tolist(), priors.sigma.tolist(), strict=True
    ):
        name = problem.named[i]
        if name not in radii or name in problem.choices.priors:
            continue
        found = estimate_without_prior(problem, state, normal, i, mean, sigma)
        if found is not None and found.apart > RADIUS_SIGMAS:
            said.append(
                f"{name} {1e3 * found.value:.2f} mm against {1e3 * mean:.2f} +- {1e3 * sigma:.2f} "
                f"mm ({found.apart:.0f} standard deviations)"
            )
    if not said:
        return []
    return [
        f"The measurements contradict radii of the model: found {'; '.join(said)}, needed at most "
        f"{RADIUS_SIGMAS:g} standard deviations; measure these parts and correct the model."
    ]


def naming_stated_values(problem: FitProblem, failure: LegcalError) -> LegcalError:
    """Return a failure that names first the stated values, if there are any."""
    stated = stated_parameters(problem)
    if not stated:
        return failure
    return DidNotConverge(
        [
            "The joint fit failed with what was stated beforehand of "
            f"{_listed(stated)}, which is the likely cause if it works without; correct these "
            "values first, or leave them out.",
            *failure.problems,
        ]
    )


def stated_parameters(problem: FitProblem) -> list[str]:
    """Return the parameters with a stated prior or value; not twists about nominal ones."""
    legs = problem.legs
    nominal = zip(legs.parametrization.names, legs.vector(legs.nominal).tolist(), strict=True)
    usual = {name: value for name, value in nominal if ParameterId.parse(name).kind == "twist"}
    priors = sorted(problem.choices.priors.items())
    return [
        *(name for name, prior in priors if usual.get(name) != prior.mean),
        *_fixed_by_choice(problem),
    ]


def _listed(names: list[str]) -> str:
    """Return names in words, the first ones if they are many."""
    more = len(names) - _MAX_NAMES
    return ", ".join(names[:_MAX_NAMES]) + (f" and {more} more" if more > 0 else "")


def _mostly_rejected(
    which: IntArray, names: Sequence[str], row: IntArray, accepted: BoolArray
) -> dict[str, tuple[int, int]]:
    """Return names most of whose outlines were rejected, in the order of the table: how many."""
    total = np.bincount(which, minlength=len(names))
    rejected = np.bincount(which[~accepted], minlength=len(names))
    most = np.flatnonzero((rejected >= _MIN_COUNT) & (rejected > _MOST_REJECTED * total)).tolist()
    most.sort(key=lambda i: int(row[which == i].min()))
    return {names[i]: (int(rejected[i]), int(total[i])) for i in most}
