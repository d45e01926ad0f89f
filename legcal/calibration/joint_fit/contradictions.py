"""Whether the measurements agree with the focal lengths that cameras were given.

Encoders carry the absolute scale, and a focal length that is wrong makes perspective wrong in a way
that nothing else in the fit can imitate altogether. What is left in the residuals then has a slope
by the focal length: Rao's score test, which needs no further fit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from legcal.calibration.joint_fit.build import with_choices
from legcal.calibration.joint_fit.choices import Prior
from legcal.calibration.joint_fit.constraints import Start, following
from legcal.calibration.joint_fit.determinacy import (
    Held,
    held_at_nominal,
    mean_length,
    of_values,
    open_directions,
)
from legcal.calibration.joint_fit.influence import reduced_jacobian, response
from legcal.calibration.joint_fit.normal import (
    NormalEquations,
    information,
    inverse_on_range,
    normal_equations,
)
from legcal.calibration.joint_fit.parameters import BOARD_SCALE
from legcal.calibration.joint_fit.problem import FitProblem, Linearization, named_values, offsets_of
from legcal.calibration.joint_fit.rounds import Fit, first_minimum, fit_in_rounds
from legcal.calibration.joint_fit.solution import Sensitivity
from legcal.calibration.joint_fit.state import RefinementSettings, State, intrinsic_of
from legcal.errors import DidNotConverge, LegcalError, NotIdentifiable
from legcal.estimation import efficiency, width_to_k
from legcal.geometry import Array, BoolArray, IntArray
from legcal.machine import radius_name
from legcal.vision import intrinsic_names, intrinsic_unit, shared_cameras, undistort_derivatives

_SIGNIFICANT = 5.0  # standard deviations between a prior and the measurements
_KNOWN = 1e-9  # of the information of a prior: what the measurements must have to be asked


def refuse_contradicted_priors(problem: FitProblem, state: State, normal: NormalEquations) -> None:
    """Refuse what somebody stated and what cannot be true beside the measurements.

    With the information I that measurements and other priors have of a parameter, an estimate
    that its own prior leaves at a distance d from the mean would be d (1 + 1 / (I sigma^2)) away
    without it, with the variance sigma^2 + 1 / I of prior and measurements together.

    Parameters
    ----------
    problem : FitProblem
    state : State
        A minimum.
    normal : NormalEquations
        From :func:`legcal.calibration.joint_fit.normal.information` there.

    Raises
    ------
    DidNotConverge
        With one sentence for each prior.
    """
    stated = [
        (i, mean, sigma)
        for i, mean, sigma in zip(
            problem.priors.position.tolist(),
            problem.priors.mean.tolist(),
            problem.priors.sigma.tolist(),
            strict=True,
        )
        if problem.named[i] in problem.choices.priors
    ]
    if not stated:
        return
    problems = []
    for i, mean, sigma in stated:
        found = without_prior(problem, state, normal, i, mean, sigma)
        if found is not None and found.apart > _SIGNIFICANT:
            unit = problem.named_units[i]
            problems.append(
                f"The prior of {problem.named[i]} contradicts the measurements: it says {mean:.6g} "
                f"+- {sigma:.2g} {unit}, they say about {found.value:.4g} {unit}, "
                f"{found.apart:.0f} standard deviations apart; at most {_SIGNIFICANT:g} are "
                "believed; correct the prior or leave it out."
            )
    if problems:
        raise DidNotConverge(problems)


@dataclass(frozen=True)
class Opinion:
    """What everything but its own prior says of a parameter, and how far it is from the prior."""

    value: float
    sigma: float
    apart: float  # standard deviations


def without_prior(
    problem: FitProblem, state: State, normal: NormalEquations, i: int, mean: float, sigma: float
) -> Opinion | None:
    """Return what measurements say of a named unknown by themselves; None if nothing."""
    S = of_values(problem, state, normal)
    others = np.delete(np.arange(len(S)), i)
    explained = S[i, others] @ inverse_on_range(S[np.ix_(others, others)]) @ S[others, i]
    known = S[i, i] - 1.0 / sigma**2 - explained
    if known < _KNOWN / sigma**2:
        return None
    value = float(named_values(state, problem.layout, problem.legs)[i])
    away = (value - mean) * (1.0 + 1.0 / (known * sigma**2))
    variance = 1.0 / known
    apart = abs(away) / float(np.sqrt(sigma**2 + variance))
    return Opinion(mean + away, float(np.sqrt(variance)), apart)


_WIDE = 0.05  # of the mean leg length, angles at it: the prior of what was fixed
_WIDE_RADIUS = 0.2  # of the radius
_KNOWN_fixed_values = (
    1e-3  # of the information of that prior: what the measurements must have to be asked
)
_TOLD = 0.5  # of the variance of that prior: what measurements leave where they tell the value
_HELD = 0.01  # of the mean leg length: how well a nominal model knows what is held


@dataclass(frozen=True)
class _Stated:
    """What somebody stated of a parameter, and the wide prior in place of it."""

    mean: float
    sigma: float  # zero where it is fixed
    wide: Prior


@dataclass(frozen=True)
class _Doubt:
    """A stated value beside what the measurements say."""

    name: str
    unit: str
    stated: _Stated
    found: float
    together: float  # standard deviations apart if all stated values are asked at once
    alone: float  # if the other stated values are right


def refuse_contradicted_values(
    problem: FitProblem,
    start: Start,
    state: State,
    settings: RefinementSettings,
    *,
    with_priors: bool = False,
) -> None:
    """Refuse values that somebody fixed and that cannot be true beside the measurements.

    The errors of outlines are those that the wider fit estimates, so that claimed covariances
    that are too small do not make a right value suspect. It begins at the start, as if nothing
    had been stated, and where that fails at the state; where both fail nothing is said.

    Parameters
    ----------
    problem : FitProblem
        Without anything held, and without shifts.
    start : Start
    state : State
        A minimum with the values fixed, or where it is looked for.
    settings : RefinementSettings
    with_priors : bool
        Whether stated priors are asked as well.

    Raises
    ------
    DidNotConverge
        With one sentence for each value.
    """
    choices, now = problem.choices, _values(problem, state)
    asked = {name: (now[name], 0.0) for name in fixed_by_choice(problem)}
    if with_priors:
        asked |= {name: (p.mean, p.sigma) for name, p in choices.priors.items() if name in now}
    if not asked:
        return
    stated = {
        name: _Stated(mean, sigma, _wide_prior(problem, state, name, now[name], sigma))
        for name, (mean, sigma) in asked.items()
    }
    wide = {name: one.wide for name, one in stated.items()}
    widened = replace(choices, fixed=choices.fixed - wide.keys(), priors={**choices.priors, **wide})
    wider = with_choices(problem, widened, settings)
    doubts: list[_Doubt] = []
    for begin in (wider.begin(start), state):
        try:
            fit, held = _fitted(wider, begin, settings)
        except (DidNotConverge, NotIdentifiable):
            continue
        doubts = _doubts(fit, held, stated, settings)
        break
    found = [doubt for doubt in doubts if doubt.together > _SIGNIFICANT]
    if not found:
        found = [doubt for doubt in doubts if doubt.alone > _SIGNIFICANT]
    if found:
        raise DidNotConverge([_in_words(doubt) for doubt in found])


def fixed_by_choice(problem: FitProblem) -> tuple[str, ...]:
    """Return what somebody fixed: kinematic parameters, radii, intrinsics that were given."""
    legs, choices = problem.legs, problem.choices
    radii = (radius_name(legs.names[leg], part) for leg, part in problem.layout.parts)
    own = {*legs.parametrization.names, *radii, *choices.values}
    return tuple(sorted(choices.fixed & own))


def _values(problem: FitProblem, state: State) -> dict[str, float]:
    """Return the values of all that somebody may state."""
    legs = problem.legs
    values = dict(zip(legs.parametrization.names, legs.vector(state.legs).tolist(), strict=True))
    for (leg, part), radius in zip(problem.layout.parts, state.radii.tolist(), strict=True):
        values[radius_name(legs.names[leg], part)] = radius
    for view, camera in zip(problem.outlines.views, state.cameras, strict=True):
        for key in intrinsic_names(camera):
            values[f"{view}.{key}"] = intrinsic_of(camera, key)
    return values


def _wide_prior(problem: FitProblem, state: State, name: str, value: float, sigma: float) -> Prior:
    """Return a prior around a value that hardly says anything."""
    names, units = problem.legs.parametrization.names, problem.legs.parametrization.units
    if name in names:
        wide = _WIDE * (mean_length(state) if units[names.index(name)] == "m" else 1.0)
    elif ".radius." in name:
        wide = _WIDE_RADIUS * value
    else:
        view, key = name.rsplit(".", 1)
        camera = state.cameras[problem.outlines.views.index(view)]
        wide = _WIDE * (camera.K[0, 0] if intrinsic_unit(key) == "px" else 1.0)
    return Prior(value, max(float(wide), sigma))


def _fitted(problem: FitProblem, state: State, settings: RefinementSettings) -> tuple[Fit, Held]:
    """Return the fit with what was fixed free, and what it holds."""
    k = width_to_k(settings.loss_width)
    first = first_minimum(problem, state, settings)
    held = open_directions(problem, first.state, information(problem, first.state, first.linear, k))
    state = first.state
    if len(held.basis):
        problem, state = held_at_nominal(problem, state, held)
        state = first_minimum(problem, state, settings).state
    return fit_in_rounds(problem, state, first.iterations, settings), held


def _doubts(
    fit: Fit, held: Held, stated: dict[str, _Stated], settings: RefinementSettings
) -> list[_Doubt]:
    """Return what the measurements say of every stated value that they say anything of.

    With M the information of these parameters, their wide priors P around w in it, and f where the
    fit puts them, the measurements alone have the information K = M - P, and the slope
    M f - P w - K m at what was stated, m.
    """
    problem, state = fit.problem, fit.state
    normal = information(problem, state, fit.minimum.linear, width_to_k(settings.loss_width))
    S = of_values(problem, state, normal) + _held_information(problem, held, mean_length(state))
    where = np.array([problem.named.index(name) for name in stated], dtype=np.intp)
    found = named_values(state, problem.layout, problem.legs)[where]
    M, P = _without_others(S, where), np.array([1.0 / one.wide.sigma**2 for one in stated.values()])
    mean = np.array([one.mean for one in stated.values()])
    around = np.array([one.wide.mean for one in stated.values()])
    covariance = inverse_on_range(M)
    slope = M @ (found - mean) - P * (around - mean)
    doubts = []
    for i, (name, one) in enumerate(stated.items()):
        alone = M[i, i] - P[i]
        if alone < _KNOWN_fixed_values * P[i]:
            continue
        together = abs(found[i] - mean[i]) / np.sqrt(covariance[i, i] + one.sigma**2)
        doubts.append(
            _Doubt(
                name,
                problem.named_units[where[i]],
                one,
                float(found[i]),
                float(together) if covariance[i, i] * P[i] < _TOLD else 0.0,
                float(abs(slope[i] / alone) / np.sqrt(1.0 / alone + one.sigma**2)),
            )
        )
    return doubts


def _held_information(problem: FitProblem, held: Held, length: float) -> Array:
    """Return the normal matrix of named unknowns that knows what is held as nominal models do.

    Where the fit holds a direction at nominal that what was stated would tell, as the size of a
    3-UPU that only translates is told by its radii, the measurements do not speak against it.
    """
    n = len(problem.named)
    rows, known = np.zeros((len(held.basis), n)), _HELD * length * held.unit
    rows[:, np.setdiff1d(np.arange(n), problem.layout.bias)] = held.basis / known
    return rows.T @ rows


def _without_others(S: Array, f: IntArray) -> Array:
    """Return the normal matrix of some unknowns with all others unknown."""
    others = np.setdiff1d(np.arange(len(S)), f)
    mixed = S[np.ix_(others, f)]
    return np.asarray(
        S[np.ix_(f, f)] - mixed.T @ inverse_on_range(S[np.ix_(others, others)]) @ mixed
    )


def _in_words(doubt: _Doubt) -> str:
    one, unit = doubt.stated, doubt.unit
    apart = doubt.together if doubt.together > _SIGNIFICANT else doubt.alone
    stated = f"{one.mean:.6g} {unit}"
    if one.sigma:
        stated = f"{one.mean:.6g} +- {one.sigma:.2g} {unit}"
    return (
        f"The {'prior' if one.sigma else 'fixed value'} of {doubt.name} contradicts the "
        f"measurements: it is {stated}, they say about {doubt.found:.4g} {unit}, {apart:.0f} "
        f"standard deviations apart; at most {_SIGNIFICANT:g} are believed; correct it, "
        f"{'' if one.sigma else 'give it a prior, '}or let it free."
    )


_MANY = 0.1  # of all outlines
_MOST = 0.5  # of those of a leg or a view
_SOME = 3  # rejected outlines of a leg or a view, at least, before it is spoken of
_SIGMAS = 3.0  # of the prior of a radius, between all radii and the model's
_ALIKE = 0.25  # of their common difference
_SHOWN = 4  # names, before they are only counted


def rejected_notes(problem: FitProblem, accepted: BoolArray) -> tuple[str, ...]:
    """Return a note where many outlines, or most of a leg or a view, disagree with the fit.

    Parameters
    ----------
    problem : FitProblem
    accepted : (n_outlines,) array of bool
    """
    o = problem.outlines
    legs = _mostly_rejected([problem.legs.names[j] for j in o.leg.tolist()], accepted)
    views = _mostly_rejected([o.views[v] for v in o.view.tolist()], accepted)
    n, n_rejected = len(accepted), int(np.sum(~accepted))
    if not legs and not views and n_rejected <= _MANY * n:
        return ()
    of = [f"{rejected} of {total} of {name}" for name, (rejected, total) in (legs | views).items()]
    words = (
        f"The fit left out {n_rejected} of {n} outlines that disagree with it"
        f"{', ' + ', '.join(of) if of else ''}; the stated uncertainty holds only if it is these "
        "that are wrong; look at them and their reasons in the table of observations"
    )
    stated = [name for name in _stated(problem) if name.split(".")[0] in legs]
    if stated:
        words += f", and at what was stated of {_listed(stated)}"
    return (f"{words}.",)


def scale_notes(problem: FitProblem, state: State, settings: RefinementSettings) -> tuple[str, ...]:
    """Return a note where all radii come out larger or smaller than the model's by one factor."""
    layout, legs = problem.layout, problem.legs
    free = layout.radius < layout.size
    nominal = np.array([legs.radii[part] for part in layout.parts])
    change = (state.radii / nominal - 1.0)[free]
    if len(change) < _SOME:
        return ()
    common = float(np.median(change))
    alike = bool(np.all(np.abs(change - common) < _ALIKE * abs(common)))
    if not alike or abs(common) < _SIGMAS * settings.radius_sigma:
        return ()
    way = "smaller" if common < 0.0 else "larger"
    return (
        f"All radii come out {1e2 * abs(common):.0f} % {way} than the model's, so that everything "
        f"may be that much {way} than it is; check the unit and the scale of the encoders, or the "
        "radii of the model.",
    )


