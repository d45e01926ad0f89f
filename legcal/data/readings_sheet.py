"""A table of readings as its owner keeps it: headings, units, readings or whole lengths.

Columns are identified by their headings: an encoder by the name of its leg or joint, or by a
number. The unit comes from the headings, else it is the one in which the readings lie in the travel
of the legs.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import numpy as np

from legcal.data.measurements import readings_in
from legcal.data.reading_units import (
    NEEDED_UNIT,
    PULSES,
    UNITS,
    Meaning,
    ReadingUnit,
    default_unit,
    in_travel,
    is_known,
    meanings,
    takes_unit,
    unit_named,
)
from legcal.errors import DatasetError, Problem, UsageError
from legcal.files.quantity import ANGLE, LENGTH, SHOWN_IN
from legcal.files.schema import describe, few
from legcal.files.table import (
    WORDS,
    Column,
    Lines,
    concepts,
    in_unit,
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
_DECIMALS = 14  # of readings in metres and radians
# Seconds in a unit of times; with a decimal, since 1200 may be a time of the day, 1200.0 is not
_SECONDS = {"s": "1.0", "sec": "1.0", "seconds": "1.0", "ms": "1.0e-3", "us": "1.0e-6",
            "µs": "1.0e-6", "ns": "1.0e-9"}  # fmt: skip
_COLUMNS = ("view", "image", "pose", "time")
_TIME = re.compile(rf"(?:{WORDS['time'].replace(' ', '|')}|t)({'|'.join(_SECONDS)})")
_NUMBERED = re.compile(r"([^\W\d]*?)0*(\d{1,3})([^\W\d]*)")
# Units at the end of a heading without brackets that would else be part of a name
_FOREIGN = {
    *("feet", "foot", "dm", "mil", "mils", "yd"),
    *("counts", "steps", "ticks", "turns", "grad", "gon", "arcmin", "arcsec"),
}


@dataclass(frozen=True, eq=False)
class SheetReadings:
    """The readings of a sheet, and the units in which they are written there."""

    joints: tuple[str, ...]  # of the motors whose readings are known
    q: Array  # (n_rows, n_motors) [m or rad]
    digits: Array  # (n_motors,) the size of the last digit [m or rad]
    units: tuple[ReadingUnit, ...]  # of each motor
    unit_from: str  # origin of the units, in words
    are_lengths: bool  # whether they are written as whole lengths of legs
    notes: tuple[str, ...]  # on odd ones

    @property
    def unit(self) -> str:
        """The units in words, each once."""
        return " and ".join(dict.fromkeys(unit.name for unit in self.units))


class ReadingsSheet:
    """A table of readings, one row for each photograph or time (*row_noun*).

    The rows of its *table* are under our names: view, image, pose and time as texts, readings by
    joint.
    """

    def __init__(
        self,
        path: Path,
        machine: Machine,
        row_noun: str,
        *,
        may_be_unknown: bool = False,  # readings of motors that do not move joints at the base
        others: Sequence[Column] = (),  # further columns, of lengths in m and angles in rad
        unknown: Callable[[str], Problem | None] = lambda name: None,
    ) -> None:
        self.path = path
        self.motors = [machine.legs[j] for j in machine.motors]  # whose readings it holds
        self.taken: dict[str, str] = {}  # a joint, view, image, pose or time, by heading in use
        self.notes: list[str] = []  # oddities, and columns that were left out
        self._joints = machine.motor_names
        self._heading_units: dict[str, str] = {}  # by joint
        self._others = {split_heading(column.name)[0]: column.name for column in others}
        columns = [*others, *(Column(name, "text", required=False) for name in _COLUMNS)]
        of_leg = zip(self._joints, self.motors, strict=True)
        columns += [
            Column(joint, what="reading", blank=may_be_unknown and leg.actuator is None)
            for joint, leg in of_leg
        ]
        self.table = read_table(
            path,
            "table of readings",
            "row",
            columns,
            needed=f"one row for each {row_noun}; write them",
            unknown=unknown,
            reshape=self._renamed_columns,
        )
        self.table.headings = {name: text for text, name in self.taken.items()}
        self.unknown = [joint for joint in self._joints if not any(self.table.text(joint))]
        self._joints = tuple(x for x in self._joints if x not in self.unknown)
        self.motors = [leg for leg in self.motors if str(leg.prismatic) not in self.unknown]
        if may_be_unknown:
            self.table.need(self._joints, np.ones(len(self.table), dtype=np.bool_))
        self.table.check()

    def readings(
        self, unit: str | None = None, *, lengths: bool = False, in_si: bool = False
    ) -> SheetReadings:
        """Return the readings [m, rad], with the precision of their decimal digits.

        A *unit* is that of the motors of its kind, sliding or turning; by default it is the unit of
        the headings, else m and rad if *in_si*, else the one in which readings lie in the travel.
        The columns are whole *lengths* of legs also if nothing else fits.
        """
        units, unit_from, lengths = self._units(unit, lengths, in_si)
        q, notes = readings_in(self.table, self.motors, units, place="headings", lengths=lengths)
        self.table.check()
        last = [
            abs(units[joint].size)
            * 10.0 ** min(int(Decimal(x).as_tuple().exponent) for x in self.table.text(joint))
            for joint in self._joints
        ]
        q = np.round(q, _DECIMALS) + 0.0  # as decimal as they were written
        in_order = tuple(units[joint] for joint in self._joints)
        return SheetReadings(self._joints, q, np.array(last), in_order, unit_from, lengths, notes)

    def _renamed_columns(self, lines: Lines) -> Lines:
        """Return the lines with columns renamed to our names.

        Unknown columns are left out, or kept to be refused where the sheet has others.
        """
        number, header = lines[0]
        if sum(is_number(text) and not text.isdecimal() for text in header) > 1:
            raise DatasetError(
                f"{self.path}: the readings could not be found: found numbers in the first line, "
                f"needed headings that name the legs ({self.motors[0].name}) or number them (L1, "
                "q1, 1); add a first line of headings."
            )
        split = [split_heading(text) for text in header]
        known = (*UNITS[False], *UNITS[True])
        readings = [split_heading(x.replace("°", "deg"), known, others=True) for x in header]
        meaning: dict[int, str] = {}
        sizes: dict[int, Decimal] = {}  # of the units of columns of times and of others
        for i, text in enumerate(header):
            key, unit = split_heading(text, (*LENGTH, *ANGLE))
            what = "".join(set(concepts(text)) - {"tool", "joint", "pose"})
            if name := self._others.get(what, self._others.get(key, "")):
                meaning[i] = name
                sizes |= {i: Decimal(repr({**LENGTH, **ANGLE}[unit]))} if unit else {}
        left = [i for i in range(len(header)) if i not in meaning]
        for i in sorted(left, key=lambda i: _is_vague(header[i])):
            key = split[i][0]
            for name in _COLUMNS:
                timed = _TIME.fullmatch(key) if name == "time" else None
                if (_means(header[i]) == name or timed) and name not in meaning.values():
                    meaning[i] = name
                if timed and meaning.get(i) == name:
                    sizes[i] = Decimal(_SECONDS[timed[1]])
        free = [i for i in range(len(header)) if i not in meaning]
        meaning |= self._joints_of_columns(free, readings, header)
        if self._others:
            meaning = {i: text.lower() for i, text in enumerate(header)} | meaning
        for i, name in meaning.items():
            self.taken[header[i]] = name
            if name in self._joints:
                self._heading_units[name] = unit = readings[i][1] or _foreign(readings[i][0])
                if unit and not is_known(unit):
                    raise DatasetError(
                        f"{self.path}, header: the unit of {describe(header[i])} could not be "
                        f"used: found '{unit}', needed {NEEDED_UNIT}; convert the readings, or "
                        "leave the unit out of the heading if it is none."
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
            (line, [in_unit(cells[i], sizes[i]) if i in sizes else cells[i] for i in kept])
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
        own_names = {i: _own_names(split[i][0]) for i in free}
        for joint, leg in zip(self._joints, self.motors, strict=True):
            words = {split_heading(joint)[0], split_heading(leg.name)[0]}
            of_motor = {x for word in words for x in _own_names(word) if not x.isdecimal()}
            columns_of_leg = [i for i in free if words & {split[i][0], *own_names[i]}] or [
                i
                for i in free
                if of_motor & own_names[i]  # Turm X of tower_x
            ]
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
        missing = [leg.motor_label for leg, joint in zip(self.motors, self._joints, strict=True)
                   if joint not in joint_of_column.values()]  # fmt: skip
        columns = few([describe(header[i]) for i in free]) or "none"
        remedy = "rename the columns"
        if {split[i][0] for i in free} >= {"x", "y", "z"}:
            remedy = "where the tool stands is no reading: note where each motor stands"
        raise DatasetError(
            f"{self.path}, header: the readings of {few(missing)} could not be found: found the "
            f"columns {columns}, needed one for each of the {n} legs with an encoder, named after "
            f"the leg ({self.motors[0].name}), its joint ({self._joints[0]}) or its number "
            f"(L1, q1, 1); {remedy}."
        )

    def _units(
        self, option: str | None, lengths: bool, in_si: bool
    ) -> tuple[dict[str, ReadingUnit], str, bool]:
        """Return the unit of each motor, the origin of the units, whether they are of lengths."""
        if (
            option is not None
            and not any(takes_unit(option, turns=leg.reads_angle) for leg in self.motors)
            and self.motors
        ):
            needed = dict.fromkeys(unit for leg in self.motors for unit in UNITS[leg.reads_angle])
            does = "slides" if takes_unit(option, turns=False) else "turns"
            raise UsageError(
                f"The unit could not be used: found '{option}'"
                f"{f' and no motor that {does}' * is_known(option)}, needed one of "
                f"{', '.join(needed)}; correct --unit."
            )
        if lengths and any(leg.actuator is not None for leg in self.motors):
            raise UsageError(
                "The table could not be read: found --lengths and motors that move joints at A, "
                "needed readings of these; leave out --lengths."
            )
        units, origins = dict[str, ReadingUnit](), list[str]()
        for turns in UNITS:
            legs = [leg for leg in self.motors if leg.reads_angle is turns]
            if not legs:
                continue
            joints = [str(leg.prismatic) for leg in legs]
            stated = {self._heading_units.get(joint, "") for joint in joints} - {""}
            origin = "as the heading says" if stated else "as given"
            if option is not None and takes_unit(option, turns=turns):
                stated.add(option)
            if len(stated) > 1:
                raise DatasetError(
                    f"{self.path}: the unit could not be decided: found "
                    f"{' and '.join(sorted(stated))}, needed the same for all readings; correct "
                    "the headings."
                )
            if not stated and in_si:
                units |= dict(zip(joints, map(default_unit, legs), strict=True))
                origins.append("as joints of the model have it")
                continue
            if not stated:
                origin = "the unit in which the readings lie in the travel of the legs"
            meaning = self._meaning(legs, "".join(stated), lengths)
            if meaning.are_lengths and not lengths:
                origin += ", whole lengths of legs, as no reading is in the travel"
            units |= dict(zip(joints, meaning.units, strict=True))
            origins.append(origin)
            lengths = lengths or meaning.are_lengths
        return units, " and ".join(dict.fromkeys(origins)), lengths

    def _meaning(self, legs: Sequence[Leg], stated: str, lengths: bool) -> Meaning:
        """Return what the numbers of motors are that all slide or all turn: their unit is one.

        It is the stated unit, else the first of GUESSED in which most readings lie in the travel
        and use a part of it. If no reading does, whole lengths of legs may.
        """
        values = self.table.numbers(str(leg.prismatic) for leg in legs)
        turns, start = legs[0].reads_angle, f"{self.path}: the "
        if stated:
            try:
                for leg in legs:
                    unit_named(stated, leg)
            except ValueError as error:
                raise DatasetError(f"{start}unit could not be used: {error}") from error
        tried = [stated] if stated else GUESSED[turns]
        possible = meanings(values, legs, list(dict.fromkeys([*tried, *UNITS[turns]])))
        in_units = [m for m in possible if m.unit in tried]
        asked = [m for m in in_units if m.are_lengths is lengths]
        inside = [m for m in possible if 2 * in_travel(m.q, legs).mean() >= 1.0]
        moving = [m for m in inside if np.any(m.used(legs) > LEAST_USED)]
        for meaning in (*asked, *([] if lengths else in_units)):
            if meaning in moving:
                return meaning
        quantity = "lengths of legs" if lengths else "readings"
        start += f"{quantity} could not be used: found {values.min():g} to {values.max():g}"
        # Another unit, or lengths in place of readings: the one that needs fewest corrections
        moving.sort(key=lambda m: (m.unit not in tried, m.are_lengths is not lengths))
        for other in moving:
            remedies = [f"state the unit {other.unit} in the headings"] * (other.unit not in tried)
            if other.are_lengths is not lengths:
                remedies.insert(0, "leave out --lengths" if lengths else "add --lengths")
            raise DatasetError(
                f"{start}, which look like "
                f"{'lengths of legs' if other.are_lengths else 'readings'} in {other.unit}; "
                f"{' and '.join(remedies)}."
            )
        for meaning in asked:
            if meaning in inside:
                return meaning
        has_pulses = any(m.unit == PULSES for m in possible)
        raise DatasetError(
            f"{start}, needed {_needed(legs[0], has_pulses=has_pulses)}; correct the travel of the "
            "model, or the table."
        )


def _own_names(word: str) -> set[str]:
    """Return what follows the word for a leg or a rail that a name begins with: A of tower A."""
    starts = (word[:end] for end in range(1, len(word)))
    return {word.removeprefix(one) for one in starts if concepts(one) in (("leg",), ("rail",))}


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


def _foreign(key: str) -> str:
    """Return the unit at the end of a heading that readings cannot have, "" if none is there."""
    end = _NUMBERED.fullmatch(key)
    return end[3] if end is not None and end[3] in _FOREIGN else ""


def _needed(leg: Leg, *, has_pulses: bool) -> str:
    """Return the ranges for readings of a leg, in words."""
    size, unit = SHOWN_IN[leg.reading_unit]
    low, high = (size * x for x in leg.travel)
    name = f"motor '{leg.prismatic}'" if leg.reads_angle else f"leg '{leg.name}'"
    needed = f"readings in the travel of the model ({low:g} to {high:g} {unit} for {name})"
    if leg.reads_angle and not has_pulses:
        needed += ", or pulses of servos that legcal.motors of it describes"
    if leg.actuator is None:
        least, most = sorted(1e3 * leg.length_at(q) for q in leg.travel)
        needed += f" or lengths ({least:g} to {most:g} mm, with --lengths)"
    return needed
