"""What somebody asks of parameters by name, as it was written: fixed, free, or with a prior.

In a text the value stands behind the name: ``leg1.length=0.4200±0.0001``, ``leg1.length=420+-0.1
mm``, ``leg1.offset=0.35``. A name may be a pattern of the shell's kind: ``*.offset``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Literal

from legcal.errors import UsageError
from legcal.files.quantity import ANGLE, LENGTH, PIXELS
from legcal.files.schema import describe

Action = Literal["prior", "fixed", "free"]
SMALLEST_SIGMA = 1e-9  # [m, rad, px]; what is known better is fixed

_DIMENSIONS = {"m": LENGTH, "rad": ANGLE, "px": PIXELS}
_SIZES = {unit: size for units in _DIMENSIONS.values() for unit, size in units.items()}
_DIMENSION = {unit: name for name, units in _DIMENSIONS.items() for unit in units}
_NUMBER = r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([A-Za-z]*)\s*"
_VALUE = re.compile(_NUMBER, re.ASCII)
_PRIOR = re.compile(rf"{_NUMBER}(?:±|\+/?-){_NUMBER}", re.ASCII)
_WORDS: Mapping[Action, str] = {
    "prior": "prior",
    "fixed": "parameter to fix",
    "free": "parameter to free",
}
_EXAMPLE = "0.4200±0.0001 or 420±0.1 mm"


@dataclass(frozen=True)
class Stated:
    """A number as somebody stated it.

    Attributes
    ----------
    value : float
        In SI units or pixels.
    sigma : float or None
        Its standard deviation; None where there is none.
    dimension : {"m", "rad", "px", ""}
        What its unit is one of; "" where none was written.
    """

    value: float
    sigma: float | None = None
    dimension: str = ""


@dataclass(frozen=True)
class Wish:
    """What somebody asks of one parameter, or of all that a pattern matches.

    Attributes
    ----------
    name : str
        A name or a pattern.
    action : {"prior", "fixed", "free"}
        What to do with it.
    where : str
        Where this was said: the start of a sentence about it.
    stated : Stated or None
        The prior, or the value that it is fixed at; None for the nominal one.
    in_file : bool
        Said in ``dataset.yaml``, which gives way to what is asked for in a run.
    """

    name: str
    action: Action
    where: str
    stated: Stated | None = None
    in_file: bool = False


def wishes_of_call(
    priors: Mapping[str, object] | Sequence[str] = (),
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
) -> tuple[Wish, ...]:
    """Return what the arguments of a call or the options of a command ask for.

    Parameters
    ----------
    priors : mapping or sequence of str
        Pairs (value, sigma) in SI units or pixels, or texts with units, by name; or texts that
        begin with ``NAME=``.
    fixed, free : sequence of str
        Names; ``NAME=VALUE`` fixes at a value that is not the nominal one.

    Raises
    ------
    UsageError
        With one sentence for each that cannot be read.
    """
    entries: list[tuple[Action, str, object]] = []
    if isinstance(priors, Mapping):
        entries += [("prior", str(name), value) for name, value in priors.items()]
    else:
        entries += [("prior", text, None) for text in _listed(priors)]
    entries += [("fixed", text, None) for text in _listed(fixed)]
    entries += [("free", text, None) for text in _listed(free)]
    found: list[Wish] = []
    problems: list[str] = []
    for action, text, value in entries:
        where = f"The {_WORDS[action]} {describe(text)}"
        try:
            found.append(read_wish(action, text, where, value))
        except ValueError as error:
            problems.append(f"{where} could not be used: {error}")
    if problems:
        raise UsageError(problems)
    return tuple(found)


def read_wish(
    action: Action, text: str, where: str, value: object = None, *, in_file: bool = False
) -> Wish:
    """Return a wish as it was written.

    Parameters
    ----------
    action : {"prior", "fixed", "free"}
        What to do.
    text : str
        The name, with ``=VALUE`` behind it where the value does not stand apart.
    where : str
        Where this was said.
    value : Stated, str, pair of numbers, mapping or None
        The prior, where it stands apart from its name.
    in_file : bool
        Said in ``dataset.yaml``.

    Raises
    ------
    ValueError
        If the value cannot be read: found, needed, and what to do.
    """
    name, stated = text, None
    if value is not None:
        stated = read_prior(value)
    elif action != "free" and "=" in text:
        name, _, behind = text.rpartition("=")
        stated = read_prior(behind) if action == "prior" else _read_value(behind)
    if action == "prior" and stated is None:
        raise ValueError(
            f"found no value, needed one and its sigma; write them behind the name: {_EXAMPLE}."
        )
    return Wish(name, action, where, stated, in_file)


def read_prior(value: object) -> Stated:
    """Return a prior given as text, as (value, sigma) or as {value, sigma}.

    Raises
    ------
    ValueError
        If it is none of these, its units contradict each other, or sigma is zero, negative, far
        too small or not finite.
    """
    if isinstance(value, Stated):
        return value
    if isinstance(value, str):
        return _read_prior_text(value)
    if isinstance(value, Mapping) and set(value) == {"value", "sigma"}:
        value = (value["value"], value["sigma"])
    if not isinstance(value, Sequence) or len(value) != 2 or not all(map(_is_number, value)):
        raise ValueError(
            f"found {describe(value)}, needed a value and its sigma; write it like {_EXAMPLE}."
        )
    try:
        return _checked(Stated(float(value[0]), float(value[1])))
    except OverflowError as error:
        raise ValueError(
            "found a number beyond 1e308, needed a value and its sigma; correct it."
        ) from error


def _read_prior_text(text: str) -> Stated:
    """Return the prior that a text states; a unit at its end counts for both numbers."""
    match = _PRIOR.fullmatch(text)
    if match is None:
        raise ValueError(
            f"found {describe(text.strip())}, needed a value and its sigma; write it like "
            f"{_EXAMPLE}."
        )
    value, unit, sigma, unit_of_sigma = match.groups()
    if unit and not unit_of_sigma:
        raise ValueError(
            f"found {describe(text.strip())}, needed the unit of sigma too; write it at "
            f"the end, like {_EXAMPLE}."
        )
    by_value, by_sigma = (
        _read_value(value + (unit or unit_of_sigma)),
        _read_value(sigma + unit_of_sigma),
    )
    if by_value.dimension != by_sigma.dimension:
        raise ValueError(
            f"found {describe(text.strip())}, needed units of one kind; write both in one unit."
        )
    return _checked(Stated(by_value.value, by_sigma.value, by_value.dimension))


def _read_value(text: str) -> Stated:
    """Return the number that a text states, with its unit if there is one."""
    match = _VALUE.fullmatch(text)
    if match is None or not math.isfinite(float(match[1])):
        raise ValueError(
            f"found {describe(text.strip())}, needed a number, with a unit or in SI units; "
            "write one, such as 0.42 or 420mm."
        )
    unit = match[2]
    if unit and unit not in _SIZES:
        raise ValueError(
            f"found the unknown unit '{unit}', needed one of {', '.join(_SIZES)}; leave it out "
            "for SI units and pixels."
        )
    return Stated(float(match[1]) * _SIZES.get(unit, 1.0), None, _DIMENSION.get(unit, ""))


def _checked(stated: Stated) -> Stated:
    """Return a prior if its numbers make one."""
    sigma = stated.sigma
    if not math.isfinite(stated.value):
        raise ValueError(f"found the value {stated.value:g}, needed a finite one; correct it.")
    if sigma is None or not math.isfinite(sigma) or sigma <= 0.0:
        raise ValueError(
            f"found the sigma {sigma:g}, needed a finite one above zero; give one standard "
            "deviation, or fix the parameter."
        )
    if sigma < SMALLEST_SIGMA:
        raise ValueError(
            f"found the sigma {sigma:g}, needed at least {SMALLEST_SIGMA:g}; fix the parameter at "
            "the value instead."
        )
    return stated


def _is_number(value: object) -> bool:
    """Say whether something is a real number; true is none."""
    return isinstance(value, Real) and not isinstance(value, bool)


def _listed(texts: Iterable[str]) -> list[str]:
    """Return texts as a list; a single text is one of them."""
    return [texts] if isinstance(texts, str) else [str(text) for text in texts]
