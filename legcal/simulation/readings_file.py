"""A CSV of poses: the readings of all motors, one pose a row."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from legcal.dataset.travel import check_travel
from legcal.errors import DatasetError
from legcal.files.csv_file import Line, read_lines
from legcal.files.schema import closest, describe
from legcal.geometry.types import Array
from legcal.mechanism.model import Mechanism
from legcal.mechanism.urdf_checks import number_list


@dataclass(frozen=True, eq=False)
class GivenReadings:
    """Readings of the motors.

    Attributes
    ----------
    where : tuple of str
        The place of each row, for messages.
    readings : (n_poses, n_motors) array
        In the order of ``mechanism.motors`` [m].
    """

    where: tuple[str, ...]
    readings: Array


def read_readings(path: Path, mechanism: Mechanism) -> GivenReadings:
    """Read a CSV of poses.

    Parameters
    ----------
    path : Path
        The file: actuated joints in the header, in any order, readings below [m].
    mechanism : Mechanism
        The machine.

    Returns
    -------
    GivenReadings

    Raises
    ------
    DatasetError
        With one sentence for each thing that is wrong, naming row and column.
    """
    motors = [mechanism.legs[j] for j in mechanism.motors]
    joints = [str(leg.prismatic) for leg in motors]
    lines = read_lines(path, "file of poses")
    if len(lines) < 2:
        raise DatasetError(
            f"{path}: the poses could not be used: found {'no header' if not lines else 'a header'}"
            " and no row, needed one row for each pose; write the readings of the motors."
        )
    header = lines[0][1]
    problems = _header_problems(path, header, joints)
    if problems:
        raise DatasetError(problems)
    where = [f"{path}, row {i} (line {line})" for i, (line, _) in enumerate(lines[1:], start=1)]
    columns = [header.index(joint) for joint in joints]
    rows = [_row(w, line, header, problems) for w, line in zip(where, lines[1:], strict=True)]
    readings = np.array(rows)[:, columns]
    problems += check_travel(path, where, motors, readings)[0]
    if problems:
        raise DatasetError(problems)
    return GivenReadings(tuple(where), readings)


def _header_problems(path: Path, header: Sequence[str], joints: Sequence[str]) -> list[str]:
    """Return what is wrong with the columns."""
    start = f"{path}, header: the columns could not be used: found"
    if len(header) == 1 and re.search(r"[;\t]", header[0]):
        return [f"{start} '{header[0]}' in one column, needed commas between columns; save as CSV."]
    problems = []
    for name in dict.fromkeys([*header, *joints]):
        count = header.count(name)
        if name not in joints:
            problems.append(
                f"{start} the unknown column {describe(name)}, needed actuated joints of the "
                f"mechanism; {closest(name, joints)}"
            )
        elif count != 1:
            problems.append(
                f"{start} the column '{name}' {count} times, needed the readings of that joint [m] "
                "once; correct the header."
            )
    return problems


def _row(where: str, line: Line, header: Sequence[str], problems: list[str]) -> list[float]:
    """Return the numbers of a row, NaN where there is none."""
    _, cells = line
    if len(cells) != len(header):
        problems.append(
            f"{where}: the row could not be used: found {len(cells)} cells, needed {len(header)} "
            "as in the header; correct it."
        )
        return [np.nan] * len(header)
    row = []
    for name, text in zip(header, cells, strict=True):
        found = number_list(text, 1)
        if found is None:
            problems.append(
                f"{where}, column {name}: the reading could not be used: found "
                f"{describe(text) if text else 'an empty cell'}, needed a number in metres; "
                "correct it or remove the row."
            )
        row.append(np.nan if found is None else found[0])
    return row
