"""Overrides: parameters that a dataset or a call fixes, frees or gives a prior by name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from legcal.errors import UsageError
from legcal.files.quantity import EXAMPLE, Quantity, read_prior, read_value
from legcal.files.schema import describe

Action = Literal["prior", "fixed", "free"]
_WORDS: Mapping[Action, str] = {
    "prior": "prior",
    "fixed": "parameter to fix",
    "free": "parameter to free",
}


@dataclass(frozen=True)
class Override:
    """An override of one parameter, or of all that a pattern matches."""

    name: str  # or a pattern
    action: Action
    where: str  # its place, as the start of a sentence about it
    stated: Quantity | None = None  # the prior, or the value that it is fixed at
    in_file: bool = False  # stated in ``dataset.yaml``; overrides of a run take precedence


def overrides_of_call(
    priors: Mapping[str, object] | Sequence[str] = (),
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
) -> tuple[Override, ...]:
    """Return the overrides in the arguments of a call or the options of a command."""
    entries: list[tuple[Action, str, object]] = []
    if isinstance(priors, Mapping):
        entries += [("prior", str(name), value) for name, value in priors.items()]
    else:
        entries += [("prior", text, None) for text in listed(priors)]
    entries += [("fixed", text, None) for text in listed(fixed)]
    entries += [("free", text, None) for text in listed(free)]
    overrides: list[Override] = []
    problems: list[str] = []
    for action, text, value in entries:
        word = "length" if action == "prior" and ":" in text else _WORDS[action]
        start = f"The {word} {describe(text)}"
        try:
            overrides.append(read_override(action, text, start, value))
        except ValueError as error:
            problems.append(f"{start} could not be used: {error}")
    if problems:
        raise UsageError(problems)
    return tuple(overrides)


def overrides_of_settings(texts: Iterable[str]) -> dict[str, list[str]]:
    """Return the settings of the option ``--set`` as the arguments priors, fixed and free.

    ``NAME`` and ``NAME=VALUE`` fix a parameter, ``NAME=VALUE±SIGMA`` is a prior, and ``NAME=free``
    estimates the parameter without one.
    """
    arguments: dict[str, list[str]] = {"priors": [], "fixed": [], "free": []}
    for text in texts:
        name, _, value = text.rpartition("=")
        if name and value.strip().casefold() == "free":
            arguments["free"].append(name)
        elif name and any(sign in value for sign in ("±", "+-", "+/-")):
            arguments["priors"].append(text)
        else:
            arguments["fixed"].append(text)
    return arguments


def read_override(
    action: Action, text: str, where: str, value: object = None, *, in_file: bool = False
) -> Override:
    """Parse an override."""
    name, stated = text, None
    if value is not None:
        stated = read_prior(value)
    elif action != "free" and "=" in text:
        name, _, behind = text.rpartition("=")
        stated = read_prior(behind) if action == "prior" else read_value(behind)
    if action == "prior" and stated is None:
        raise ValueError(
            f"found no value, needed one and its sigma; write them behind the name: {EXAMPLE}."
        )
    return Override(name, action, where, stated, in_file)


def listed(texts: Iterable[str]) -> list[str]:
    """Return texts as a list; a single text counts as one element."""
    return [texts] if isinstance(texts, str) else [str(text) for text in texts]
