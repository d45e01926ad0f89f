"""Priors that cannot be true beside the measurements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legcal.errors import DidNotConverge
from legcal.refinement.determinacy import of_values
from legcal.refinement.normal import NormalEquations, inverse_on_range
from legcal.refinement.priors import named_values
from legcal.refinement.problem import FitProblem
from legcal.refinement.state import State

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
        From :func:`legcal.refinement.normal.information` there.

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