def blaming_what_was_stated(problem: FitProblem, failure: LegcalError) -> LegcalError:
    """Return a failure that names first what was stated beforehand, if anything was."""
    stated = _stated(problem)
    if not stated:
        return failure
    return DidNotConverge(
        [
            "The fit of everything failed with what was stated beforehand of "
            f"{_listed(stated)}, which is the likely cause if it works without; correct these "
            "values first, or leave them out.",
            *failure.problems,
        ]
    )


def _stated(problem: FitProblem) -> list[str]:
    """Return of what somebody stated a prior or a fixed value; not twists about nominal ones."""
    legs = problem.legs
    nominal = zip(legs.parametrization.names, legs.vector(legs.nominal).tolist(), strict=True)
    usual = {name: value for name, value in nominal if name.endswith(".twist")}
    priors = sorted(problem.choices.priors.items())
    return [
        *(name for name, prior in priors if usual.get(name) != prior.mean),
        *fixed_by_choice(problem),
    ]


def _listed(names: list[str]) -> str:
    """Return names in words, the first ones if they are many."""
    more = len(names) - _SHOWN
    return ", ".join(names[:_SHOWN]) + (f" and {more} more" if more > 0 else "")


def _mostly_rejected(names: list[str], accepted: BoolArray) -> dict[str, tuple[int, int]]:
    """Return how many outlines were rejected of whose most were, and of how many."""
    found = {}
    for name in dict.fromkeys(names):
        own = accepted[[other == name for other in names]]
        rejected = int(np.sum(~own))
        if rejected >= _SOME and rejected > _MOST * len(own):
            found[name] = (rejected, len(own))
    return found


