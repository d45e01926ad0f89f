"""A table of readings as its owner keeps it: headings, units, readings or whole lengths.

Columns are found by their headings: an encoder by the name of its leg or joint, or by a number. The
unit is that of the headings, else the one in which the readings lie in the travel of the legs.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path

import numpy as np

from legcal.data.measurements import few, in_travel, reading_columns, readings_of_lengths
from legcal.errors import DatasetError, UsageError
from legcal.files import LENGTH, Column, Lines, Table, describe, split_heading
from legcal.geometry import Array
from legcal.machine import Leg

LEAST_USED = 0.01  # of the travel: less is the use that is made of it in a larger unit
GUESSED = ("m", "mm")  # units that are tried where none is stated
_HEADINGS = {
    "view": ("view", "camera", "cam", "cameraposition", "viewpoint", "station", "setup"),
    "image": ("image", "img", "file", "filename", "imagefile", "name", "photo", "photograph",
              "photofile", "picture", "pic", "imagename", "photoname", "frame", "shot"),
    "pose": ("pose", "poseid", "posenumber", "posename", "poselabel"),
    "time": ("time", "timestamp", "datetime", "date", "takenat", "clock", "elapsed", "elapsedtime"),
}  # fmt: skip
_SECONDS = {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
_TIME = re.compile(rf"(?:{'|'.join(_HEADINGS['time'])}|t)({'|'.join(_SECONDS)})")
_NUMBERED = re.compile(r"([^\W\d]*?)0*(\d{1,3})([^\W\d]*)")


class Headings:
    """What the headings of a table of readings mean."""

    def __init__(self, path: Path, motors: Sequence[Leg]) -> None:
        self.path = path
        self.motors = motors
        self.joints = [column.name for column in reading_columns(motors)]
        self.taken: dict[str, str] = {}  # meaning of each heading that is used
        self.units: dict[str, str] = {}  # of each joint, as its heading says
        self.notes: list[str] = []

    def columns(self) -> list[Column]:
        """Return the columns of the table once its headings are understood."""
        texts = [Column(name, "text", required=False) for name in _HEADINGS]
        return [*texts, *(Column(joint, what="reading") for joint in self.joints)]

    def reshape(self, lines: Lines) -> Lines:
        """Return lines under the names that their columns have here; others are left out."""
        number, header = lines[0]
        split = [split_heading(text) for text in header]
        meaning: dict[int, str] = {}
        clock: dict[int, float] = {}  # what one is in seconds, of a column of times with a unit
        for i, (key, _) in enumerate(split):
            for name, words in _HEADINGS.items():
                timed = _TIME.fullmatch(key) if name == "time" else None
                if (key in words or timed) and name not in meaning.values():
                    meaning[i] = name
                if timed and meaning.get(i) == name:
                    clock = {i: _SECONDS[timed[1]]}
        meaning |= self._joints([i for i in range(len(header)) if i not in meaning], split, header)
        for i, name in meaning.items():
            self.taken[header[i]] = name
            if name in self.joints:
                self.units[name] = split[i][1]
        unused = [text for i, text in enumerate(header) if i not in meaning and text]
        if unused:
            one = len(unused) == 1
            self.notes.append(
                f"Column{'' if one else 's'} {few([describe(text) for text in unused])} of "
                f"{self.path} {'is' if one else 'are'} not used."
            )
        kept = sorted(meaning)
        below = [
            (line, [_dated(cells[i], clock.get(i)) for i in kept])
            if len(cells) == len(header)
            else (line, cells)
            for line, cells in lines[1:]
        ]
        return [(number, [meaning[i] for i in kept]), *below]

    def _joints(
        self, free: Sequence[int], split: Sequence[tuple[str, str]], header: Sequence[str]
    ) -> dict[int, str]:
        """Return the joint of each column of readings, by names or else by numbers."""
        found: dict[int, str] = {}
        for joint, leg in zip(self.joints, self.motors, strict=True):
            words = {split_heading(joint)[0], split_heading(leg.name)[0]}
            same = [i for i in free if split[i][0] in words]
            if len(same) > 1:
                raise DatasetError(
                    f"{self.path}, header: the readings of leg '{leg.name}' could not be decided: "
                    f"found the columns {' and '.join(describe(header[i]) for i in same)}, needed "
                    "one; remove the others."
                )
            found |= dict.fromkeys(same, joint)
        if len(found) == len(self.joints):
            return found
        numbered = {i: m for i in free if (m := _NUMBERED.fullmatch(split[i][0]))}
        families: dict[tuple[str, str], dict[int, int]] = {}
        for i, m in numbered.items():
            families.setdefault((m[1], m[3]), {})[int(m[2])] = i
        n = len(self.joints)
        fits = [
            [by_number[k] for k in sorted(by_number)]
            for by_number in families.values()
            if sorted(by_number) in (list(range(1, n + 1)), list(range(n)))
        ]
        if len(fits) == 1:
            return dict(zip(fits[0], self.joints, strict=True))
        missing = [leg.name for leg, joint in zip(self.motors, self.joints, strict=True)
                   if joint not in found.values()]  # fmt: skip
        columns = few([describe(header[i]) for i in free]) or "none"
        raise DatasetError(
            f"{self.path}, header: the readings of {few(missing)} could not be found: found the "
            f"columns {columns}, needed one for each of the {n} legs with an encoder, named after "
            f"the leg ({self.motors[0].name}), its joint ({self.joints[0]}) or its number "
            "(L1, q1, 1); rename the columns."
        )


def _dated(cell: str, size: float | None) -> str:
    """Return a number of seconds, or of a part *size* of them, as a date; other cells unchanged."""
    if size is None:
        return cell
    try:
        return datetime.fromtimestamp(float(cell) * size, UTC).replace(tzinfo=None).isoformat()
    except (ValueError, OverflowError, OSError):
        return cell


def unit_of(table: Table, headings: Headings, given: str | None, lengths: bool) -> tuple[str, str]:
    """Return the unit of the readings and where it was found."""
    stated = sorted({unit for unit in headings.units.values() if unit})
    if given is not None and given not in LENGTH:
        raise UsageError(
            f"The unit could not be used: found '{given}', needed one of {', '.join(LENGTH)}; "
            "correct --unit."
        )
    if len(stated) > 1 or (given and stated and stated != [given]):
        raise DatasetError(
            f"{table.path}: the unit could not be decided: found "
            f"{' and '.join(dict.fromkeys([*([given] if given else []), *stated]))}, needed the "
            "same for all readings; correct the headings or --unit."
        )
    values, motors = table.numbers(headings.joints), headings.motors

    def fits(unit: str, as_lengths: bool, *, moving: bool = True) -> bool:
        """Say whether most readings lie in the travel, and use a part of it."""
        q = LENGTH[unit] * values
        q = readings_of_lengths(q, motors) if as_lengths else q
        moves = np.ptp(q, axis=0) > LEAST_USED * np.ptp([leg.travel for leg in motors], axis=1)
        return bool(2 * in_travel(q, motors).mean() >= 1.0 and (not moving or moves.any()))

    known = stated[0] if stated else given
    tried = (known,) if known else GUESSED
    where = "as the heading says" if stated else "as given"
    if known is None:
        where = "the unit in which the readings lie in the travel of the legs"
    for unit in tried:
        if fits(unit, lengths):
            return unit, where
    words = ("lengths of legs", "readings") if lengths else ("readings", "lengths of legs")
    low, high = float(values.min()), float(values.max())
    for unit in (*tried, *(unit for unit in LENGTH if unit not in tried)):
        for other in (lengths, not lengths):
            if not fits(unit, other):
                continue
            remedies = []
            if other is not lengths:
                remedies.append("leave out --lengths" if lengths else "add --lengths")
            if unit not in tried:
                remedies.append(f"give the unit {unit}")
            raise DatasetError(
                f"{table.path}: the {words[0]} could not be used: found {low:g} to {high:g}, which "
                f"look like {words[other is not lengths]} in {unit}; {' and '.join(remedies)}."
            )
    for unit in tried:
        if fits(unit, lengths, moving=False):
            return unit, where
    leg = motors[0]
    at = [1e3 * leg.length_at(q) for q in leg.travel]
    raise DatasetError(
        f"{table.path}: the {words[0]} could not be used: found {low:g} to {high:g}, needed "
        f"readings in the travel of the model ({1e3 * leg.travel[0]:g} to {1e3 * leg.travel[1]:g} "
        f"mm for leg '{leg.name}') or lengths ({min(at):g} to {max(at):g} mm, with --lengths); "
        "correct the travel of the model, or the table."
    )


def readings_of(table: Table, headings: Headings, unit: str, lengths: bool) -> tuple[Array, float]:
    """Return readings (n_rows, n_motors) [m], and the size of the last digit of the table [m].

    Raises DatasetError with a sentence for each reading outside its travel.
    """
    power = round(math.log10(LENGTH[unit]))
    texts = [table.text(joint) for joint in headings.joints]
    exact = [[Decimal(text).scaleb(power) for text in column] for column in texts]
    values = np.array([[float(x) for x in column] for column in exact]).T
    q = values
    if lengths:
        q = np.round(readings_of_lengths(values, headings.motors), 12) + 0.0
    inside = in_travel(q, headings.motors)
    for row, j in np.argwhere(~inside).tolist():
        leg = headings.motors[j]
        low, high = (1e3 * x for x in leg.travel)
        table.refuse(
            row,
            f"{texts[j][row]} {unit}, which is the reading {1e3 * q[row, j]:.6g} mm",
            f"one in the travel of leg '{leg.name}', {low:g} to {high:g} mm; correct the reading "
            "or the limits of the model",
            next(text for text, name in headings.taken.items() if name == headings.joints[j]),
            what="reading",
        )
    table.check()
    digits = [int(x.as_tuple().exponent) for column in exact for x in column]
    return q, 10.0 ** min(digits)
