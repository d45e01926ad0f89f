"""What is said of many images, one sentence a cause: those that share it are named together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from legcal.causes import Cause, by_cause
from legcal.data.measurements import Measurements, few, few_views, row_names


def image_notes(measurements: Measurements, causes: Mapping[int, Cause]) -> list[str]:
    """Return what is said of rows as sentences, one a cause, that begin with the images."""
    return [
        f"{images_in_words(measurements, rows)}{': ' if len(rows) == 1 else ', each: '}{cause}"
        for cause, rows in by_cause(causes)
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