_KNOWN_other_board = (
    0.05  # of the size: what measurements must tell to be believed against the file
)


def refuse_other_board(
    problem: FitProblem, state: State, normal: NormalEquations, settings: RefinementSettings
) -> None:
    """Refuse a calibration board of other dimensions than the dataset says.

    Encoders and radii carry the scale too; a board that was taken for larger than it is puts
    cameras further away.

    Parameters
    ----------
    problem : FitProblem
    state : State
        A first minimum.
    normal : NormalEquations
        There: :func:`legcal.calibration.joint_fit.normal.information`.
    settings : RefinementSettings

    Raises
    ------
    DidNotConverge
        If its size contradicts what else was measured, and nobody stated a prior of it.
    """
    if BOARD_SCALE not in problem.named or BOARD_SCALE in problem.choices.priors:
        return
    place = problem.named.index(BOARD_SCALE)
    for i in np.flatnonzero(problem.priors.position == place).tolist():
        mean, sigma = float(problem.priors.mean[i]), float(problem.priors.sigma[i])
        found = without_prior(problem, state, normal, place, mean, sigma)
        if found is None or found.sigma > _KNOWN_other_board or found.apart <= _SIGNIFICANT:
            continue
        size = _size(problem, state, settings)
        told = "of another size than" if size is None else f"{size:.4g} times as large as"
        raise DidNotConverge(
            "The calibration board does not fit the readings and the legs: found that it is "
            f"{told} the dataset says ({found.apart:.0f} standard deviations away), needed its "
            f"dimensions to {1e2 * sigma:.2g} %; measure the board and correct its dimensions in "
            f"dataset.yaml, or let the fit find them (--free {BOARD_SCALE})."
        )


