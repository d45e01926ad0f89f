"""What should make the reader of a fit suspicious although it converged, and why others did not."""

from __future__ import annotations

import numpy as np

from legcal.errors import DidNotConverge, LegcalError
from legcal.geometry.types import BoolArray
from legcal.refinement.fixed_values import fixed_by_choice
from legcal.refinement.problem import FitProblem
from legcal.refinement.settings import RefinementSettings
from legcal.refinement.state import State

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
