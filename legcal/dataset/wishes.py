"""What somebody asks of parameters by name, as it was written: fixed, free, or with a prior.

In a text the value stands behind the name: ``leg1.length=0.4200±0.0001``, ``leg1.length=420+-0.1
mm``, ``leg1.offset=0.35``. A name may be a pattern of the shell's kind: ``*.offset``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from legcal.errors import UsageError
from legcal.files.schema import describe
from legcal.files.stated import EXAMPLE, Stated, read_prior, read_value

Action = Literal["prior", "fixed", "free"]
_WORDS: Mapping[Action, str] = {
    "prior": "prior",
    "fixed": "parameter to fix",
    "free": "parameter to free",
}


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
        stated = read_prior(behind) if action == "prior" else read_value(behind)
    if action == "prior" and stated is None:
        raise ValueError(
            f"found no value, needed one and its sigma; write them behind the name: {EXAMPLE}."
        )
    return Wish(name, action, where, stated, in_file)


def _listed(texts: Iterable[str]) -> list[str]:
    """Return texts as a list; a single text is one of them."""
    return [texts] if isinstance(texts, str) else [str(text) for text in texts]