def _size(problem: FitProblem, state: State, settings: RefinementSettings) -> float | None:
    """Return the size that a fit finds which is free to, over the given one; None if it fails."""
    choices = replace(problem.choices, free=problem.choices.free | {BOARD_SCALE})
    try:
        found = first_minimum(with_choices(problem, choices, settings), state, settings)
    except (DidNotConverge, NotIdentifiable):
        return None
    return float(found.state.board_scale[0])


_PART = 1e-3  # of a mistake that is tried: its effect is told to first order
_OF_RADII = 0.01
FOCAL_PART = 0.01  # of the focal length, in the mistake that is told
_OF_TWISTS = np.radians(0.1)
_TWISTED = "twists that are fixed, each 0.1 deg off,"
_TWIST = 11  # among the numbers of a leg


@dataclass(frozen=True)
class _Mistake:
    """A mistake in cameras: a part of some of their numbers, and pixels in others."""

    what: str
    relative: Mapping[str, float]
    added: Mapping[str, float]


_OF_CAMERAS = (
    _Mistake("a focal length 1 % longer", {"fx": FOCAL_PART, "fy": FOCAL_PART}, {}),
    _Mistake("a principal point 0.1 px further right", {}, {"cx": 0.1}),
    _Mistake("a principal point 0.1 px further down", {}, {"cy": 0.1}),
)


