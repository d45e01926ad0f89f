"""Order in which images were taken: by their times, else by the numbers in their names."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from datetime import date, datetime, time
from pathlib import PurePosixPath

import numpy as np

from legcal.data.measurements import Measurements, row_names
from legcal.geometry.types import Array, IntArray

_NUMBER = re.compile(r"\d+")
_EXIF_DATE = re.compile(r"(\d{4}):(\d\d):(\d\d)")


def image_sequences(
    measurements: Measurements, taken_at: Mapping[str, str]
) -> tuple[IntArray, ...]:
    """Return the rows in the order of their images, one array for each order that is known.

    Times order the images of all views; *taken_at* has those of files by image, as EXIF writes
    them. Numbers in names order the images of one view: nothing says which view came first.
    The order of rows in the table has no meaning.
    """
    times = _times(measurements, taken_at)
    if times is not None:
        return (np.argsort(times, kind="stable"),)
    names = row_names(measurements)
    sequences = []
    for v in range(len(measurements.views)):
        rows = np.flatnonzero(measurements.view == v)
        numbers = _numbers([names[row] for row in rows.tolist()])
        if numbers is not None:
            sequences.append(rows[np.argsort(numbers)])
    return tuple(sequences)


def _times(measurements: Measurements, taken_at: Mapping[str, str]) -> Array | None:
    """Return the time of each row [s], None unless all are known and most poses differ in it."""
    times = measurements.time
    if times is None or not np.isfinite(times).all():
        times = np.full(measurements.n_rows, np.nan)
        for row, image in enumerate(measurements.image):
            moment = moment_of(taken_at.get(image, ""))
            if moment is None:
                return None
            times[row] = (moment - datetime(1970, 1, 1)).total_seconds()
    n_moments = len(np.unique(times))
    return times if 2 * n_moments > measurements.n_poses else None


def moment_of(text: str, day: date | None = None) -> datetime | None:
    """Return the time in a text: ISO 8601, as EXIF writes it, or of the day alone."""
    text = _EXIF_DATE.sub(r"\1-\2-\3", text.strip(), count=1)
    try:
        return datetime.fromisoformat(text).replace(tzinfo=None)
    except ValueError:
        pass
    try:
        return None if day is None else datetime.combine(day, time.fromisoformat(text))
    except ValueError:
        return None


def _numbers(names: Sequence[str]) -> IntArray | None:
    """Return the rank of each name by the last number in its stem, None unless they all differ.

    Where all names have as many numbers, as dates and times have, the first ones count before.
    """
    found = [
        [int(digits) for digits in _NUMBER.findall(PurePosixPath(name).stem)] for name in names
    ]
    if len(names) < 2 or not all(found):
        return None
    if len({len(numbers) for numbers in found}) > 1:
        found = [numbers[-1:] for numbers in found]
    ranks = {numbers: rank for rank, numbers in enumerate(sorted({tuple(n) for n in found}))}
    return np.array([ranks[tuple(n)] for n in found]) if len(ranks) == len(names) else None
