"""Fixed values that cannot be true beside the measurements.

A parameter that is fixed where it is not bends all others, and the outlines that would tell are
rejected. So everything is fitted once more with the fixed values free, up to a prior that is far
wider than what measurements tell, and these are compared with what was fixed. Where a fit fails,
stated priors are asked in the same way.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from legcal.errors import DidNotConverge, NotIdentifiable
from legcal.geometry.types import Array, IntArray
from legcal.mechanism.parameters import radius_name
from legcal.refinement.build import with_choices
from legcal.refinement.choices import Prior
from legcal.refinement.determinacy import (
    Held,
    held_at_nominal,
    mean_length,
    of_values,
    open_directions,
)
from legcal.refinement.loss import width_to_k
from legcal.refinement.normal import information, inverse_on_range
from legcal.refinement.priors import named_values
from legcal.refinement.problem import FitProblem
from legcal.refinement.rounds import Fit, first_minimum, fit_in_rounds
from legcal.refinement.settings import RefinementSettings
from legcal.refinement.start import Start
from legcal.refinement.state import State, intrinsic_of
from legcal.vision.intrinsics import intrinsic_names, intrinsic_unit

_SIGNIFICANT = 5.0  # standard deviations between a fixed value and the measurements
_WIDE = 0.05  # of the mean leg length, angles at it: the prior of what was fixed
_WIDE_RADIUS = 0.2  # of the radius
_KNOWN = 1e-3  # of the information of that prior: what the measurements must have to be asked
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
    wishes = replace(choices, fixed=choices.fixed - wide.keys(), priors={**choices.priors, **wide})
    wider = with_choices(problem, wishes, settings)
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
        if alone < _KNOWN * P[i]:
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