@dataclass(frozen=True, eq=False)
class _Change:
    """How residuals change with a mistake.

    Attributes
    ----------
    what : str
        The mistake.
    offsets : (n, 2) array
        Change of the offsets of outlines [px].
    corners : (m, 2) array
        Change of the whitened residuals of corners of the calibration board.
    priors : (n_priors,) array
        Change of the means of priors [m, rad, px].
    """

    what: str
    offsets: Array
    corners: Array
    priors: Array


def sensitivities(
    problem: FitProblem,
    state: State,
    linear: Linearization,
    normal: NormalEquations,
    whitening: Array,
    k: float,
) -> tuple[Sensitivity, ...]:
    """Return what mistakes in cameras, radii and fixed twists would do to the parameters.

    What the fit looked for without a prior is not taken as known; a mistake in nothing else is
    left out. So are those in cameras and radii where axes were measured in place of outlines.

    Parameters
    ----------
    problem : FitProblem
    state : State
        Where the fit ended.
    linear : Linearization
        There.
    normal : NormalEquations
        There: :func:`legcal.calibration.joint_fit.normal.information`.
    whitening : (n_outlines, 2, 2) array
        What *linear* was taken with.
    k : float
        What *normal* was taken with.
    """
    twisted = _of_twists(problem, state, linear, normal, k)
    changes = [*(_in_cameras(problem, state, m) for m in _OF_CAMERAS), _in_radii(problem, state)]
    changes = [c for c in changes if c.offsets.any() or c.priors.any()]
    if not changes:
        return twisted
    offsets = efficiency(k, 2) * whitening @ np.stack([c.offsets for c in changes], axis=-1)
    pulls = np.column_stack([c.priors for c in changes]) / problem.priors.sigma[:, None]
    steps = response(problem.couplings.outlines, linear.outlines, normal, offsets)
    corners = efficiency(k, 2) * np.stack([c.corners for c in changes], axis=-1)
    steps += response(problem.couplings.corners, linear.corners, normal, corners)
    steps += normal.kept_covariance() @ linear.prior_J.T @ pulls
    padded = np.vstack([steps, np.zeros(len(changes))])
    kinematic = padded[np.minimum(problem.layout.kinematic, problem.layout.n_kept)]
    others = (Sensitivity(c.what, kinematic[:, i : i + 1]) for i, c in enumerate(changes))
    return (*others, *twisted)


