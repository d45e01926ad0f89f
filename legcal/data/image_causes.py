"""Notes on images, one sentence for each cause, with all images that share it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from legcal.causes import Cause, by_cause
from legcal.data.measurements import Measurements, few, few_views, row_names


def image_notes(measurements: Measurements, causes: Mapping[int, Cause]) -> list[str]:
    """Return one sentence for each cause, which begins with the images of its rows."""
    return [
        f"{images_in_words(measurements, rows)}{': ' if len(rows) == 1 else ', each: '}{cause}"
        for cause, rows in by_cause(causes)
    ]


def images_in_words(measurements: Measurements, rows: Sequence[int]) -> str:
    """Return rows in words: ``3 images of views c1, c2 (a.png, b.png, c.png)``.

    A single one is ``view c1, image a.png``.
    """
    names = row_names(measurements)
    views = dict.fromkeys(measurements.views[int(measurements.view[row])].name for row in rows)
    of_views = few_views(list(views))
    if len(rows) == 1:
        return f"view {next(iter(views))}, image {names[rows[0]]}"
    return f"{len(rows)} images of {of_views} ({few([names[row] for row in rows])})"
