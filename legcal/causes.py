"""Causes as words with values, so that equal causes are stated once.

Sentences are made for the reader only; until then a cause is data. Causes with the same words and
names are one cause, whatever their figures, and are stated once with the range of the figures.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias, TypeVar

_K = TypeVar("_K", bound=Hashable)


class Figures(tuple[float, ...]):
    """Numbers that are stated as a range, from the smallest to the largest."""

    def __format__(self, spec: str) -> str:
        shown = list(dict.fromkeys(format(number, spec) for number in sorted(self)))
        return " to ".join(dict.fromkeys((shown[0], shown[-1])))


Value: TypeAlias = "str | float | Figures | Cause"


@dataclass(frozen=True)
class Cause:
    """A cause: words with a place for each value, as ``str.format`` has them, and the values.

    A value is a name, a number (or several), or another cause.
    """

    words: str
    values: tuple[Value, ...] = ()

    def __str__(self) -> str:
        return self.words.format(*self.values)

    @property
    def kind(self) -> Hashable:
        """The cause without its figures."""
        return self.words, tuple(
            value.kind if isinstance(value, Cause) else value if isinstance(value, str) else None
            for value in self.values
        )


def together(causes: Sequence[Cause]) -> Cause:
    """Merge causes of one kind, with all their figures."""
    columns = zip(*(cause.values for cause in causes), strict=True)
    return Cause(causes[0].words, tuple(map(_joined, columns)))


def _joined(values: tuple[Value, ...]) -> Value:
    """Merge a value of several causes of one kind."""
    if isinstance(values[0], str):
        return values[0]
    if isinstance(values[0], Cause):
        return together([value for value in values if isinstance(value, Cause)])
    numbers: list[float] = []
    for value in values:
        if isinstance(value, int | float):
            numbers.append(value)
        elif isinstance(value, Figures):
            numbers += value
    return Figures(numbers)


def by_cause(causes: Mapping[_K, Cause]) -> list[tuple[Cause, tuple[_K, ...]]]:
    """Return each cause once, with the keys of its effects."""
    alike: dict[Hashable, dict[_K, Cause]] = {}
    for key, cause in causes.items():
        alike.setdefault(cause.kind, {})[key] = cause
    return [
        (together(list(causes_by_key.values())), tuple(causes_by_key))
        for causes_by_key in alike.values()
    ]
