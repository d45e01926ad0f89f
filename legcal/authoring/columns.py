"""The table of a machine in CSV: one row a leg, columns by name."""

import math
from pathlib import Path
from typing import Any

from legcal.authoring.table_schema import LARGEST
from legcal.errors import DatasetError
from legcal.files.csv_file import read_lines
from legcal.files.schema import closest

WHAT = "table"
_XYZ = ("x", "y", "z")
_NUMBERS = (
    *(f"base_{i}" for i in _XYZ), *(f"platform_{i}" for i in _XYZ),
    "offset", "length", "travel_low", "travel_high", "radius", "tube", "rod",
    *(f"base_axis_{i}" for i in _XYZ), *(f"platform_axis_{i}" for i in _XYZ),
)  # fmt: skip
_TEXTS = ("leg", "type", "kind", "unit")
_NEEDED = ("type", "base_x", "base_y", "platform_x", "platform_y")


def read_columns(path: Path, unit: str | None) -> dict[str, Any]:
    """Return a CSV as the mapping that the same table would be in YAML.

    Parameters
    ----------
    path : Path
        The file.
    unit : {"m", "mm"} or None
        The unit of its lengths, unless a column states it.

    Raises
    ------
    DatasetError
        With one sentence for each wrong column or cell.
    """
    lines = read_lines(path, WHAT)
    if len(lines) < 2:
        raise DatasetError(
            f"{path}: the table could not be read: found {len(lines)} lines, needed a header and "
            "one line for each leg; add them."
        )
    header = [name.lower() for name in lines[0][1]]
    _check_header(header, path)
    problems, rows = list[str](), list[dict[str, Any]]()
    for number, cells in lines[1:]:
        if len(cells) != len(header):
            problems.append(
                f"{path}, line {number}: the leg could not be read: found {len(cells)} cells, "
                f"needed {len(header)}; correct the line."
            )
            continue
        row = dict(zip(header, cells, strict=True))
        if row.get("radius") and (row.get("tube") or row.get("rod")):
            problems.append(
                f"{path}, line {number}: the radius could not be decided: found radius beside tube "
                "or rod, needed one of them; empty the others."
            )
        rows.append({key: _cell(key, text, path, number, problems) for key, text in row.items()})
    if problems:
        raise DatasetError(problems)
    return _as_yaml(rows, path, _unit(rows, unit, path))


def _check_header(header: list[str], path: Path) -> None:
    """Refuse columns that are unknown, repeated or missing."""
    other = next((mark for mark in ";\t" if len(header) == 1 and mark in header[0]), None)
    if other is not None:
        mark = "';'" if other == ";" else "tabs"
        raise DatasetError(
            f"{path}: the table could not be read: found {mark} between the columns, needed ',' "
            "there and '.' in numbers; save it again as comma-separated text."
        )
    known = (*_TEXTS, *_NUMBERS)
    problems = [
        f"{path}: the column '{name}' could not be used: found an unknown name; "
        f"{closest(name, known)}"
        for name in header
        if name not in known
    ]
    problems += [
        f"{path}: the column '{name}' could not be used: found it twice, needed it once; drop one."
        for name in sorted({name for name in header if header.count(name) > 1})
    ]
    problems += [
        f"{path}: the table could not be read: found no column '{name}', needed it; add it."
        for name in _NEEDED
        if name not in header
    ]
    if problems:
        raise DatasetError(problems)


def _cell(key: str, text: str, path: Path, line: int, problems: list[str]) -> str | float | None:
    """Return the value of a cell; an empty one has none, if it need not."""
    if key in _TEXTS or (not text and key not in _NEEDED):
        return text or None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) < LARGEST:
        found = f"'{text}'" if text else "nothing"
        problems.append(
            f"{path}, line {line}: {key} could not be read: found {found}, needed a number below "
            f"{LARGEST:g}; correct the cell."
        )
    return value


def _unit(rows: list[dict[str, Any]], told: str | None, path: Path) -> str:
    """Return the unit that the column states, or the one that was told."""
    stated = {str(row["unit"]) for row in rows if row.get("unit")}
    if len(stated) > 1:
        raise DatasetError(
            f"{path}: the unit could not be decided: found {' and '.join(sorted(stated))}, needed "
            "the same in all lines; correct the column 'unit'."
        )
    if not stated and told is None:
        raise DatasetError(
            f"{path}: the lengths could not be understood: found no unit, needed m or mm; add a "
            "column 'unit', or give --unit mm."
        )
    return stated.pop() if stated else str(told)


def _as_yaml(rows: list[dict[str, Any]], path: Path, unit: str) -> dict[str, Any]:
    """Return rows as the keys of the YAML table."""

    def column(key: str) -> list[Any]:
        return [row.get(key) for row in rows]

    def vectors(key: str) -> list[Any]:
        found = [[row.get(f"{key}_{i}") for i in _XYZ] for row in rows]
        if "axis" not in key:
            return [[x, y, 0.0 if z is None else z] for x, y, z in found]
        return [None if vector == [None] * 3 else vector for vector in found]

    table: dict[str, Any] = {
        "legcal_table": 1,
        "name": path.stem,
        "unit": unit,
        "types": column("type"),
        "base_joints": vectors("base"),
        "platform_joints": vectors("platform"),
        "travel": [
            None if low is None and high is None else [low, high]
            for low, high in zip(column("travel_low"), column("travel_high"), strict=True)
        ],
        "radius": [_radius(row) for row in rows],
    }
    for key, name in (("leg", "legs"), ("kind", "kinds"), ("offset", "offsets"),
                      ("length", "lengths")):  # fmt: skip
        if any(x is not None for x in column(key)):
            table[name] = column(key)
    for key in ("base_axis", "platform_axis"):
        axes = vectors(key)
        if any(axis is not None for axis in axes):
            table[key.replace("axis", "axes")] = axes
    return table


def _radius(row: dict[str, Any]) -> Any:
    """Return what a row says of the radius."""
    parts = {part: row[part] for part in ("tube", "rod") if row.get(part) is not None}
    return parts or row.get("radius")
