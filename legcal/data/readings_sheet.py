"""A table of readings as its owner keeps it: headings, units, readings or whole lengths.

Columns are identified by their headings: an encoder by the name of its leg or joint, or by a
number. The unit comes from the headings, else it is the one in which the readings lie in the travel
of the legs.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal
from functools import cached_property
from pathlib import Path

import numpy as np

from legcal.data.measurements import few, reading_columns
from legcal.data.reading_units import (
    PULSES,
    Meaning,
    ReadingUnit,
    doubtful_units,
    in_travel,
    is_length,
    joint_values,
    meanings,
    readings_of_lengths,
)
from legcal.errors import DatasetError, Place, UsageError
from legcal.files.quantity import ANGLE, LENGTH, SHOWN_IN, unit_size
from legcal.files.schema import describe
from legcal.files.table import (
    WORDS,
    Column,
    Lines,
    concepts,
    is_number,
    read_table,
    split_heading,
)
from legcal.geometry.types import Array
from legcal.machine.leg import Leg
from legcal.machine.model import Machine

LEAST_USED = 0.01  # minimum fraction of the travel in use: with less, the unit is a larger one
# Units tried where none is stated, of motors that slide and that turn
GUESSED = {False: ("m", "mm"), True: ("rad", "deg", PULSES)}
READING_ANGLES = (*ANGLE, PULSES)
_DECIMALS = 12  # of readings in metres and radians
_SECONDS = {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
_COLUMNS = ("view", "image", "pose", "time")
_TIME = re.compile(rf"(?:{WORDS['time'].replace(' ', '|')}|t)({'|'.join(_SECONDS)})")
_NUMBERED = re.compile(r"([^\W\d]*?)0*(\d{1,3})([^\W\d]*)")
# Units at the end of a heading without brackets that would else be part of a name
_FOREIGN = {
    *("inch", "inches", "zoll", "feet", "foot", "dm", "mil", "mils", "yd"),
    *("counts", "steps", "ticks", "turns", "grad", "gon", "arcmin", "arcsec"),
}


@dataclass(frozen=True, eq=False)
class SheetReadings:
    """The readings of a sheet, and the units in which they are written there."""

    q: Array  # (n_rows, n_motors) [m or rad]
    digits: Array  # (n_motors,) the size of the last digit [m or rad]
    units: tuple[ReadingUnit, ...]  # of each motor
    unit_from: str  # origin of the units, in words
    are_lengths: bool  # whether they are written as whole lengths of legs

    @property
    def unit(self) -> str:
        """The units in words, each once."""
        return " and ".join(dict.fromkeys(unit.name for unit in self.units))


class ReadingsSheet:
    """A table of readings, one row for each photograph or time (*row_noun*).

    Attributes
    ----------
    motors : list of Leg
        The legs whose readings it holds.
    taken : dict
        Meaning of each heading in use: a joint, view, image, pose or time.
    notes : list of str
        Oddities, and columns that were left out.

    Raises
    ------
    DatasetError
        If the file, a heading or a cell cannot be read.
    """

    def __init__(
        self,
        path: Path,
        machine: Machine,
        row_noun: str,
    ) -> None:
        self.path = path
        self.motors = [machine.legs[j] for j in machine.motors]
        self.taken: dict[str, str] = {}
        self.notes: list[str] = []
        self._joints = [column.name for column in reading_columns(self.motors)]
        self._heading_units: dict[str, str] = {}  # by joint
        columns = [Column(name, "text", required=False) for name in _COLUMNS]
        columns += [Column(joint, what="reading") for joint in self._joints]
        self._table = read_table(
            path,
            "table of readings",
            "row",
            columns,
            needed=f"one row for each {row_noun}; write them",
            reshape=self._renamed_columns,
        )
        self._table.check()

    def __contains__(self, name: str) -> bool:
        return name in self._table

    def text(self, name: str) -> tuple[str, ...]:
        """Return the cells of a column of texts by row, empty where there is no such column."""
        return self._table.text(name)

    @property
    def where(self) -> list[Place]:
        """The place of each row in the file, for messages."""
        return self._table.where

    def readings(self, unit: str | None = None, *, lengths: bool = False) -> SheetReadings:
        """Return the readings [m, rad], with the precision of their decimal digits.

        Parameters
        ----------
        unit : str, optional
            Unit of the motors of its kind, sliding or turning; by default the unit of the headings,
            else the unit in which readings lie in the travel.
        lengths : bool
            Whether the columns are whole lengths of legs; they are too if nothing else fits.

        Raises
        ------
        DatasetError, UsageError
            If the unit cannot be decided or is certainly wrong, or with a sentence for each
            reading outside its travel.
        """
        units, unit_from, lengths = self._units(unit, lengths)
        texts = [self._table.text(joint) for joint in self._joints]
        q = joint_values(self._table.numbers(self._joints), units)
        q = readings_of_lengths(q, self.motors) if lengths else q
        q = np.round(q, _DECIMALS) + 0.0  # as decimal as they were written
        inside = in_travel(q, self.motors)
        for row, j in np.argwhere(~inside).tolist():
            leg = self.motors[j]
            size, shown = SHOWN_IN[leg.reading_unit]
            low, high = (size * x for x in leg.travel)
            self._table.refuse(
                row,
                f"{texts[j][row]} {units[j].name}, which is the reading "
                f"{size * q[row, j]:.6g} {shown}",
                f"one in the travel of leg '{leg.name}', {low:g} to {high:g} {shown}",
                next(text for text, name in self.taken.items() if name == self._joints[j]),
                remedy="correct the reading or the limits of the model",
                what="reading",
            )
        if inside.all() and not lengths:
            numbers, statement = self._table.numbers(self._joints), "state {} in the headings"
            for problem in doubtful_units(self.path, numbers, self.motors, units, statement):
                self._table.refuse_file(problem)
        self._table.check()
        digits = [min(int(Decimal(x).as_tuple().exponent) for x in column) for column in texts]
        last = [abs(unit.size) * 10.0**digit for digit, unit in zip(digits, units, strict=True)]
        return SheetReadings(q, np.array(last), units, unit_from, lengths)

    def _renamed_columns(self, lines: Lines) -> Lines:
        """Return the lines with columns renamed to our names; unknown columns are left out."""
        number, header = lines[0]
        if sum(is_number(text) and not text.isdecimal() for text in header) > 1:
            raise DatasetError(
                f"{self.path}: the readings could not be found: found numbers in the first line, "
                f"needed headings that name the legs ({self.motors[0].name}) or number them (L1, "
                "q1, 1); add a first line of headings."
            )
        split = [split_heading(text) for text in header]
        known = (*LENGTH, *READING_ANGLES)
        readings = [split_heading(x.replace("°", "deg"), known, others=True) for x in header]
        meaning: dict[int, str] = {}
        clock: dict[int, float] = {}  # seconds in a unit of a column of times
        for i in sorted(range(len(header)), key=lambda i: _is_vague(header[i])):
            key = split[i][0]
            for name in _COLUMNS:
                timed = _TIME.fullmatch(key) if name == "time" else None
                if (_means(header[i]) == name or timed) and name not in meaning.values():
                    meaning[i] = name
                if timed and meaning.get(i) == name:
                    clock = {i: _SECONDS[timed[1]]}
        free = [i for i in range(len(header)) if i not in meaning]
        meaning |= self._joints_of_columns(free, readings, header)
        for i, name in meaning.items():
            self.taken[header[i]] = name
            if name in self._joints:
                self._heading_units[name] = unit = readings[i][1] or _foreign(readings[i][0])
                if unit and not _is_known(unit):
                    raise DatasetError(
                        f"{self.path}, header: the unit of {describe(header[i])} could not be "
                        f"used: found '{unit}', needed one of {', '.join(known)}, or counts with "
                        "their scale (80 counts/mm); convert the readings, or leave the unit out "
                        "of the heading if it is none."
                    )
        unused = [text for i, text in enumerate(header) if i not in meaning and text]
        if unused:
            is_single = len(unused) == 1
            self.notes.append(
                f"Column{'' if is_single else 's'} {few([describe(text) for text in unused])} of "
                f"{self.path} {'is' if is_single else 'are'} not used."
            )
        kept = sorted(meaning)
        below = [
            (line, [_dated(cells[i], clock.get(i)) for i in kept])
            if len(cells) == len(header)
            else (line, cells)
            for line, cells in lines[1:]
        ]
        return [(number, [meaning[i] for i in kept]), *below]

    def _joints_of_columns(
        self, free: Sequence[int], split: Sequence[tuple[str, str]], header: Sequence[str]
    ) -> dict[int, str]:
        """Return the joint of each column of readings, by names or else by numbers."""
        joint_of_column: dict[int, str] = {}
        for joint, leg in zip(self._joints, self.motors, strict=True):
            words = {split_heading(joint)[0], split_heading(leg.name)[0]}
            columns_of_leg = [i for i in free if any(_names(split[i][0], word) for word in words)]
            if len(columns_of_leg) > 1:
                raise DatasetError(
                    f"{self.path}, header: the readings of leg '{leg.name}' could not be decided: "
                    "found the columns "
                    f"{' and '.join(describe(header[i]) for i in columns_of_leg)}, needed one; "
                    "remove the others."
                )
            joint_of_column |= dict.fromkeys(columns_of_leg, joint)
        if len(joint_of_column) == len(self._joints):
            return joint_of_column
        numbered = {i: m for i in free if (m := _NUMBERED.fullmatch(split[i][0]))}
        families: dict[tuple[str, str], dict[int, int]] = {}
        for i, m in numbered.items():
            families.setdefault((m[1], m[3]), {})[int(m[2])] = i
        n = len(self._joints)
        fits = [
            [by_number[k] for k in sorted(by_number)]
            for by_number in families.values()
            if sorted(by_number) in (list(range(1, n + 1)), list(range(n)))
        ]
        if len(fits) == 1:
            return dict(zip(fits[0], self._joints, strict=True))
        missing = [leg.name for leg, joint in zip(self.motors, self._joints, strict=True)
                   if joint not in joint_of_column.values()]  # fmt: skip
        columns = few([describe(header[i]) for i in free]) or "none"
        raise DatasetError(
            f"{self.path}, header: the readings of {few(missing)} could not be found: found the "
            f"columns {columns}, needed one for each of the {n} legs with an encoder, named after "
            f"the leg ({self.motors[0].name}), its joint ({self._joints[0]}) or its number "
            "(L1, q1, 1); rename the columns."
        )

    def _units(
        self, option: str | None, lengths: bool
    ) -> tuple[tuple[ReadingUnit, ...], str, bool]:
        """Return the unit of each motor, the origin of the units, whether they are of lengths."""
        self._refuse_options(option, lengths)
        unit_of_motor, origins = dict[int, ReadingUnit](), list[str]()
        for turning in (False, True):
            some = [j for j, leg in enumerate(self.motors) if leg.reads_angle is turning]
            if not some:
                continue
            legs, joints = [self.motors[j] for j in some], [self._joints[j] for j in some]
            stated = {unit for x in joints if (unit := self._heading_units.get(x, ""))}
            of_kind = _MotorsOfKind(
                self.path, legs, joints, self._table.numbers(joints), sorted(stated), lengths
            )
            is_of_kind = option is not None and is_length(option) is not turning
            meaning, origin = of_kind.meaning(option if is_of_kind else None)
            unit_of_motor |= dict(zip(some, meaning.units, strict=True))
            origins.append(origin)
            lengths = lengths or meaning.are_lengths
        units = tuple(unit_of_motor[j] for j in range(len(self.motors)))
        return units, " and ".join(dict.fromkeys(origins)), lengths

    def _refuse_options(self, option: str | None, lengths: bool) -> None:
        """Refuse a unit that no motor has, and lengths of legs that have none."""
        unit_names = [*LENGTH, *READING_ANGLES]
        if option is not None and not _is_known(option):
            raise UsageError(
                f"The unit could not be used: found '{option}', needed one of "
                f"{', '.join(unit_names)}; correct --unit."
            )
        if option is not None and not any(
            leg.reads_angle is not is_length(option) for leg in self.motors
        ):
            does = "slides" if is_length(option) else "turns"
            raise UsageError(
                f"The unit could not be used: found '{option}' and no motor that {does}, needed "
                f"one of {', '.join(READING_ANGLES if is_length(option) else LENGTH)}; correct "
                "--unit."
            )
        if lengths and any(leg.actuator is not None for leg in self.motors):
            raise UsageError(
                "The table could not be read: found --lengths and motors that move joints at A, "
                "needed readings of these; leave out --lengths."
            )


def _names(key: str, word: str) -> bool:
    """Return whether a heading names a leg or its motor by a word, alone or as in tower A."""
    before = key.removesuffix(word)
    return key == word or (before != key and concepts(before) in (("leg",), ("rail",)))


def _means(heading: str) -> str:
    """Return which of the columns beside readings a heading speaks of, "" if none."""
    what = set(concepts(heading)) - {"name", "number"}
    if split_heading(heading)[0] == "name":
        return "image"
    if what == {"view", "pose"}:  # camera position
        return "view"
    return next((name for name in _COLUMNS if what == {name}), "")


def _is_vague(heading: str) -> bool:
    """Return whether a heading counts only where no other says the same: name, photo nr."""
    found = set(concepts(heading))
    return found == {"name"} or "number" in found


def _is_known(unit: str) -> bool:
    """Return whether readings may have a unit."""
    return unit == PULSES or is_length(unit) or unit_size(unit, ANGLE) is not None


def _foreign(key: str) -> str:
    """Return the unit at the end of a heading that readings cannot have, "" if none is there."""
    end = _NUMBERED.fullmatch(key)
    return end[3] if end is not None and end[3] in _FOREIGN else ""


def _dated(cell: str, size: float | None) -> str:
    """Return a number of seconds, or of a part *size* of them, as a date; other cells unchanged."""
    if size is None:
        return cell
    try:
        return datetime.fromtimestamp(float(cell) * size, UTC).replace(tzinfo=None).isoformat()
    except (ValueError, OverflowError, OSError):
        return cell


@dataclass(frozen=True, eq=False)
class _MotorsOfKind:
    """The motors of a sheet that all slide, or all turn: their readings have one unit."""

    path: Path
    legs: list[Leg]
    joints: list[str]
    values: Array  # (n_rows, n_legs) as written
    stated: list[str]  # the units that their headings state
    lengths: bool  # whether the values are taken for whole lengths of legs

    @property
    def turning(self) -> bool:
        """Whether they turn."""
        return self.legs[0].reads_angle

    @cached_property
    def possible(self) -> list[Meaning]:
        """What the values may be: readings, or lengths of struts, in any unit."""
        return meanings(self.values, self.legs, READING_ANGLES if self.turning else [*LENGTH])

    @property
    def units(self) -> list[str]:
        """The units that their readings can have."""
        return list(dict.fromkeys(meaning.unit for meaning in self.possible))

    def fits(self, meaning: Meaning, *, moving: bool = True) -> bool:
        """Return whether most values lie in the travel and, if *moving*, use a part of it."""
        moves = not moving or np.any(meaning.used(self.legs) > LEAST_USED)
        return bool(moves and 2 * in_travel(meaning.q, self.legs).mean() >= 1.0)

    def meaning(self, option: str | None) -> tuple[Meaning, str]:
        """Return what the values are, and where the unit is from in words.

        It is stated by an option or the headings, else the one in which they lie in the travel.
        """
        stated = self._stated_unit(option)
        origin = "as the heading says" if self.stated else "as given"
        if stated is None:
            origin = "the unit in which the readings lie in the travel of the legs"
        tried = [stated] if stated else GUESSED[self.turning]
        named = [m for m in meanings(self.values, self.legs, tried)
                 if m.are_lengths is self.lengths]  # fmt: skip
        fitting = [m for m in named if self.fits(m)]
        if not fitting and not self.lengths:
            whole = [m for m in meanings(self.values, self.legs, tried) if m.are_lengths]
            if fitting := list(filter(self.fits, whole)):
                origin += ", whole lengths of legs, as no reading is in the travel"
        if not fitting:
            self._refuse_other(named)
            fitting = [m for m in named if self.fits(m, moving=False)]
        if fitting:
            return fitting[0], origin
        has_pulses = PULSES in self.units
        raise DatasetError(
            f"{self._start}, needed {_needed(self.legs[0], has_pulses=has_pulses)}; correct the "
            "travel of the model, or the table."
        )

    def _stated_unit(self, option: str | None) -> str | None:
        """Return the unit stated in headings or the option, if any; refuse an impossible unit."""
        if len(self.stated) > 1 or (option and self.stated and self.stated != [option]):
            raise DatasetError(
                f"{self.path}: the unit could not be decided: found "
                f"{' and '.join(dict.fromkeys([*([option] if option else []), *self.stated]))}, "
                "needed the same for all readings; correct the headings."
            )
        unit = self.stated[0] if self.stated else option
        if unit is not None and is_length(unit) is self.turning and unit != PULSES:
            does = "turns" if self.turning else "slides"
            raise DatasetError(
                f"{self.path}: the unit could not be used: found {unit} of '{self.joints[0]}', "
                f"which {does}, needed one of {', '.join(self.units)}; correct the heading."
            )
        if unit == PULSES and PULSES not in self.units:
            raise DatasetError(
                f"{self.path}: the readings could not be used: found pulses of servos of which "
                "neither centre nor us for one degree is known, needed both; write centre_us and "
                f"us_per_deg of '{self.joints[0]}' and the others into legcal.motors of the model."
            )
        return unit

    @property
    def _start(self) -> str:
        """The beginning of a refusal, with the range of the values."""
        low, high = float(self.values.min()), float(self.values.max())
        quantity = "lengths of legs" if self.lengths else "readings"
        return f"{self.path}: the {quantity} could not be used: found {low:g} to {high:g}"

    def _refuse_other(self, tried: Sequence[Meaning]) -> None:
        """Refuse values that fit in a unit outside *tried*, or as lengths instead of readings."""
        units = [meaning.unit for meaning in tried]
        others = [m for m in self.possible if m.unit not in units or m.are_lengths != self.lengths]
        others.sort(key=lambda m: (m.unit not in units, m.are_lengths is not self.lengths))
        for other in filter(self.fits, others):
            remedies = []
            if other.are_lengths is not self.lengths:
                remedies.append("leave out --lengths" if self.lengths else "add --lengths")
            if other.unit not in units:
                remedies.append(f"state the unit {other.unit} in the headings")
            raise DatasetError(
                f"{self._start}, which look like "
                f"{'lengths of legs' if other.are_lengths else 'readings'} in {other.unit}; "
                f"{' and '.join(remedies)}."
            )


def _needed(leg: Leg, *, has_pulses: bool) -> str:
    """Return the ranges for readings of a leg, in words."""
    if leg.reads_angle:
        low, high = (math.degrees(x) for x in leg.travel)
        servo = "" if has_pulses else ", or pulses of servos that legcal.motors of it describes"
        return (
            f"readings in the travel of the model ({low:g} to {high:g} deg for motor "
            f"'{leg.prismatic}'){servo}"
        )
    travel = f"{1e3 * leg.travel[0]:g} to {1e3 * leg.travel[1]:g} mm for leg '{leg.name}'"
    if leg.actuator is not None:
        return f"readings in the travel of the model ({travel})"
    lengths = [1e3 * leg.length_at(q) for q in leg.travel]
    return (
        f"readings in the travel of the model ({travel}) or lengths ({min(lengths):g} to "
        f"{max(lengths):g} mm, with --lengths)"
    )
