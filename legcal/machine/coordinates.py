"""Independent coordinates of the platform: as many of x, y, z, roll, pitch, yaw as its freedoms.

A pose is that of the platform link in the base link; roll, pitch and yaw turn about the fixed axes
x, y, z in this order. The other coordinates follow from the constraints of the machine.
"""

from __future__ import annotations

import numpy as np

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.equations import machine_equations
from legcal.machine.model import Machine
from legcal.machine.solver import poses_after, solve

COORDINATES = ("x", "y", "z", "roll", "pitch", "yaw")
_REACHED = 1e-9  # largest error of a pose reached, relative to the size of the machine
_FREE = 0.1  # least independent motion of a chosen coordinate


def independent_coordinates(machine: Machine) -> IntArray:
    """Return the independent coordinates of a machine as indices, positions before angles.

    Coordinates are chosen in order. One is chosen if a motion that the constraints allow at home,
    and that keeps those chosen before, moves it by at least a tenth of the motion; rotations count
    in leg lengths.
    """
    pose = machine.home.as_matrix()[None, :3]
    equations = machine_equations(machine, pose[:, :, :3], pose[:, :, 3])
    scale = machine.size
    unit = np.array([1.0 / scale] * 3 + [1.0] * 3)
    constraints = equations.by_pose[0, ~equations.measured] * unit
    _, _, rows = np.linalg.svd(np.vstack([constraints, np.zeros((6, 6))]))
    free = rows[6 - machine.mobility :] * unit  # (m, 6) motions
    slopes = coordinates_of(pose)[1][0]
    moved = (slopes @ free.T) * np.array([1.0] * 3 + [scale] * 3)[:, None]
    chosen: list[int] = []
    for least in (_FREE, 0.0):  # the second pass takes any that is left
        for k in range(len(COORDINATES)):
            basis = np.linalg.qr(moved[chosen].T)[0] if chosen else np.zeros((machine.mobility, 0))
            new = moved[k] - basis @ (basis.T @ moved[k])
            if k not in chosen and len(chosen) < machine.mobility and np.linalg.norm(new) > least:
                chosen.append(k)
    return np.array(sorted(chosen), dtype=np.intp)


def poses_at_coordinates(
    machine: Machine, columns: IntArray, coordinates: Array, near: Array
) -> tuple[Array, BoolArray]:
    """Return the poses (k, 3, 4) at values (k, m) of some coordinates, and which were reached (k,).

    The search for values [m, rad] of the coordinates *columns* starts at poses *near*, (3, 4) or
    (k, 3, 4).
    """
    scale = machine.size

    def equations(poses: Array) -> tuple[Array, Array]:
        rows = machine_equations(machine, poses[:, :, :3], poses[:, :, 3])
        keep = ~rows.measured
        values, slopes = coordinates_of(poses)
        unit = np.where(columns < 3, 1.0, scale)
        off = turned_back(values[:, columns] - coordinates, columns) * unit
        return (
            np.concatenate([rows.values[:, keep], off], axis=1),
            np.concatenate([rows.by_pose[:, keep], slopes[:, columns] * unit[:, None]], axis=1),
        )

    unit = np.array([1.0 / scale] * 3 + [1.0] * 3)
    start = np.broadcast_to(near, (len(coordinates), 3, 4)).copy()
    solution = solve(equations, poses_after, start, tolerance=1e-14 * scale, unit=unit)
    return solution.points, solution.worst <= _REACHED * scale


def coordinates_of(poses: Array) -> tuple[Array, Array]:
    """Return x, y, z, roll, pitch, yaw (k, 6) [m, rad] of poses, and their slopes (k, 6, 6).

    Slopes are by rotations about the origin of the platform link and displacements in the base.
    """
    R = poses[:, :, :3]
    roll = np.arctan2(R[:, 2, 1], R[:, 2, 2])
    pitch = np.arctan2(-R[:, 2, 0], np.hypot(R[:, 2, 1], R[:, 2, 2]))
    yaw = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    values = np.concatenate([poses[:, :, 3], np.stack([roll, pitch, yaw], axis=1)], axis=1)
    slopes = np.zeros((len(poses), 6, 6))
    slopes[:, :3, 3:] = np.eye(3)
    cos_y, sin_y = np.cos(yaw), np.sin(yaw)
    cos_p, tan_p = np.cos(pitch), np.tan(pitch)
    slopes[:, 3, 0], slopes[:, 3, 1] = cos_y / cos_p, sin_y / cos_p
    slopes[:, 4, 0], slopes[:, 4, 1] = -sin_y, cos_y
    slopes[:, 5, 0], slopes[:, 5, 1], slopes[:, 5, 2] = cos_y * tan_p, sin_y * tan_p, 1.0
    return values, slopes


def turned_back(differences: Array, columns: IntArray) -> Array:
    """Return differences of coordinates, those of angles within half a turn."""
    turns = np.where(columns < 3, 0.0, 2.0 * np.pi)
    return np.asarray(
        differences - turns * np.round(differences / np.where(columns < 3, 1.0, turns))
    )
