"""A table from commands to corrected commands, for controllers with a fixed model.

If a controller with the nominal model is commanded to the pose X' = FK_nominal(IK_calibrated(X)),
it moves the motors to the readings at which the calibrated machine is at X. Poses are of the
platform link in the base link, in independent coordinates of the machine: as many of x, y, z [mm]
and roll, pitch, yaw [deg] about fixed axes as it has freedoms, positions before angles; the others
follow. Between nodes a table is interpolated linearly; the residual is computed,
FK_calibrated(IK_nominal(X')) against X.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import OutOfClass, UsageError
from legcal.exports.subject import Rendered, Subject, comment
from legcal.geometry.motions import motions_of
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.closing import (
    COORDINATES,
    coordinates_of,
    independent_coordinates,
    poses_at_coordinates,
    turned_back,
)
from legcal.machine.configurations import workspace
from legcal.machine.kinematics import (
    platforms_in_base,
    pose_differences,
    poses_at_readings,
)
from legcal.machine.model import Machine, readings_at_poses
from legcal.version import __version__

UNITS = ("mm", "mm", "mm", "deg", "deg", "deg")
TO_FILE = np.array([1e3] * 3 + [float(np.degrees(1.0))] * 3)
# Nodes per coordinate by number of freedoms, at most 4,096 in total.
DEFAULT_NODES = {1: 21, 2: 21, 3: 11, 4: 7, 5: 5, 6: 4}
MAX_ROWS = 300_000
TESTED = 1000  # largest number of cells in whose middle the table is tested
SHRINKING, ATTEMPTS = 0.8, 20  # factor of the grid size until all nodes are in the travel, attempts
_SEED = 2002


def correction_refusal(subject: Subject) -> str | None:
    """Return the reason for refusing a correction, or None."""
    if subject.nominal is None:
        return "found a model, needed a result, which has a nominal and a calibrated model"
    if not subject.machine.is_determined:
        return f"found that {subject.machine.undetermined}, needed readings that give the pose"
    return None


def correction_files(subject: Subject, path: Path, nodes: int | None = None) -> Rendered:
    """Return the CSV of the correction table, with a number of nodes along each coordinate."""
    calibrated, nominal = subject.machine, subject.nominal
    if nominal is None:
        raise ValueError("a model without a result has no correction")
    columns = independent_coordinates(calibrated)
    m = len(columns)
    n = DEFAULT_NODES[m] if nodes is None else nodes
    if n < 2 or n**m > MAX_ROWS:
        most = int(MAX_ROWS ** (1.0 / m) + 1e-9)
        raise UsageError(
            f"--nodes could not be used: found {n} along each of {m} coordinates, needed 2 to "
            f"{most}; give another number."
        )
    ticks, commands, corrected = _grid(calibrated, nominal, columns, n)
    left, raw = _residuals(calibrated, nominal, columns, ticks, corrected.reshape(*(n,) * m, m))
    figures: dict[str, Any] = {
        "coordinates": [COORDINATES[k] for k in columns],
        "nodes": len(commands),
        "tested": len(left),
    }
    sentences = []
    for key, errors, label in (
        ("residual", left, "Between nodes the interpolated table leaves"),
        ("uncorrected", raw, "Without it the platform is off by"),
    ):
        (rms_dX, rms_dE), (max_dX, max_dE) = np.sqrt((errors**2).mean(axis=0)), errors.max(axis=0)
        figures[key] = {
            "rms_dX_m": float(rms_dX),
            "max_dX_m": float(max_dX),
            "rms_dE_rad": float(rms_dE),
            "max_dE_rad": float(max_dE),
        }
        sentences.append(
            f"{label} {1e3 * rms_dX:.3g} mm and {np.degrees(rms_dE):.3g} deg rms, "
            f"{1e3 * max_dX:.3g} mm and {np.degrees(max_dE):.3g} deg at most (middles of "
            f"{len(left)} cells)."
        )
    names = [f"{COORDINATES[k]}_{UNITS[k]}" for k in columns]
    lines = [
        f"# Correction of {comment(subject.name)}, written by legcal {__version__}.",
        "# Command the columns corrected_* to a controller with the nominal model, to move the",
        "# calibrated platform to the other columns. Poses are of the platform link in the base",
        "# link; roll, pitch, yaw are about fixed x, y, z. The last coordinate changes fastest.",
        *(f"# {sentence}" for sentence in sentences),
        ",".join([*names, *(f"corrected_{name}" for name in names)]),
    ]
    scale = TO_FILE[columns]
    rows = np.concatenate([commands * scale, corrected * scale], axis=1)
    lines += [",".join(f"{x:.9f}" for x in row) for row in rows.tolist()]
    content = ("\n".join(lines) + "\n").encode()
    return Rendered({"": content}, tuple(sentences), figures)


def _grid(
    machine: Machine, nominal: Machine, columns: IntArray, n_nodes: int
) -> tuple[list[Array], Array, Array]:
    """Return ticks, nodes (k, m) and corrected nodes (k, m) of the largest grid in the travel.

    The grid is about the middle of the workspace and has its proportions.
    """
    centre = coordinates_of(machine.home.as_matrix()[None, :3])[0][0, columns]
    there = coordinates_of(stacked(workspace(machine)[1]))[0][:, columns]
    there = centre + turned_back(there - centre, columns)
    middle, reach = there.mean(axis=0), np.abs(there - there.mean(axis=0)).max(axis=0)
    for part in SHRINKING ** np.arange(ATTEMPTS):
        for n in sorted({2, min(n_nodes, 3), n_nodes}):  # corners first: most likely outside
            ticks = list(np.linspace(middle - part * reach, middle + part * reach, n).T)
            nodes = np.array(list(product(*ticks)))
            corrected, reached = _corrected(machine, nominal, columns, nodes)
            if not reached.all():
                break
        else:
            return ticks, nodes, corrected
    raise OutOfClass(
        f"{machine.yaml_path}: the correction could not be tabulated: found no box of poses about "
        "the middle of the workspace that both models reach inside the travel, needed one; check "
        "the travel of the motors."
    )


def _corrected(
    calibrated: Machine, nominal: Machine, columns: IntArray, commands: Array
) -> tuple[Array, BoolArray]:
    """Return corrected coordinates (k, m) of commands, and which both machines reach.

    If the calibrated machine does not reach all commands in its travel, they are not corrected.
    """
    home = calibrated.home.as_matrix()[:3]
    X, reached = poses_at_coordinates(calibrated, columns, commands, home)
    q, motors = readings_at_poses(calibrated, X), list(calibrated.motors)
    ends = np.array([calibrated.legs[j].travel for j in motors]).reshape(-1, 2)
    reached &= ((q[:, motors] >= ends[:, 0]) & (q[:, motors] <= ends[:, 1])).all(axis=1)
    if not reached.all():
        return commands, reached
    moved, there = poses_at_readings(nominal, q[:, list(nominal.motors)], X)
    coordinates = coordinates_of(moved)[0][:, columns]
    return commands + turned_back(coordinates - commands, columns), reached & there


def _residuals(
    calibrated: Machine,
    nominal: Machine,
    columns: IntArray,
    ticks: list[Array],
    corrected: Array,
) -> tuple[Array, Array]:
    """Return displacement [m] and rotation [rad] (k, 2) in the middle of cells, and uncorrected."""
    home = calibrated.home.as_matrix()[:3]
    m, n = len(ticks), len(ticks[0])
    cells = np.array(list(np.ndindex(*(n - 1,) * m)))
    if len(cells) > TESTED:
        chosen = np.random.default_rng(_SEED).choice(len(cells), TESTED, replace=False)
        cells = cells[np.sort(chosen)]
    commands = np.stack([0.5 * (t[c] + t[c + 1]) for t, c in zip(ticks, cells.T, strict=True)], 1)
    corners = [corrected[tuple((cells + corner).T)] for corner in product((0, 1), repeat=m)]
    X, _ = poses_at_coordinates(calibrated, columns, commands, home)
    wanted = platforms_in_base(calibrated, motions_of(X[:, :, :3], X[:, :, 3]))
    residuals = []
    for asked in (np.mean(corners, axis=0), commands):
        there, _ = poses_at_coordinates(nominal, columns, asked, home)
        q = readings_at_poses(nominal, there)[:, list(calibrated.motors)]
        there, _ = poses_at_readings(calibrated, q, X)
        reached = platforms_in_base(calibrated, motions_of(there[:, :, :3], there[:, :, 3]))
        residuals.append(np.stack(pose_differences(reached, wanted), axis=1))
    return residuals[0], residuals[1]


def stacked(poses: list[RigidTransform]) -> Array:
    """Return poses as matrices (k, 3, 4)."""
    return np.array([T.as_matrix()[:3] for T in poses])