def _of_twists(
    problem: FitProblem, state: State, linear: Linearization, normal: NormalEquations, k: float
) -> tuple[Sensitivity, ...]:
    """Return what fixed twists would do, each of them by itself, or nothing."""
    layout = problem.layout
    names = problem.legs.parametrization.names
    place = problem.legs.parametrization.place[:, _TWIST]
    fixed = [j for j, x in enumerate(place) if x >= 0 and layout.kinematic[x] >= layout.size]
    if not fixed:
        return ()
    steps = np.zeros((len(names), len(fixed)))
    for i, leg in enumerate(fixed):
        motion = _OF_TWISTS * following(state, problem.legs.frame_legs, leg, _TWIST)
        moved = np.zeros((layout.n_kept + 1, 1))
        for where, rows, kept in (  # corners do not know of poses
            (problem.couplings.outlines, linear.outlines, efficiency(k, 2)),
            (problem.couplings.readings, linear.readings, 1.0),
            (problem.couplings.axes, linear.axes, efficiency(k, 4)),
        ):
            change = kept * rows.J_pose @ motion[where.pose][..., None]
            moved[:-1] += response(where, rows, normal, change)
        steps[:, i] = moved[np.minimum(layout.kinematic, layout.n_kept), 0]
        steps[place[leg], i] = _OF_TWISTS
    return (Sensitivity(_TWISTED, steps),)


def _in_cameras(problem: FitProblem, state: State, mistake: _Mistake) -> _Change:
    """Return what a mistake in all cameras changes."""
    layout, o, c = problem.layout, problem.outlines, problem.board
    moved, corners = np.zeros(o.feet.shape), np.zeros(c.feet.shape)
    priors = np.zeros(len(problem.priors))
    for v in np.unique(np.append(o.view, c.view)).tolist():
        camera, of_view, shown = state.cameras[v], o.view == v, c.view == v
        steps = {k: part * intrinsic_of(camera, k) for k, part in mistake.relative.items()}
        steps |= mistake.added
        places = dict(zip(layout.intrinsic_keys, layout.intrinsic[v].tolist(), strict=True))
        for name, step in steps.items():
            priors[problem.priors.position == places.get(name, -1)] = step
        fixed = [name for name in steps if places.get(name, layout.size) >= layout.size]
        by = np.array([steps[name] for name in fixed])
        moved[of_view] = undistort_derivatives(camera, o.pixels[of_view], fixed) @ by
        corners[shown] = undistort_derivatives(camera, c.pixels[shown], fixed) @ by
    offsets = offsets_change(problem, state, moved)
    return _Change(mistake.what, offsets, corners_change(problem, corners), priors)


