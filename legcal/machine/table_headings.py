"""Tables of joints under the headings that people write, as one row for each leg.

Three layouts are understood: a row for each leg (``bx by bz px py pz``, ``base_x``, ``x_base``), a
row with all joints (``B1x``), and a row for each joint (``B1, x, y, z``). A and B are base and
platform where both are there, as in the paper; otherwise B is the base and P, or T, the platform.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from legcal.errors import DatasetError
from legcal.files import Lines, describe, split_heading

UNITS = {"m": 0, "mm": -3}  # powers of ten
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
_POINT = ("point", "joint", "name", "id", "label")
_WORDS = "|".join(sorted([*SIDES["base"], *SIDES["platform"], "b"], key=len, reverse=True))
_COORDINATE = re.compile(rf"({_WORDS})(?:joints?|points?)?(\d*)([xyz])(\d*)")
_COORDINATE_FIRST = re.compile(rf"([xyz])({_WORDS})(\d*)")
_NAMED = re.compile(rf"({_WORDS})(?:joints?|points?)?0*(\d{{1,3}})")


def one_row_a_leg(lines: Lines, names: Sequence[str], path: object) -> Lines:
    """Return a table with a row for each leg under the names of its columns.

    ``names`` are those of the columns. Headings that mean nothing stay as they are, in small
    letters, and a column ``unit`` is added where headings of joints have one.
    """
    number, header = lines[0]
    split = [split_heading(text) for text in header]
    keys = [key for key, _ in split]
    units = sorted({unit for _, unit in split if unit})
    if len(units) > 1 or (units and units[0] not in UNITS):
        raise DatasetError(
            f"{path}, header: the unit could not be decided: found {' and '.join(units)}, needed m "
            "or mm for all lengths; correct the headings."
        )
    if {"x", "y"} <= set(keys) and any(key in _POINT for key in keys):
        lines = _from_points(lines, keys, path)
        keys = [split_heading(text)[0] for text in lines[0][1]]
    found = [_coordinate(key) for key in keys]
    sides = _sides(side for side, *_ in filter(None, found))
    if any(one is not None and one[1] for one in found):
        lines = _from_one_row(lines, found, sides, path)
        header = lines[0][1]
    else:
        plain = {split_heading(name)[0]: name for name in names}
        plain |= {word: name for name, words in _OTHER.items() for word in words}
        header = [
            f"{sides[one[0]]}_{one[2]}" if one else plain.get(key, text.lower())
            for one, key, text in zip(found, keys, lines[0][1], strict=True)
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


def _coordinate(key: str) -> tuple[str, str, str] | None:
    """Return side, number ("" without) and coordinate of the heading of a joint."""
    if match := _COORDINATE.fullmatch(key):
        return None if match[2] and match[4] else (match[1], match[2] or match[4], match[3])
    if match := _COORDINATE_FIRST.fullmatch(key):
        return match[2], match[3], match[1]
    return None


def _sides(words: Iterable[str]) -> dict[str, str]:
    """Return which side each word means: B is the platform beside A."""
    side_of = {word: side for side, all_words in SIDES.items() for word in all_words}
    return side_of | {"b": "platform" if "a" in set(words) else "base"}


def _from_one_row(
    lines: Lines,
    found: Sequence[tuple[str, str, str] | None],
    sides: dict[str, str],
    path: object,
) -> Lines:
    """Return a row for each leg of a table with all joints in one row."""
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
    for one, text, cell in zip(found, header, cells, strict=True):
        if one is not None and one[1]:
            joints.setdefault(int(one[1]), {})[f"{sides[one[0]]}_{one[2]}"] = cell
        else:
            others[text.lower()] = cell
    return _rows(joints, others, (number, rows[0][0]))


def _from_points(lines: Lines, keys: Sequence[str], path: object) -> Lines:
    """Return a row for each leg of a table with a row for each joint."""
    number, header = lines[0]
    at = next(i for i, key in enumerate(keys) if key in _POINT)
    axes = {key: i for i, key in enumerate(keys) if key in ("x", "y", "z")}
    named = [
        (line, cells, _NAMED.fullmatch(split_heading(cells[at])[0]))
        for line, cells in lines[1:]
        if len(cells) == len(header)
    ]
    if len(named) < len(lines) - 1 or not all(match for *_, match in named):
        wrong = next((cells[at] for _, cells, match in named if not match), "an incomplete row")
        raise DatasetError(
            f"{path}: the joints could not be read: found {describe(wrong)} in a table with a row "
            "for each joint, needed names of side and number such as B1 and P1, or base1 and "
            "platform1; correct it."
        )
    sides = _sides(match[1] for *_, match in named if match)
    joints: dict[int, dict[str, str]] = {}
    for _, cells, match in named:
        if match is None:
            continue
        leg = joints.setdefault(int(match[2]), {})
        for axis, i in axes.items():
            if leg.setdefault(f"{sides[match[1]]}_{axis}", cells[i]) is not cells[i]:
                raise DatasetError(
                    f"{path}: the joints could not be read: found {describe(cells[at])} twice, "
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
