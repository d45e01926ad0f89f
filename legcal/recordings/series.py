"""Readings over time, from a table with a column of times or from joint states in a bag."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from legcal.data.measurements import reading_columns
from legcal.data.readings_sheet import ReadingsSheet
from legcal.errors import DatasetError
from legcal.files.schema import describe
from legcal.geometry.types import Array
from legcal.machine.model import Machine

_NUMBER = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?", re.ASCII)


def unix_seconds(number: float) -> float | None:
    """Return a Unix time [s] from s, ms, us or ns, distinguished by years 2001 to 2286.

    Other numbers, such as 20261123101500, give None; numbers before 2001 are seconds.
    """
    for unit in (1e9, 1e6, 1e3, 1.0):
        if number >= 1e9 * unit:
            return number / unit if number < 1e10 * unit else None
    return number


@dataclass(frozen=True, eq=False)
class Series:
    """Readings of all encoders at times."""

    source: str  # source of the readings, for messages
    times: Array  # (n,) increasing times [s], by their own clock
    q: Array  # (n, n_motors) readings [m or rad], in the order of the actuated legs
    taken: Mapping[str, str] = field(default_factory=dict)  # interpretation of each heading
    unit: str = "m"  # unit in the table and its origin, in words
    notes: tuple[str, ...] = ()


def read_series(path: Path, machine: Machine, *, lengths: bool = False) -> Series:
    """Return the readings of a CSV with a column of times, in the order of times."""
    sheet = ReadingsSheet(path, machine, "time")
    if "time" not in sheet:
        raise DatasetError(
            f"{path}: the readings could not be used: found no column 'time', needed one in "
            "seconds or as dates; add it or call it so, or use legcal init for photographs of "
            f"single poses. {' '.join(sheet.notes)}".rstrip()
        )
    readings = sheet.readings(lengths=lengths)
    times = _seconds(sheet.text("time"), path)
    in_words = f"{readings.unit}, {readings.unit_from}"
    return _in_order(
        Series(str(path), times, readings.q, sheet.taken, in_words, tuple(sheet.notes))
    )


def series_of_joints(
    source: str, times: Sequence[float], states: Sequence[Mapping[str, float]], machine: Machine
) -> Series:
    """Return the readings of joint states: positions [m or rad] by joint name."""
    joints = [column.name for column in reading_columns(machine.legs)]
    complete = [k for k, state in enumerate(states) if all(name in state for name in joints)]
    if not complete:
        names = sorted({name for state in states for name in state})
        missing = [name for name in joints if name not in names]
        raise DatasetError(
            f"{source}: the readings could not be used: found the joints "
            f"{', '.join(map(describe, names[:10])) or 'none'}, needed "
            f"{', '.join(missing or joints)} in one message; rename the joints of the model or "
            "give a table with --readings."
        )
    q = np.array([[states[k][name] for name in joints] for k in complete], dtype=float)
    if not np.isfinite(q).all():
        raise DatasetError(
            f"{source}: the readings could not be used: found one that is no finite number, needed "
            "positions in metres; record them again."
        )
    return _in_order(Series(source, np.array([times[k] for k in complete], dtype=float), q))


def _in_order(series: Series) -> Series:
    """Return a series in the order of its times; of equal times the first is kept."""
    times, first = np.unique(series.times, return_index=True)
    if len(times) < 3:
        raise DatasetError(
            f"{series.source}: the readings could not be used: found {len(times)} different times, "
            "needed the readings of the whole recording, some each second; record them again."
        )
    return Series(series.source, times, series.q[first], series.taken, series.unit, series.notes)


def _seconds(texts: Sequence[str], path: Path) -> Array:
    """Return times [s] of numbers (Unix times in s, ms, us or ns, or seconds) or of dates."""
    others = [text for text in texts if not _NUMBER.fullmatch(text)]
    if 2 * len(others) < len(texts):
        if others:
            raise _no_time(others[0], path)
        numbers = np.array([float(text) for text in texts])
        size = float(np.median(np.abs(numbers)))
        seconds = unix_seconds(size)
        wrong = np.flatnonzero(~np.isfinite(numbers) | (seconds is None))
        if seconds is None or len(wrong):
            raise _no_time(texts[wrong[0]], path)
        return numbers * (seconds / size if size else 1.0)
    stamps = []
    for text in texts:
        try:
            moment = datetime.fromisoformat(text.strip())
        except ValueError:
            raise _no_time(text, path) from None
        stamps.append(moment.replace(tzinfo=moment.tzinfo or UTC).timestamp())
    return np.array(stamps)


def _no_time(text: str, path: Path) -> DatasetError:
    return DatasetError(
        f"{path}, column time: the time could not be read: found {describe(text)}, needed seconds, "
        "Unix times or dates such as 2026-11-23T10:15:00.125, one form in all rows; correct it."
    )