def _in_radii(problem: FitProblem, state: State) -> _Change:
    """Return what a mistake in all radii of the model changes."""
    layout = problem.layout
    steps = _OF_RADII * np.array([problem.legs.radii[part] for part in layout.parts])
    priors = np.zeros(len(problem.priors))
    for x, step in zip(layout.radius.tolist(), steps.tolist(), strict=True):
        priors[problem.priors.position == x] = step
    fixed = np.where(layout.radius >= layout.size, steps, 0.0)
    thicker = replace(state, radii=state.radii + _PART * fixed)
    offsets = (offsets_of(problem, thicker) - offsets_of(problem, state)) / _PART
    return _Change("radii 1 % larger", offsets, np.zeros((len(problem.board), 2)), priors)


def corners_change(problem: FitProblem, moved: Array) -> Array:
    """Return how whitened residuals of corners (n, 2) change as these move [sensor plane]."""
    board = problem.board
    change = (board.pixels_per_unit @ moved[..., None])[..., 0]
    return np.asarray(-change / board.sigma[:, None])


def offsets_change(problem: FitProblem, state: State, moved: Array) -> Array:
    """Return how offsets (n, 2) [px] change as measured ends (n, 2, 2) move [sensor plane]."""
    feet, _ = problem.measured_ends(state)
    fixed = replace(problem.layout, intrinsic_keys=())

    def offsets(part: float) -> Array:
        """Return the offsets once the ends have moved a part of the way."""
        seen = replace(problem.outlines, feet=feet + part * moved)
        return offsets_of(replace(problem, outlines=seen, layout=fixed), state)

    return np.asarray((offsets(_PART) - offsets(0.0)) / _PART)


_ROUNDED = 1e-9  # relative: what is left of a difference of equals
_KEYS = ("fx", "fy")


@dataclass(frozen=True)
class FocalLength:
    """What the measurements say of the focal length of a camera that was taken as known.

    Attributes
    ----------
    view : str
        The view, the first one by name if several have the camera.
    given : float
        fx of the camera [px].
    change : float
        What would have to be added to fx and fy, as a part of them.
    sigma : float
        Standard deviation of that.
    """

    view: str
    given: float
    change: float
    sigma: float

    @property
    def is_doubtful(self) -> bool:
        """Whether the measurements disagree with what was given."""
        return abs(self.change) > _SIGNIFICANT * self.sigma

    def __str__(self) -> str:
        found, sigma = self.given * (1.0 + self.change), self.given * self.sigma
        away = abs(self.change) / self.sigma
        return (
            f"The focal length of {self.view} does not agree with the measurements: found fx = "
            f"{found:.1f} +- {sigma:.1f} px, given {self.given:.1f} px, {away:.0f} standard "
            f"deviations and {1e2 * self.change:+.2f} % apart; the stated uncertainty knows "
            "nothing of it; calibrate the camera again, look for pictures that were scaled or "
            f"focused anew, or let the fit find it (--free {self.view}.fx --free {self.view}.fy)."
        )


