"""From what somebody asks of parameters to choices: patterns resolved, contradictions refused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np

from legcal.dataset.wishes import Action, Wish
from legcal.errors import DatasetError, UsageError
from legcal.files.schema import closest
from legcal.refinement.choices import Choices, Prior
from legcal.refinement.known_parameters import KnownParameter, KnownParameters

_DONE: Mapping[Action, str] = {"prior": "given a prior", "free": "freed", "fixed": "fixed"}


def resolve(wishes: Sequence[Wish], known: KnownParameters) -> Choices:
    """Return the choices that wishes come to.

    Parameters
    ----------
    wishes : sequence of Wish
        Of the dataset and of this run; the latter win.
    known : KnownParameters
        The parameters that there are.

    Returns
    -------
    Choices

    Raises
    ------
    UsageError, DatasetError
        With one sentence for each name that is no parameter's, value that cannot be meant, and
        pair of wishes that contradict each other.
    """
    in_file, its_problems = _decisions([w for w in wishes if w.in_file], known)
    asked, problems = _decisions([w for w in wishes if not w.in_file], known)
    if problems:
        raise UsageError([*problems, *its_problems])
    if its_problems:
        raise DatasetError(its_problems)
    given_way = [name for name in in_file if asked.get(name, in_file[name]) != in_file[name]]
    decisions = {name: _known(d, known.by_name[name]) for name, d in (in_file | asked).items()}
    choices = _choices(decisions, given_way)
    _refuse_all_fixed(choices, known)
    return choices


@dataclass(frozen=True)
class _Decision:
    """What is to be done with one parameter, in its unit."""

    action: Action
    value: float | None = None
    sigma: float | None = None


def _known(decision: _Decision, parameter: KnownParameter) -> _Decision:
    """Return what a decision comes to where the camera file says how uncertain a number is."""
    if decision.action != "free" or parameter.sigma is None:
        return decision
    return _Decision("prior", parameter.nominal, parameter.sigma)


def _choices(decisions: Mapping[str, _Decision], given_way: Sequence[str]) -> Choices:
    """Return decisions sorted by what they are."""
    stated = {name: (d.value, d.sigma) for name, d in decisions.items() if d.value is not None}
    note = f"What the dataset says of {', '.join(given_way)} gave way to what this run asks for."
    return Choices(
        frozenset(name for name, d in decisions.items() if d.action == "fixed"),
        frozenset(name for name, d in decisions.items() if d.action == "free"),
        {name: Prior(value, sigma) for name, (value, sigma) in stated.items() if sigma is not None},
        {name: value for name, (value, sigma) in stated.items() if sigma is None},
        (note,) if given_way else (),
    )


def _decisions(
    wishes: Sequence[Wish], known: KnownParameters
) -> tuple[dict[str, _Decision], list[str]]:
    """Return what wishes of one source come to for each parameter, and what is wrong with them."""
    found: dict[str, list[tuple[Wish, _Decision]]] = {}
    problems: list[str] = []
    for wish in wishes:
        names = _matches(wish, known)
        if not names:
            problems.append(_no_match(wish, known))
        for name in names:
            parameter = known.by_name[name]
            problem = _misstated(wish, name, parameter)
            if problem:
                problems.append(problem)
            else:
                found.setdefault(name, []).append((wish, _decision(wish, name, parameter)))
    problems += [
        p for name, several in found.items() if (p := _contradiction(name, several, known))
    ]
    return {name: _strongest([d for _, d in several]) for name, several in found.items()}, problems


def _matches(wish: Wish, known: KnownParameters) -> tuple[str, ...]:
    """Return the parameters that a wish is about, by the names that count."""
    if wish.name in known.names:
        return (known.counted(wish.name),)
    names = [known.counted(name) for name in known.names if fnmatchcase(name, wish.name)]
    return tuple(dict.fromkeys(names))


def _no_match(wish: Wish, known: KnownParameters) -> str:
    """Return the sentence about a name that is no parameter's."""
    others = [name for name in known.others if name == wish.name or fnmatchcase(name, wish.name)]
    if others:
        return (
            f"{wish.where} could not be used: found {others[0]}, {known.others[others[0]]}, needed "
            "a parameter; leave it out."
        )
    is_pattern = not set(wish.name).isdisjoint("*?[")
    found = "a pattern that no name matches" if is_pattern else "an unknown name"
    return (
        f"{wish.where} could not be used: found {found}, needed a parameter of this machine or of "
        f"its cameras; {closest(wish.name, known.names)}"
    )


