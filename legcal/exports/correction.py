"""A table from commands to corrected commands, for controllers with a fixed model.

If a controller with the nominal model is commanded to the pose X' = FK_nominal(IK_calibrated(X)),
it moves the motors to the readings at which the calibrated machine is at X. Poses are of the
platform link in the base link, in independent coordinates of the machine: as many of x, y, z [mm]
and roll, pitch, yaw [deg] about fixed axes as it has freedoms, positions before angles; the others
follow. Between nodes a table is interpolated linearly; the residual is computed,
FK_calibrated(IK_nominal(X')) against X.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import OutOfClass, UsageError
from legcal.exports.subject import ExportedFile, ExportOptions, Rendered, Subject, comment
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.closing import (
    COORDINATES,
    coordinates_of,
    independent_coordinates,
    poses_at_coordinates,
    turned_back,
)
from legcal.machine.configurations import workspace
from legcal.machine.kinematics import equations_of_readings
from legcal.machine.model import Machine, readings_at_poses
from legcal.machine.solver import poses_after, solve
from legcal.version import __version__

UNITS = ("mm", "mm", "mm", "deg", "deg", "deg")
TO_FILE = np.array([1e3] * 3 + [float(np.degrees(1.0))] * 3)
DEFAULT_NODES = {
    1: 21,
    2: 21,
    3: 11,
    4: 7,
    5: 5,
    6: 4,
}  # nodes per coordinate by number of freedoms, at most 4,096 in total
MAX_ROWS = 300_000
TESTED = 1000  # largest number of cells in whose middle the table is tested
SHRINKING, ATTEMPTS = 0.8, 20  # factor of the grid size until all nodes are in the travel, attempts
REACHED = 1e-9  # residual of a reached pose, in leg lengths
_SEED = 2002


def correction_refusal(subject: Subject) -> str | None:
    """Return the reason for refusing a correction, or None."""
    if subject.nominal is None:
        return "found a model, needed a result, which has a nominal and a calibrated model"
    if not subject.machine.is_determined:
        return f"found that {subject.machine.undetermined}, needed readings that give the pose"
    return None


@dataclass(frozen=True, eq=False)
class _Models:
    """Both machines, and the independent coordinates of their poses."""

    calibrated: Machine
    nominal: Machine
    columns: IntArray  # indices into COORDINATES

    def poses(self, machine: Machine, coordinates: Array) -> tuple[Array, BoolArray]:
        """Return poses (k, 3, 4) at coordinates (k, m), and which were reached."""
        home = self.calibrated.home.as_matrix()[:3]
        return poses_at_coordinates(machine, self.columns, coordinates, home)


def _readings(machine: Machine, poses: Array) -> Array:
    """Return the readings (k, n_legs) at poses, zero for legs without a motor."""
    moved = [leg.is_motor for leg in machine.legs]
    return np.where(moved, readings_at_poses(machine, poses), 0.0)


def poses_at_readings(machine: Machine, q: Array, near: Array) -> tuple[Array, BoolArray]:
    """Return the poses (k, 3, 4) at readings (k, n_legs), near others, and which were reached."""
    scale = machine.size
    solution = solve(
        equations_of_readings(machine, q[:, list(machine.motors)]),
        poses_after,
        near,
        tolerance=1e-14 * scale,
        unit=np.array([1.0 / scale] * 3 + [1.0] * 3),
    )
    return solution.points, solution.worst <= REACHED * scale


def correction_files(subject: Subject, options: ExportOptions, path: Path) -> Rendered:
    """Return the CSV of the correction table."""
    nominal = subject.nominal
    if nominal is None:
        raise ValueError("a model without a result has no correction")
    calibrated = subject.machine
    columns = independent_coordinates(calibrated)
    n_nodes = _number_of_nodes(options.nodes, len(columns))
    models = _Models(calibrated, nominal, columns)
    ticks, nodes, corrected = _grid(models, n_nodes)
    shape = (n_nodes,) * len(columns)
    left, raw = _residuals(models, ticks, corrected.reshape(*shape, len(columns)))
    figures = {
        "coordinates": [COORDINATES[k] for k in columns],
        "nodes": len(nodes),
        "residual": _figures(left),
        "uncorrected": _figures(raw),
        "tested": len(left),
    }
    sentences = _sentences(figures)
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
    rows = np.concatenate([nodes * scale, corrected * scale], axis=1)
    lines += [",".join(f"{x:.9f}" for x in row) for row in rows.tolist()]
    content = ("\n".join(lines) + "\n").encode()
    return Rendered((ExportedFile("", content),), tuple(sentences), figures)


def _number_of_nodes(given: int | None, m: int) -> int:
    """Return the number of nodes along each coordinate."""
    n = DEFAULT_NODES[m] if given is None else given
    if n < 2 or n**m > MAX_ROWS:
        most = int(MAX_ROWS ** (1.0 / m) + 1e-9)
        raise UsageError(
            f"--nodes could not be used: found {n} along each of {m} coordinates, needed 2 to "
            f"{most}; give another number."
        )
    return n


def _grid(models: _Models, n_nodes: int) -> tuple[list[Array], Array, Array]:
    """Return ticks, nodes (k, m) and corrected nodes (k, m) of the largest grid in the travel.

    The grid is about the middle of the workspace and has its proportions.
    """
    machine, columns = models.calibrated, models.columns
    centre = coordinates_of(machine.home.as_matrix()[None, :3])[0][0, columns]
    there = coordinates_of(stacked(workspace(machine)[1]))[0][:, columns]
    there = centre + turned_back(there - centre, columns)
    middle, reach = there.mean(axis=0), np.abs(there - there.mean(axis=0)).max(axis=0)
    for part in SHRINKING ** np.arange(ATTEMPTS):
        for n in sorted({2, min(n_nodes, 3), n_nodes}):  # corners first: most likely outside
            ticks = list(np.linspace(middle - part * reach, middle + part * reach, n).T)
            nodes = np.array(list(product(*ticks)))
            corrected, reached = _corrected(models, nodes)
            if not reached.all():
                break
        else:
            return ticks, nodes, corrected
    raise OutOfClass(_no_grid(machine))


def _corrected(models: _Models, commands: Array) -> tuple[Array, BoolArray]:
    """Return corrected coordinates (k, m) of commands, and which both machines reach.

    If the calibrated machine does not reach all commands in its travel, they are not corrected.
    """
    calibrated, columns = models.calibrated, models.columns
    X, reached = models.poses(calibrated, commands)
    q, motors = _readings(calibrated, X), list(calibrated.motors)
    ends = np.array([calibrated.legs[j].travel for j in motors]).reshape(-1, 2)
    reached &= ((q[:, motors] >= ends[:, 0]) & (q[:, motors] <= ends[:, 1])).all(axis=1)
    if not reached.all():
        return commands, reached
    moved, there = poses_at_readings(models.nominal, q, X)
    coordinates = coordinates_of(moved)[0][:, columns]
    return commands + turned_back(coordinates - commands, columns), reached & there


def _residuals(models: _Models, ticks: list[Array], corrected: Array) -> tuple[Array, Array]:
    """Return displacement [m] and rotation [rad] (k, 2) in the middle of cells, and uncorrected."""
    calibrated, nominal = models.calibrated, models.nominal
    m, n = len(ticks), len(ticks[0])
    cells = np.array(list(np.ndindex(*(n - 1,) * m)))
    if len(cells) > TESTED:
        chosen = np.random.default_rng(_SEED).choice(len(cells), TESTED, replace=False)
        cells = cells[np.sort(chosen)]
    commands = np.stack([0.5 * (t[c] + t[c + 1]) for t, c in zip(ticks, cells.T, strict=True)], 1)
    corners = [corrected[tuple((cells + corner).T)] for corner in product((0, 1), repeat=m)]
    X, _ = models.poses(calibrated, commands)
    residuals = []
    for asked in (np.mean(corners, axis=0), commands):
        asked_poses, _ = models.poses(nominal, asked)
        reached, _ = poses_at_readings(calibrated, _readings(nominal, asked_poses), X)
        residuals.append(_pose_errors(calibrated, reached, X))
    return residuals[0], residuals[1]


def _pose_errors(machine: Machine, poses: Array, references: Array) -> Array:
    """Return the displacement of the origin of R_e, and the rotation, (k, 2) [m, rad]."""
    point = machine.T_platform_Re.as_matrix()[:3, 3]
    off = (poses[:, :, :3] - references[:, :, :3]) @ point + poses[:, :, 3] - references[:, :, 3]
    between = np.swapaxes(references[:, :, :3], 1, 2) @ poses[:, :, :3]
    across = between - np.swapaxes(between, 1, 2)
    sine = 0.5 * np.linalg.norm(
        np.stack([across[:, 2, 1], across[:, 0, 2], across[:, 1, 0]], axis=1), axis=1
    )
    cosine = 0.5 * (np.einsum("kii->k", between) - 1.0)
    return np.stack([np.linalg.norm(off, axis=1), np.arctan2(sine, cosine)], axis=1)


def _figures(apart: Array) -> dict[str, float]:
    """Return root mean squares and maxima of displacements and rotations."""
    rms, most = np.sqrt((apart**2).mean(axis=0)), apart.max(axis=0)
    return {
        "rms_dX_m": float(rms[0]),
        "max_dX_m": float(most[0]),
        "rms_dE_rad": float(rms[1]),
        "max_dE_rad": float(most[1]),
    }


def _sentences(figures: dict[str, object]) -> list[str]:
    """Return the residuals of the table in words."""
    sentences = []
    for key, label in (
        ("residual", "Between nodes the interpolated table leaves"),
        ("uncorrected", "Without it the platform is off by"),
    ):
        f = figures[key]
        if isinstance(f, dict):
            sentences.append(
                f"{label} {1e3 * f['rms_dX_m']:.3g} mm and {np.degrees(f['rms_dE_rad']):.3g} deg "
                f"rms, {1e3 * f['max_dX_m']:.3g} mm and {np.degrees(f['max_dE_rad']):.3g} deg "
                f"at most (middles of {figures['tested']} cells)."
            )
    return sentences


def _no_grid(machine: Machine) -> str:
    """Return the error of a machine without a grid."""
    return (
        f"{machine.yaml_path}: the correction could not be tabulated: found no box of poses about "
        "the middle of the workspace that both models reach inside the travel, needed one; check "
        "the travel of the motors."
    )


def stacked(poses: list[RigidTransform]) -> Array:
    """Return poses as matrices (k, 3, 4)."""
    return np.array([T.as_matrix()[:3] for T in poses])