def focal_lengths(
    problem: FitProblem, state: State, linear: Linearization, whitening: Array
) -> tuple[FocalLength, ...]:
    """Return what the measurements say of the focal lengths that the fit took as known.

    Parameters
    ----------
    problem : FitProblem
        With the shifts that outlines share, so that these are not taken for a focal length.
    state : State
        Where the fit ended.
    linear : Linearization
        There.
    whitening : (n_outlines, 2, 2) array
        What *linear* was taken with.

    Returns
    -------
    tuple of FocalLength
        One a camera; those are left out of which the measurements say nothing.
    """
    layout, o = problem.layout, problem.outlines
    known = [
        v
        for v in np.unique(o.view).tolist()
        if not any(
            x < layout.size
            for key, x in zip(layout.intrinsic_keys, layout.intrinsic[v].tolist(), strict=True)
            if key in _KEYS
        )
    ]
    owners = shared_cameras(o.views, state.cameras)
    tested = sorted({owners[v] for v in known})
    if not tested:
        return ()
    changes = []
    for owner in tested:
        views = np.array([v for v in known if owners[v] == owner], dtype=np.intp)
        changes.append(_by_focal_length(problem, state, views))
    columns = whitening @ np.stack([offsets for offsets, _ in changes], axis=-1)
    of_corners = np.stack([corners for _, corners in changes], axis=-1)
    normal = normal_equations(problem, state, linear, 0.0)
    score, information = _left_by_the_fit(problem, linear, normal, columns, of_corners)
    whole = np.sum(columns**2, axis=(0, 1)) + np.sum(of_corners**2, axis=(0, 1))
    seen = np.flatnonzero(np.diagonal(information) > _ROUNDED * whole)
    covariance = np.linalg.pinv(information[np.ix_(seen, seen)], rcond=_ROUNDED, hermitian=True)
    change, sigma = -covariance @ score[seen], np.sqrt(np.diagonal(covariance))
    return tuple(
        FocalLength(
            tested[i],
            intrinsic_of(state.cameras[owners.index(tested[i])], "fx"),
            float(d),
            float(s),
        )
        for i, d, s in zip(seen.tolist(), change, sigma, strict=True)
    )


def _by_focal_length(problem: FitProblem, state: State, views: IntArray) -> tuple[Array, Array]:
    """Return the change by a relative change of the views' focal length.

    Of offsets (n, 2) [px], and of the whitened residuals of corners (m, 2).
    """
    o, c = problem.outlines, problem.board
    moved, corners = np.zeros(o.feet.shape), np.zeros(c.feet.shape)
    for v in views.tolist():
        camera, of_view, shown = state.cameras[v], o.view == v, c.view == v
        lengths = np.array([intrinsic_of(camera, key) for key in _KEYS])
        moved[of_view] = undistort_derivatives(camera, o.pixels[of_view], _KEYS) @ lengths
        corners[shown] = undistort_derivatives(camera, c.pixels[shown], _KEYS) @ lengths
    return offsets_change(problem, state, moved), corners_change(problem, corners)


def _left_by_the_fit(
    problem: FitProblem,
    linear: Linearization,
    normal: NormalEquations,
    columns: Array,
    of_corners: Array,
) -> tuple[Array, Array]:
    """Return what the fit leaves of v^T r (c,) and v^T v (c, c).

    The v are whitened columns (n, 2, c) of outlines and (m, 2, c) of corners, which no pose moves.
    """
    where, rows = problem.couplings.outlines, linear.outlines
    corners = reduced_jacobian(problem.couplings.corners, linear.corners, normal)
    kept = np.einsum("nqk,nqc->kc", reduced_jacobian(where, rows, normal), columns, optimize=True)
    kept += np.einsum("nqk,nqc->kc", corners, of_corners, optimize=True)
    J_pose = rows.J_pose
    if normal.tangent is not None:
        J_pose = J_pose @ normal.tangent.Z[where.pose]
    by_pose = np.zeros((len(normal.V), J_pose.shape[-1], columns.shape[-1]))
    np.add.at(by_pose, where.pose, np.swapaxes(J_pose, 1, 2) @ columns)
    following = normal.V_inverse @ by_pose
    covariance = normal.kept_covariance()
    g_kept = normal.g_kept - np.einsum(
        "akp,kpq,kq->a", normal.W, normal.V_inverse, normal.g_pose, optimize=True
    )
    score = np.einsum("nqc,nq->c", columns, rows.r) - kept.T @ covariance @ g_kept
    score += np.einsum("nqc,nq->c", of_corners, linear.corners.r)
    score -= np.einsum("kpc,kp->c", following, normal.g_pose)
    information = np.einsum("nqc,nqd->cd", columns, columns) - kept.T @ covariance @ kept
    information += np.einsum("nqc,nqd->cd", of_corners, of_corners)
    return score, information - np.einsum("kpc,kpd->cd", following, by_pose)