def _misstated(wish: Wish, name: str, parameter: KnownParameter) -> str:
    """Return what is wrong with the value that a wish states for a parameter, if anything."""
    stated = wish.stated
    if stated is None:
        return ""
    if stated.dimension not in ("", parameter.unit):
        needed = f"a number in {parameter.unit}" if parameter.unit else "a number without unit"
        return (
            f"{wish.where} could not be used: found a number in {stated.dimension} for {name}, "
            f"needed {needed}; correct the unit."
        )
    if parameter.least <= stated.value <= parameter.most:
        return ""
    return (
        f"{wish.where} could not be used: found {_with_unit(stated.value, parameter)} for {name}, "
        f"needed one between {parameter.least:.4g} and {parameter.most:.4g}, not so far from the "
        f"nominal {_with_unit(parameter.nominal, parameter)}; check the number and its unit."
    )


def _decision(wish: Wish, name: str, parameter: KnownParameter) -> _Decision:
    """Return what a wish comes to for one parameter."""
    if wish.stated is None:
        return _Decision(wish.action)
    value = wish.stated.value
    if name.endswith(".twist"):  # an angle between lines
        value -= float(np.pi * np.round((value - parameter.nominal) / np.pi))
    return _Decision(wish.action, value, wish.stated.sigma)


def _contradiction(
    name: str, several: Sequence[tuple[Wish, _Decision]], known: KnownParameters
) -> str:
    """Return what is wrong with all that is asked of one parameter, if anything."""
    fixed = [wish for wish, decision in several if decision.action == "fixed"]
    others = [wish for wish, decision in several if decision.action != "fixed"]
    stated = {(d.value, d.sigma): wish for wish, d in several if d.value is not None}
    if fixed and others:
        done, pair = f"both fixed and {_DONE[others[0].action]}", (fixed[0], others[0])
    elif len(stated) > 1:
        first, second, *_ = stated.values()
        done = "fixed at two values" if fixed else "given two different priors"
        pair = (first, second)
    else:
        return ""
    other = next((w.name for w in pair if w.name in known.synonyms), "")
    also = f", which is {other} too," if other else ""  # views that have one camera
    return (
        f"{name}{also} could not be {done}: found {_quoted(pair[0])} and {_quoted(pair[1])}, "
        "needed one of them; remove the other."
    )


def _strongest(decisions: Sequence[_Decision]) -> _Decision:
    """Return what several decisions that agree come to: one that states a value says most."""
    return next((d for d in decisions if d.value is not None), decisions[0])


def _refuse_all_fixed(choices: Choices, known: KnownParameters) -> None:
    """Raise UsageError if nothing of the mechanism is left to be found."""
    names = [name for name, p in known.by_name.items() if p.kind == "kinematic"]
    if all(choices.holds(name, by_default=name.endswith(".twist")) for name in names):
        raise UsageError(
            "The mechanism could not be calibrated: found all of its parameters fixed, needed one "
            "at least that is not; fix fewer of them."
        )


def _quoted(wish: Wish) -> str:
    """Return where a wish was said, as part of a sentence."""
    return wish.where[:1].lower() + wish.where[1:] if not wish.in_file else wish.where


def _with_unit(value: float, parameter: KnownParameter) -> str:
    """Return a value and its unit."""
    return f"{value:.4g} {parameter.unit}".rstrip()
