"""A table of readings as its owner keeps it: headings, units, readings or whole lengths.

Columns are found by their headings: an encoder by the name of its leg or joint, or by a number. The
unit is that of the headings, else the one in which the readings lie in the travel of the legs.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from types import MappingProxyType

import numpy as np

from legcal.data.measurements import (
    doubted_units,
    few,
    in_travel,
    reading_columns,
    readings_of_lengths,
)
from legcal.data.reading_units import PULSES, ReadingUnit, unit_named
from legcal.errors import DatasetError, UsageError
from legcal.files import ANGLE, LENGTH, SHOWN_IN, Column, Lines, Table, describe, split_heading
from legcal.geometry import Array
from legcal.machine import Leg, Pulses

LEAST_USED = 0.01  # of the travel: less is the use that is made of it in a larger unit
# units that are tried where none is stated, of motors that slide and that turn
GUESSED = {False: ("m", "mm"), True: ("rad", "deg", PULSES)}
READING_ANGLES = (*ANGLE, PULSES)
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
        readings = [split_heading(text, (*LENGTH, *READING_ANGLES)) for text in header]
        meaning: dict[int, str] = {}
        clock: dict[int, float] = {}  # what one is in seconds, of a column of times with a unit
        for i, (key, _) in enumerate(split):
            for name, words in _HEADINGS.items():
                timed = _TIME.fullmatch(key) if name == "time" else None
                if (key in words or timed) and name not in meaning.values():
                    meaning[i] = name
                if timed and meaning.get(i) == name:
                    clock = {i: _SECONDS[timed[1]]}
        free = [i for i in range(len(header)) if i not in meaning]
        meaning |= self._joints(free, readings, header)
        for i, name in meaning.items():
            self.taken[header[i]] = name
            if name in self.joints:
                self.units[name] = readings[i][1]
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


def unit_of(
    table: Table,
    headings: Headings,
    given: str | None,
    lengths: bool,
    servos: Mapping[str, Pulses] = MappingProxyType({}),
) -> tuple[tuple[ReadingUnit, ...], str]:
    """Return the unit of the readings of each motor, and where they were found.

    *given* is that of the motors of its kind, those that slide or turn. *servos* are the pulses of
    those of which the model does not know them.
    """
    motors = headings.motors
    known = [*LENGTH, *READING_ANGLES]
    if given is not None and given not in known:
        raise UsageError(
            f"The unit could not be used: found '{given}', needed one of {', '.join(known)}; "
            "correct --unit."
        )
    if given is not None and not any(leg.reads_angle is (given not in LENGTH) for leg in motors):
        does = "slides" if given in LENGTH else "turns"
        raise UsageError(
            f"The unit could not be used: found '{given}' and no motor that {does}, needed one of "
            f"{', '.join(READING_ANGLES if given in LENGTH else LENGTH)}; correct --unit."
        )
    if lengths and any(leg.actuator is not None for leg in motors):
        raise UsageError(
            "The table could not be read: found --lengths and motors that move joints at A, needed "
            "readings of these; leave out --lengths."
        )
    found, where = dict[int, ReadingUnit](), list[str]()
    for turning in (False, True):
        some = [j for j, leg in enumerate(motors) if leg.reads_angle is turning]
        if some:
            own = given if given is not None and (given in LENGTH) is not turning else None
            units, how = _unit_of_kind(table, headings, some, own, lengths, servos)
            found |= dict(zip(some, units, strict=True))
            where.append(how)
    return tuple(found[j] for j in range(len(motors))), " and ".join(dict.fromkeys(where))


def units_in_words(units: Sequence[ReadingUnit]) -> str:
    """Return the units of readings, each once."""
    return " and ".join(dict.fromkeys(unit.name for unit in units))


def _unit_of_kind(
    table: Table,
    headings: Headings,
    some: Sequence[int],
    given: str | None,
    lengths: bool,
    servos: Mapping[str, Pulses],
) -> tuple[list[ReadingUnit], str]:
    """Return the unit of the readings of motors that all slide, or all turn, and where it was."""
    motors = [headings.motors[j] for j in some]
    joints, turning = [headings.joints[j] for j in some], motors[0].reads_angle
    stated = sorted({unit for joint in joints if (unit := headings.units.get(joint, ""))})
    if len(stated) > 1 or (given and stated and stated != [given]):
        raise DatasetError(
            f"{table.path}: the unit could not be decided: found "
            f"{' and '.join(dict.fromkeys([*([given] if given else []), *stated]))}, needed the "
            "same for all readings; correct the headings or --unit."
        )
    values = table.numbers(joints)

    def units_of(name: str) -> list[ReadingUnit]:
        return [
            unit_named(name, leg, servos.get(joint))
            for leg, joint in zip(motors, joints, strict=True)
        ]

    def fits(unit: str, as_lengths: bool, *, moving: bool = True) -> bool:
        """Say whether most readings lie in the travel, and use a part of it."""
        q = np.column_stack(
            [one.values(column) for one, column in zip(units_of(unit), values.T, strict=True)]
        )
        q = readings_of_lengths(q, motors) if as_lengths else q
        moves = np.ptp(q, axis=0) > LEAST_USED * np.ptp([leg.travel for leg in motors], axis=1)
        return bool(2 * in_travel(q, motors).mean() >= 1.0 and (not moving or moves.any()))

    has_pulses = all(
        joint in servos or (leg.actuator is not None and leg.actuator.pulses is not None)
        for leg, joint in zip(motors, joints, strict=True)
    )
    every = [x for x in READING_ANGLES if x != PULSES or has_pulses] if turning else [*LENGTH]
    known = stated[0] if stated else given
    tried = (known,) if known else tuple(x for x in GUESSED[turning] if x in every)
    where = "as the heading says" if stated else "as given"
    if known is None:
        where = "the unit in which the readings lie in the travel of the legs"
    elif known not in every and known != PULSES:
        does = "turns" if turning else "slides"
        raise DatasetError(
            f"{table.path}: the unit could not be used: found {known} of '{joints[0]}', which "
            f"{does}, needed one of {', '.join(every)}; correct the heading."
        )
    elif known == PULSES and not has_pulses:
        raise DatasetError(
            f"{table.path}: the readings could not be used: found pulses of servos of which "
            "neither centre nor us for one degree is known, needed both; give --servo 1500,11.1 "
            "for all (JOINT=1500,-11.1 for one that turns the other way), or centre_us and "
            "us_per_deg in legcal.motors of the model, with your numbers."
        )
    for unit in tried:
        if fits(unit, lengths):
            return units_of(unit), where
    words = ("lengths of legs", "readings") if lengths else ("readings", "lengths of legs")
    low, high = float(values.min()), float(values.max())
    for unit in (*tried, *(unit for unit in every if unit not in tried)):
        for other in (lengths, not lengths):
            if (other and motors[0].actuator is not None) or not fits(unit, other):
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
            return units_of(unit), where
    raise DatasetError(
        f"{table.path}: the {words[0]} could not be used: found {low:g} to {high:g}, needed "
        f"{_needed(motors[0], has_pulses=has_pulses)}; correct the travel of the model, or the "
        "table."
    )


def _needed(leg: Leg, *, has_pulses: bool) -> str:
    """Return what readings of a leg lie in, in words."""
    if leg.reads_angle:
        low, high = (math.degrees(x) for x in leg.travel)
        servo = "" if has_pulses else ", or pulses of servos with --servo CENTRE,US_PER_DEG"
        return (
            f"readings in the travel of the model ({low:g} to {high:g} deg for motor "
            f"'{leg.prismatic}'){servo}"
        )
    travel = f"{1e3 * leg.travel[0]:g} to {1e3 * leg.travel[1]:g} mm for leg '{leg.name}'"
    if leg.actuator is not None:
        return f"readings in the travel of the model ({travel})"
    at = [1e3 * leg.length_at(q) for q in leg.travel]
    return (
        f"readings in the travel of the model ({travel}) or lengths ({min(at):g} to {max(at):g} "
        "mm, with --lengths)"
    )


def readings_of(
    table: Table, headings: Headings, units: Sequence[ReadingUnit], lengths: bool
) -> tuple[Array, Array]:
    """Return readings (n_rows, n_motors) and the size of the last digit of each motor [m or rad].

    Raises DatasetError with a sentence for each reading outside its travel, and if they surely are
    in another unit.
    """
    texts = [table.text(joint) for joint in headings.joints]
    values = np.array([_exactly(column, unit) for column, unit in zip(texts, units, strict=True)]).T
    q = values
    if lengths:
        q = np.round(readings_of_lengths(values, headings.motors), 12) + 0.0
    inside = in_travel(q, headings.motors)
    for row, j in np.argwhere(~inside).tolist():
        leg, unit = headings.motors[j], units[j]
        size, shown = SHOWN_IN[leg.reading_unit]
        low, high = (size * x for x in leg.travel)
        table.refuse(
            row,
            f"{texts[j][row]} {unit.name}, which is the reading {size * q[row, j]:.6g} {shown}",
            f"one in the travel of leg '{leg.name}', {low:g} to {high:g} {shown}; correct the "
            "reading or the limits of the model",
            next(text for text, name in headings.taken.items() if name == headings.joints[j]),
            what="reading",
        )
    if inside.all() and not lengths:
        numbers = table.numbers(headings.joints)
        for doubt in doubted_units(numbers, q, headings.motors, units):
            if doubt.is_sure:
                table.refuse_file(
                    f"{doubt.in_words(table.path)}; correct the headings or --unit to "
                    f"{doubt.other}, or convert them to it if they are in {doubt.stated}."
                )
    table.check()
    digits = [min(int(Decimal(x).as_tuple().exponent) for x in column) for column in texts]
    of_unit = zip(digits, units, strict=True)
    return q, np.array([_scaled(Decimal(1).scaleb(digit), unit) for digit, unit in of_unit])


def _exactly(texts: Sequence[str], unit: ReadingUnit) -> list[float]:
    """Return readings [m or rad], lengths by their decimal digits."""
    if unit.name in LENGTH:
        return [_scaled(Decimal(text), unit) for text in texts]
    return [float(x) for x in unit.values(np.array([float(text) for text in texts]))]


def _scaled(number: Decimal, unit: ReadingUnit) -> float:
    """Return a difference of readings [m or rad], positive or not."""
    if unit.name in LENGTH:
        return float(number.scaleb(round(math.log10(unit.size))))
    return float(number) * abs(unit.size)
