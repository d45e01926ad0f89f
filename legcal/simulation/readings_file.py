"""A CSV of poses: the readings of all motors, one pose a row."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from legcal.dataset.travel import check_travel
from legcal.errors import DatasetError
from legcal.files.csv_file import read_table
from legcal.files.schema import closest, describe
from legcal.geometry.types import Array
from legcal.mechanism.model import Mechanism


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
    table = read_table(
        path, "file of poses", "one row for each pose; write the readings of the motors"
    )
    problems = _header_problems(path, table.header, joints)
    if problems:
        raise DatasetError(problems)
    rows = table.rows(problems)
    where = [row.where for row in rows]
    readings = np.array(
        [[row.number(joint, "reading", "metres", problems) for joint in joints] for row in rows],
        dtype=np.float64,
    ).reshape(len(rows), len(joints))
    problems += check_travel(path, where, motors, readings)[0]
    if problems:
        raise DatasetError(problems)
    return GivenReadings(tuple(where), readings)


def _header_problems(path: Path, header: Sequence[str], joints: Sequence[str]) -> list[str]:
    """Return what is wrong with the columns."""
    start = f"{path}, header: the columns could not be used: found"
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
