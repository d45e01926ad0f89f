"""What is said of many images, one sentence a cause: those that share it are named together."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import NamedTuple

from legcal.data.measurements import Measurements, few, few_views, row_names

_FIGURE = re.compile(r"(?<![\w./-])\d+(?:\.\d+)?(?![\w/-]|\.\w)")  # by itself, in no name


class Cause(NamedTuple):
    """What is said of some images."""

    what: str  # with figures from the least to the greatest
    rows: tuple[int, ...]


def by_cause(said: Mapping[int, str]) -> list[Cause]:
    """Return what is said of rows, each cause once: texts that differ in figures alone are one."""
    alike: dict[str, dict[int, str]] = {}
    for row, text in said.items():
        alike.setdefault(_FIGURE.sub("#", text), {})[row] = text
    return [Cause(_with_ranges(list(own.values())), tuple(own)) for own in alike.values()]


def image_notes(measurements: Measurements, said: Mapping[int, str]) -> list[str]:
    """Return what is said of rows as sentences, one a cause, that begin with the images."""
    return [
        f"{images_in_words(measurements, rows)}{': ' if len(rows) == 1 else ', each: '}{what}"
        for what, rows in by_cause(said)
    ]


def images_in_words(measurements: Measurements, rows: Sequence[int]) -> str:
    """Return rows as a sentence names them: ``3 images of views c1, c2 (a.png, b.png, c.png)``.

    A single one is ``view c1, image a.png``.
    """
    names = row_names(measurements)
    views = dict.fromkeys(measurements.views[int(measurements.view[row])].name for row in rows)
    of_views = few_views(list(views))
    if len(rows) == 1:
        return f"view {next(iter(views))}, image {names[rows[0]]}"
    return f"{len(rows)} images of {of_views} ({few([names[row] for row in rows])})"


def _with_ranges(texts: Sequence[str]) -> str:
    """Return texts that differ in figures alone as one, with ranges of these."""
    between = _FIGURE.split(texts[0])
    figures = [
        sorted(set(column), key=float)
        for column in zip(*(_FIGURE.findall(text) for text in texts), strict=True)
    ]
    ranges = [own[0] if len(own) == 1 else f"{own[0]} to {own[-1]}" for own in figures]
    return "".join(a + b for a, b in zip_longest(between, ranges, fillvalue=""))
