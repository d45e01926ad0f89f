"""A CSV of joints as the mapping that the same table would be in YAML.

Common headings are understood, in three layouts: a row for each leg (``bx by bz px py pz``,
``base_x``, ``x_base``), a row with all joints (``B1x``), and a row for each joint (``B1, x, y, z``,
or side and number in two columns; headings are optional there). If both A and B occur they are base
and platform, as in the paper; otherwise B is the base and P, or T, the platform.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from legcal.errors import Code, DatasetError
from legcal.files.quantity import LENGTH
from legcal.files.schema import closest, describe
from legcal.files.table import (
    Column,
    Lines,
    Table,
    header_problem,
    is_number,
    read_table,
    split_heading,
)

FILE_KIND = "table"
MAX_NUMBER = 1e9  # largest number, in any unit
SIDES = {
    "base": ("base", "bottom", "fixed", "ground", "lower", "a"),
    "platform": ("platform", "plat", "top", "moving", "mobile", "upper", "effector", "p", "t"),
}
_OTHER = {
    "leg": ("leg", "name", "legname", "nr", "no", "number", "id"),
    "type": ("type", "legtype"),
    "unit": ("unit", "units"),
    "offset": ("offset", "q0", "l0", "lengthatzero", "zerolength"),
    "min_length": ("minlength", "lmin", "lengthmin", "minl", "shortest", "minimumlength"),
    "max_length": ("maxlength", "lmax", "lengthmax", "maxl", "longest", "maximumlength"),
    "travel_low": ("travellow", "travelmin", "qmin", "mintravel", "lowestreading"),
    "travel_high": ("travelhigh", "travelmax", "qmax", "maxtravel", "highestreading"),
    "radius": ("radius", "legradius"),
    "tube": ("tube", "tuberadius"),
    "rod": ("rod", "rodradius"),
}
_NOT_LENGTHS = ("deg", "us", "-")  # units of other columns
_POINT = ("point", "joint", "name", "id", "label")
_WORDS = "|".join(sorted([*SIDES["base"], *SIDES["platform"], "b"], key=len, reverse=True))
_COORDINATE = re.compile(rf"({_WORDS})(?:joints?|points?)?(\d*)([xyz])(\d*)")
_COORDINATE_FIRST = re.compile(rf"([xyz])({_WORDS})(\d*)")
_NAMED = re.compile(rf"({_WORDS})(?:joints?|points?|legs?)?0*(\d{{1,3}})")
_XYZ = ("x", "y", "z")
MOTIONS = ("direction", "point", "axis")  # columns of the motor that carries a rod
_RADII = ("radius", "tube", "rod")
_AT_HOME = {"home_reading": "home_readings", "home_reading_deg": "home_readings_deg"}
_POINTS = tuple(f"{side}_{i}" for side in ("base", "platform") for i in _XYZ)
_NUMBERS = (
    *("offset", "length", "min_length", "max_length", "travel_low", "travel_high"),
    *_RADII,
    *(f"{side}_axis_{i}" for side in ("base", "platform") for i in _XYZ),
    *(f"{vector}_{i}" for vector in ("direction", "point", "axis") for i in _XYZ),
    *(f"{travel}_{end}" for travel in ("travel_deg", "travel_us") for end in ("low", "high")),
    *("centre_us", "us_per_deg", "arm_radius", "home_reading", "home_reading_deg"),
)
COLUMNS = (
    *(
        Column(name, "text", required=False)
        for name in ("leg", "type", "kind", "unit", "hangs_on", "platform_in")
    ),
    *(
        Column(
            name,
            least=-MAX_NUMBER,
            most=MAX_NUMBER,
            needed=f"a number below {MAX_NUMBER:g}",
            remedy="correct the cell",
            required=name in _POINTS and not name.endswith("z"),
            blank=name not in _POINTS or name.endswith("z"),
        )
        for name in (*_POINTS, *_NUMBERS)
    ),
)


def read_columns(path: Path, unit: str | None) -> dict[str, Any]:
    """Return a CSV as the mapping that the same table would be in YAML.

    ``unit`` is the unit of lengths if no column states it. Raises DatasetError with one sentence
    for each wrong column or cell.
    """
    names = [column.name for column in COLUMNS]
    table = read_table(
        path,
        FILE_KIND,
        "leg",
        COLUMNS,
        needed="one row for each leg; add them",
        reshape=lambda lines: _one_row_a_leg(lines, names, path),
    )
    filled = [np.array([text != "" for text in table.text(name)], dtype=bool) for name in _RADII]
    for row in np.flatnonzero(filled[0] & (filled[1] | filled[2])).tolist():
        conflict, remedy = "radius beside tube or rod", "empty the others"
        table.refuse(row, conflict, "one of them", *_RADII, remedy=remedy, what="radius")
    table.check()
    cells = _Cells(table)
    hangs_on = cells.texts("hangs_on")
    motors = _motors(table, cells, hangs_on)
    document: dict[str, Any] = {
        "legcal_table": 1,
        "name": path.stem,
        "unit": _unit(table, unit),
        "platform_in": _shared(table, "platform_in"),
        "types": cells.texts("type") if "type" in table else None,
        "base_joints": cells.points("base"),
        "platform_joints": cells.points("platform"),
        # The travel of a leg carried by a motor is the travel of the motor.
        "travel": [
            travel if motor is None else None
            for travel, motor in zip(cells.pairs("travel"), hangs_on, strict=True)
        ],
        "radius": [
            {k: x for k, x in (("tube", tube), ("rod", rod)) if x is not None} or radius
            for radius, tube, rod in zip(*map(cells.numbers, _RADII), strict=True)
        ],
    }
    optional: dict[str, Any] = {
        "legs": cells.texts("leg"),
        "kinds": cells.texts("kind"),
        "offsets": cells.numbers("offset"),
        "lengths": cells.numbers("length"),
        "min_length": cells.numbers("min_length"),
        "max_length": cells.numbers("max_length"),
        "base_axes": cells.vectors("base_axis"),
        "platform_axes": cells.vectors("platform_axis"),
        "hangs_on": hangs_on,
    }
    document |= {key: of_legs for key, of_legs in optional.items() if any(map(_is_given, of_legs))}
    return document | motors


class _Cells:
    """The cells of a table by row; None if empty."""

    def __init__(self, table: Table) -> None:
        self._table = table

    def texts(self, name: str) -> list[Any]:
        return [text or None for text in self._table.text(name)]

    def numbers(self, name: str) -> list[Any]:
        return [None if math.isnan(x) else x for x in self._table.number(name).tolist()]

    def points(self, side: str) -> list[Any]:
        x, y, z = (self._table.number(f"{side}_{i}") for i in _XYZ)
        return np.column_stack([x, y, np.nan_to_num(z)]).tolist()  # type: ignore[no-any-return]

    def vectors(self, name: str) -> list[Any]:
        vectors = zip(*(self.numbers(f"{name}_{i}") for i in _XYZ), strict=True)
        return [None if vector == (None,) * 3 else list(vector) for vector in vectors]

    def pairs(self, name: str) -> list[Any]:
        pairs = zip(self.numbers(f"{name}_low"), self.numbers(f"{name}_high"), strict=True)
        return [None if pair == (None, None) else list(pair) for pair in pairs]


def _is_given(value: Any) -> bool:
    return value is not None


def _motors(table: Table, cells: _Cells, hangs_on: Sequence[str | None]) -> dict[str, Any]:
    """Return the motors that carry legs, and their readings at home.

    The numbers of a motor may be in any row of a leg that it carries, or in several.
    """
    columns = {
        **{key: cells.vectors(key) for key in MOTIONS},
        **{key: cells.pairs(key) for key in ("travel", "travel_deg", "travel_us")},
        **{key: cells.numbers(key) for key in ("centre_us", "us_per_deg", "arm_radius", *_AT_HOME)},
    }
    motors = dict[str, dict[str, Any]]()
    for row, motor in enumerate(hangs_on):
        if motor is None:
            continue
        entry = motors.setdefault(motor, dict.fromkeys(columns))
        for key, column in columns.items():
            value = column[row]
            if entry[key] is None:
                entry[key] = value
            elif value is not None and value != entry[key]:
                table.refuse(
                    row,
                    f"another {key}",
                    f"the same {key} in all rows of '{motor}'",
                    "hangs_on",
                    remedy="correct it, or leave it empty",
                    what="hangs_on",
                )
    table.check()
    if not motors:
        return {}
    actuators = {
        name: {k: x for k, x in entry.items() if x is not None and k not in _AT_HOME}
        for name, entry in motors.items()
    }
    readings = {
        key: {name: entry[column] for name, entry in motors.items() if entry[column] is not None}
        for column, key in _AT_HOME.items()
    }
    return {"actuators": actuators, **{key: stated for key, stated in readings.items() if stated}}


def _shared(table: Table, name: str) -> str | None:
    """Return the text of a column that is the same in all rows, None for an empty column."""
    stated = sorted(set(filter(None, table.text(name))))
    if len(stated) > 1:
        raise DatasetError(
            f"{table.path}: the {name} could not be decided: found {' and '.join(stated)}, needed "
            f"the same in all lines; correct the column '{name}'."
        )
    return stated[0] if stated else None


def _unit(table: Table, given: str | None) -> str:
    """Return the unit of the column, or the given one."""
    stated = _shared(table, "unit") or given
    if stated is None:
        raise DatasetError(
            f"{table.path}: the lengths could not be read: found no unit, needed one of "
            f"{', '.join(LENGTH)}; add a column 'unit', or give --unit mm."
        )
    return stated


def _one_row_a_leg(lines: Lines, names: Sequence[str], path: Path) -> Lines:
    """Return a table with a row for each leg under the names of its columns.

    ``names`` are the names of the columns. Unknown headings stay, in lower case, and a column
    ``unit`` is added if headings of joints state one.
    """
    lines = _with_headings(lines, path)
    number, header = lines[0]
    split = [split_heading(text, others=True) for text in header]
    keys = [key for key, _ in split]
    stated = {unit for (_, unit), text in zip(split, header, strict=True) if text not in names}
    units = sorted(stated - {"", *_NOT_LENGTHS})
    if len(units) > 1 or (units and units[0] not in LENGTH):
        raise DatasetError(
            f"{path}, header: the unit could not be decided: found {' and '.join(units)}, needed "
            f"one of {', '.join(LENGTH)} for all lengths; correct the headings."
        )
    if {"x", "y"} <= set(keys) and len(lines) > 1:
        lines = _from_points(lines, keys, path)
        keys = [split_heading(text)[0] for text in lines[0][1]]
    coordinates = [_coordinate(key) for key in keys]
    sides = _sides(side for side, *_ in filter(None, coordinates))
    if any(coordinate is not None and coordinate[1] for coordinate in coordinates):
        lines = _from_one_row(lines, coordinates, sides, path)
        header = lines[0][1]
    else:
        plain = {split_heading(name)[0]: name for name in names}
        plain |= {word: name for name, words in _OTHER.items() for word in words}
        header = [
            f"{sides[coordinate[0]]}_{coordinate[2]}"
            if coordinate
            else plain.get(key, text.lower())
            for coordinate, key, text in zip(coordinates, keys, lines[0][1], strict=True)
        ]
    below = lines[1:]
    if "leg" in header and all(
        len(cells) == len(header) and cells[header.index("leg")].isdigit() for _, cells in below
    ):
        at = header.index("leg")
        below = [
            (line, [f"leg{cell}" if i == at else cell for i, cell in enumerate(cells)])
            for line, cells in below
        ]
    if units and "unit" not in header:
        n, header = len(header), [*header, "unit"]
        below = [(line, [*cells, units[0]] if len(cells) == n else cells) for line, cells in below]
    return [(number, header), *below]


def _with_headings(lines: Lines, path: object) -> Lines:
    """Return lines with headings, which a list of named points may omit."""
    first = lines[0][1]
    if sum(is_number(text) for text in first) < 2:
        return lines
    if len(first) in (3, 4) and _NAMED.fullmatch(split_heading(first[0])[0]):
        return [(lines[0][0], ["point", *_XYZ[: len(first) - 1]]), *lines]
    raise DatasetError(
        f"{path}: the joints could not be read: found numbers in the first line, needed headings "
        "such as leg,base_x,base_y,base_z,platform_x,platform_y,platform_z, or names of the joints "
        "before their coordinates (B1,289.8,77.6,0 and P1,106.1,106.1,0); add them."
    )


def _coordinate(key: str) -> tuple[str, str, str] | None:
    """Return side, number ("" if none) and coordinate of the heading of a joint."""
    if match := _COORDINATE.fullmatch(key):
        return None if match[2] and match[4] else (match[1], match[2] or match[4], match[3])
    if match := _COORDINATE_FIRST.fullmatch(key):
        return match[2], match[3], match[1]
    return None


def _sides(words: Iterable[str]) -> dict[str, str]:
    """Return the side of each word; B is the platform if there is an A."""
    side_of = {word: side for side, all_words in SIDES.items() for word in all_words}
    return side_of | {"b": "platform" if "a" in set(words) else "base"}


def _from_one_row(
    lines: Lines,
    coordinates: Sequence[tuple[str, str, str] | None],
    sides: dict[str, str],
    path: object,
) -> Lines:
    """Return a row for each leg, from a table with all joints in one row."""
    (number, header), rows = lines[0], lines[1:]
    if len(rows) != 1 or any(len(cells) != len(header) for _, cells in rows):
        raise DatasetError(
            f"{path}: the joints could not be read: found {len(rows)} rows under headings that "
            f"number the legs ({describe(header[0])}), needed one complete row; write one row for "
            "each leg with base_x,base_y,base_z,platform_x,platform_y,platform_z."
        )
    cells = rows[0][1]
    joints: dict[int, dict[str, str]] = {}
    others = {}
    for coordinate, text, cell in zip(coordinates, header, cells, strict=True):
        if coordinate is not None and coordinate[1]:
            side, leg, letter = coordinate
            joints.setdefault(int(leg), {})[f"{sides[side]}_{letter}"] = cell
        else:
            others[text.lower()] = cell
    return _rows(joints, others, (number, rows[0][0]))


def _from_points(lines: Lines, keys: Sequence[str], path: Path) -> Lines:
    """Return a row for each leg, from a table with a row for each joint.

    A joint is named in one column, or in two: side and number of the leg.
    """
    number, header = lines[0]
    axes = {key: i for i, key in enumerate(keys) if key in _XYZ}
    of_name = [i for i, key in enumerate(keys) if key in _POINT] or [
        i for i, key in enumerate(keys) if key not in (*_XYZ, *_OTHER["unit"])
    ]
    known = {*axes.values(), *of_name[:2]}
    for i, (key, text) in enumerate(zip(keys, header, strict=True)):
        if i not in known and key not in _OTHER["unit"]:
            raise DatasetError(
                header_problem(
                    path,
                    f"the unknown column {describe(text)}",
                    "those of a table with a row for each joint",
                    closest(key, ["point", *_XYZ, "unit"]),
                    Code.UNKNOWN_COLUMN,
                )
            )
    named = []
    for _, cells in lines[1:]:
        if len(cells) != len(header):
            raise DatasetError(
                f"{path}: the joints could not be read: found a row of {len(cells)} cells, needed "
                f"{len(header)} as in the header; complete it."
            )
        words = [cells[i] for i in of_name[:2]]
        spelt = [
            "".join(split_heading(word)[0] for word in order) for order in (words, words[::-1])
        ]
        matches = [match for text in spelt if (match := _NAMED.fullmatch(text))]
        named.append((" ".join(words), cells, matches[0] if matches else None))
    wrong = [name for name, _, match in named if match is None]
    if wrong:
        stated = describe(wrong[0]) if wrong[0].strip() else "no name"
        raise DatasetError(
            f"{path}: the joints could not be read: found {stated} in a "
            "table with a row for each joint, needed names of side and number such as B1 and P1, "
            "or base1 and platform1; correct it."
        )
    sides = _sides(match[1] for *_, match in named if match)
    joints: dict[int, dict[str, str]] = {}
    for name, cells, match in named:
        if match is None:
            continue
        leg = joints.setdefault(int(match[2]), {})
        for axis, i in axes.items():
            if leg.setdefault(f"{sides[match[1]]}_{axis}", cells[i]) is not cells[i]:
                raise DatasetError(
                    f"{path}: the joints could not be read: found {describe(name)} twice, "
                    "needed each joint once; correct it."
                )
    return _rows(joints, {}, (number, lines[1][0]))


def _rows(joints: dict[int, dict[str, str]], others: dict[str, str], at: tuple[int, int]) -> Lines:
    """Return a header and a row for each leg, in the order of their numbers."""
    columns = list(dict.fromkeys(name for leg in joints.values() for name in leg))
    rows = [
        (at[1], [*(joints[k].get(name, "") for name in columns), *others.values()])
        for k in sorted(joints)
    ]
    return [(at[0], [*columns, *others]), *rows]
