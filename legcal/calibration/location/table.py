"""The table of measured tool poses, a CSV file that is read strictly.

The header has the actuated joints, ``x,y,z`` and, where orientations are measured,
``qx,qy,qz,qw``, in any order; optional are ``name``, ``position_sigma`` and ``angle_sigma``.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from legcal.calibration.location.frames import SMALLEST
from legcal.calibration.location.result import ToolPoses
from legcal.data import reading_columns, readings_in
from legcal.files import QUATERNION_TOLERANCE, Column, Table, read_table
from legcal.geometry import Array, BoolArray
from legcal.machine import Machine

POSITION = ("x", "y", "z")
QUATERNION = ("qx", "qy", "qz", "qw")
SIGMAS = ("position_sigma", "angle_sigma")
MOST = 1e6  # [m]; squares of far larger positions overflow
LARGEST_ANGLE = 0.2  # [rad]; a larger standard deviation is none of a measured orientation
_ROUNDED = 1e-5  # of the norm of a quaternion: not worth a note
COLUMNS = (
    Column("name", "text", required=False),
    *(
        Column(
            name,
            least=-MOST,
            most=MOST,
            what="position",
            unit="metres",
            needed=f"less than {MOST:g} m",
            remedy="write metres, or remove the row",
        )
        for name in POSITION
    ),
    *(
        Column(name, what="quaternion", required=False, blank=True, group="quaternion")
        for name in QUATERNION
    ),
    Column(
        "position_sigma",
        least=SMALLEST,
        what="standard deviation",
        unit="metres",
        needed=f"one from {SMALLEST:g} metres",
        required=False,
    ),
    Column(
        "angle_sigma",
        least=SMALLEST,
        most=LARGEST_ANGLE,
        what="standard deviation",
        unit="radians",
        needed=f"one from {SMALLEST:g} to {LARGEST_ANGLE:g} radians, not degrees",
        required=False,
        blank=True,
    ),
)
_ANGLES = re.compile(r"[rw][xyz]|[abc]|roll|pitch|yaw|phi|theta|psi", re.IGNORECASE)


def read_tool_poses(path: Path, machine: Machine) -> ToolPoses:
    """Return the measured tool poses of a file.

    Raises DatasetError with one sentence for each thing that is wrong, naming row and column.
    """
    numbers = (*POSITION, *QUATERNION, *SIGMAS)
    table = read_table(
        path,
        "table of tool poses",
        "row",
        [*reading_columns(machine.legs), *COLUMNS],
        needed="a row for each pose; measure some",
        unknown=_about_angles,
    )
    readings, notes = readings_in(table, machine.legs)
    position = table.numbers(POSITION)
    rotation, oriented, worst = _orientations(table)
    if "angle_sigma" in table:
        if "qx" not in table:
            table.refuse_file(
                f"{path}, header: the columns could not be used: found angle_sigma and no "
                "quaternions, needed qx, qy, qz, qw beside it; add the columns."
            )
        table.need(["angle_sigma"], oriented)
    joints = [column.name for column in reading_columns(machine.legs)]
    same = table.numbers([*joints, *(name for name in numbers[:7] if name in table)])
    table.once(
        [
            tuple(row) if np.all(np.isfinite(row[: len(joints) + 3])) else None
            for row in np.where(np.isnan(same), math.inf, same).tolist()
        ],
        "the same readings and the same pose",
    )  # one measurement would count as two
    table.check()
    q = np.full((len(table), machine.n_legs), math.nan)
    q[:, list(machine.motors)] = readings
    if worst > _ROUNDED:
        notes = (
            *notes,
            f"{path}: quaternions were made unit; their norms are up to {worst:.2g} off, as if "
            "they had been rounded.",
        )
    angle_sigma = np.where(oriented, table.number("angle_sigma"), 1.0)
    return ToolPoses(
        q=q,
        position=position,
        rotation=rotation,
        oriented=oriented,
        position_sigma=table.number("position_sigma") if "position_sigma" in table else None,
        angle_sigma=angle_sigma if "angle_sigma" in table else None,
        numbers=np.arange(1, len(table) + 1),
        notes=notes,
    )


def _about_angles(name: str) -> str:
    """Return what is to be said about a column that looks like an angle."""
    if not _ANGLES.fullmatch(name):
        return ""
    return (
        f"'{name}', which looks like an angle, needed orientations as quaternions qx, qy, qz, qw; "
        "convert the angles."
    )


def _orientations(table: Table) -> tuple[Array, BoolArray, float]:
    """Return orientations (n, 3, 3), where there are any, and how far norms are off at most."""
    rotation = np.tile(np.eye(3), (len(table), 1, 1))
    quaternions = table.numbers(QUATERNION)
    norms = np.linalg.norm(quaternions, axis=1)
    error = np.abs(norms - 1.0)
    for i in np.flatnonzero(error > QUATERNION_TOLERANCE).tolist():
        hint = "; these look like angles in degrees" if norms[i] > 2.0 else ""
        found = f"a quaternion of norm {norms[i]:.6g}"
        needed = f"1 within {QUATERNION_TOLERANCE:g}{hint}; check its four numbers"
        table.refuse(i, found, needed, *QUATERNION, what="orientation")
    oriented = error <= QUATERNION_TOLERANCE
    if np.any(oriented):
        rotation[oriented] = Rotation.from_quat(quaternions[oriented]).as_matrix()
    return rotation, oriented, float(error[oriented].max(initial=0.0))
