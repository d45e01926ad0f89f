"""The table of measured tool poses, a CSV file that is read strictly.

The header has the actuated joints, ``x,y,z`` and, where orientations are measured,
``qx,qy,qz,qw``, in any order; optional are ``name``, ``position_sigma`` and ``angle_sigma``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from legcal.calibration.location.model import SMALLEST, ToolPoses
from legcal.data import check_travel
from legcal.errors import DatasetError
from legcal.files import Row, closest, finite_number, read_table
from legcal.geometry import QUATERNION_TOLERANCE, Array, BoolArray
from legcal.machine import LegKind, Mechanism

WHAT = "table of tool poses"
POSITION = ("x", "y", "z")
QUATERNION = ("qx", "qy", "qz", "qw")
SIGMAS = ("position_sigma", "angle_sigma")
MOST = 1e6  # [m]; squares of far larger positions overflow
LARGEST_ANGLE = 0.2  # [rad]; a larger standard deviation is none of a measured orientation
_ROUNDED = 1e-5  # of the norm of a quaternion: not worth a note

_ANGLES = re.compile(r"[rw][xyz]|[abc]|roll|pitch|yaw|phi|theta|psi", re.IGNORECASE)


def read_tool_poses(path: Path, mechanism: Mechanism) -> ToolPoses:
    """Return the measured tool poses of a file.

    Parameters
    ----------
    path : Path
        The table.
    mechanism : Mechanism
        Its actuated joints name the columns of readings.

    Raises
    ------
    DatasetError
        With one sentence for each thing that is wrong, naming row and column.
    """
    legs = [leg for leg in mechanism.legs if leg.kind is LegKind.ACTUATED]
    joints = [leg.prismatic or "" for leg in legs]
    table = read_table(path, WHAT, "a row for each pose; measure some")
    header = table.header
    problems = _header_problems(path, header, joints)
    if problems:
        raise DatasetError(problems)
    rows = table.rows(problems)
    readings = _numbers(rows, joints, "reading", "metres", problems)
    outside, notes = check_travel(path, [row.where for row in rows], legs, readings)
    problems += outside
    position = _numbers(rows, POSITION, "position", "metres", problems)
    _check_size(rows, position, problems)
    rotation, oriented, norm_notes = _orientations(path, rows, header, problems)
    sigmas = [_sigma(rows, name, header, oriented, problems) for name in SIGMAS]
    _check_twice(rows, [*joints, *POSITION, *(c for c in QUATERNION if c in header)], problems)
    if problems:
        raise DatasetError(problems)
    q = np.full((len(rows), mechanism.n_legs), math.nan)
    q[:, list(mechanism.motors)] = readings
    return ToolPoses(
        q=q,
        position=position,
        rotation=rotation,
        oriented=oriented,
        position_sigma=sigmas[0],
        angle_sigma=sigmas[1],
        numbers=np.arange(1, len(rows) + 1),
        notes=(*notes, *norm_notes),
    )


def _header_problems(path: Path, header: Sequence[str], joints: Sequence[str]) -> list[str]:
    """Return what is wrong with the columns."""
    start = f"{path}, header: the columns could not be used: found"
    known = [*joints, *POSITION, *QUATERNION, *SIGMAS, "name"]
    problems = [
        f"{start} the column '{name}' {header.count(name)} times, needed it once; remove one."
        for name in dict.fromkeys(header)
        if header.count(name) > 1
    ]
    for name in dict.fromkeys(header):
        if name not in known and _ANGLES.fullmatch(name):
            problems.append(
                f"{start} '{name}', which looks like an angle, needed orientations as quaternions "
                "qx, qy, qz, qw; convert the angles."
            )
        elif name not in known:
            problems.append(
                f"{start} the unknown column '{name}', needed an actuated joint of the mechanism, "
                f"x, y, z, qx, qy, qz, qw, position_sigma, angle_sigma or name; "
                f"{closest(name, known)}"
            )
    needed = [*joints, *POSITION]
    if any(name in header for name in (*QUATERNION, "angle_sigma")):
        needed += QUATERNION
    problems += [
        f"{start} no column '{name}', needed "
        f"{'the readings of that joint [m]' if name in joints else 'it'}; add the column."
        for name in needed
        if name not in header
    ]
    return problems


def _numbers(
    rows: Sequence[Row], columns: Sequence[str], what: str, unit: str, problems: list[str]
) -> Array:
    """Return some columns, NaN where a cell holds no finite number."""
    found = [[row.number(column, what, unit, problems) for column in columns] for row in rows]
    return np.array(found, dtype=np.float64).reshape(len(rows), len(columns))


def _check_size(rows: Sequence[Row], position: Array, problems: list[str]) -> None:
    """Refuse positions beyond reason."""
    problems += [
        f"{row.where}: the position could not be used: found {size:.3g} m, needed less than "
        f"{MOST:g} m; write metres."
        for row, size in zip(rows, np.abs(position).max(axis=1, initial=0.0), strict=True)
        if size >= MOST
    ]


def _orientations(
    path: Path, rows: Sequence[Row], header: Sequence[str], problems: list[str]
) -> tuple[Array, BoolArray, list[str]]:
    """Return orientations, where there are any, and a note if their quaternions were rounded."""
    rotation = np.tile(np.eye(3), (len(rows), 1, 1))
    oriented = np.zeros(len(rows), dtype=np.bool_)
    worst = 0.0
    for i, row in enumerate(rows if "qx" in header else []):
        if not any(row.cells[c] for c in QUATERNION):
            continue
        numbers = [row.number(c, "quaternion", "", problems) for c in QUATERNION]
        norm = math.hypot(*numbers)
        if not math.isfinite(norm):
            continue
        if abs(norm - 1.0) > QUATERNION_TOLERANCE:
            hint = "; these look like angles in degrees" if norm > 2.0 else ""
            problems.append(
                f"{row.where}: the orientation could not be used: found a quaternion of norm "
                f"{norm:.6g}, needed 1 within {QUATERNION_TOLERANCE:g}{hint}; check its four "
                "numbers qx, qy, qz, qw."
            )
            continue
        worst = max(worst, abs(norm - 1.0))
        rotation[i], oriented[i] = Rotation.from_quat(numbers).as_matrix(), True
    notes = [
        f"{path}: quaternions were made unit; their norms are up to {worst:.2g} off, as if they "
        "had been rounded."
    ]
    return rotation, oriented, notes if worst > _ROUNDED else []


def _sigma(
    rows: Sequence[Row],
    name: str,
    header: Sequence[str],
    oriented: BoolArray,
    problems: list[str],
) -> Array | None:
    """Return the standard deviations of a column, or None without the column."""
    if name not in header:
        return None
    is_angle = name == "angle_sigma"
    unit = "radians" if is_angle else "metres"
    sigma = np.ones(len(rows))
    for i, row in enumerate(rows):
        if is_angle and not oriented[i]:
            continue
        sigma[i] = row.number(name, "standard deviation", unit, problems)
        too_large = is_angle and sigma[i] > LARGEST_ANGLE
        if sigma[i] < SMALLEST or too_large:
            hint = "; it looks like degrees" if too_large else ""
            problems.append(
                f"{row.where}, column {name}: the standard deviation could not be used: found "
                f"{sigma[i]:g}, needed one from {SMALLEST:g} "
                f"{f'to {LARGEST_ANGLE:g} ' if is_angle else ''}{unit}{hint}; correct it."
            )
    return sigma


def _check_twice(rows: Sequence[Row], columns: Sequence[str], problems: list[str]) -> None:
    """Refuse a row that is there twice: one measurement would count as two."""
    first: dict[tuple[float | str, ...], str] = {}
    for row in rows:
        cells = [row.cells[c] for c in columns]
        numbers = tuple(c if math.isnan(x := finite_number(c)) else x for c in cells)
        earlier = first.setdefault(numbers, row.where)
        if earlier != row.where:
            problems.append(
                f"{row.where}: the row could not be used: found the same readings and the same "
                f"pose in {earlier.rsplit(', ', 1)[-1]}, needed each measurement once; remove one "
                "of them."
            )
