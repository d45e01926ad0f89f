"""Unknown motions and axes inside the steps, in CasADi and numerically.

Unknown rotations are Gibbs vectors w = tan(angle / 2) along the axis, counted from a start: they
have no branches and no square root. It is the chart of ``Frames``, except
that a small w is half of a rotation vector, and that steps begin with the translation.

An unknown axis is turned about its normal basis e1, e2 by two turns, w = (turn_1 e1 + turn_2 e2) /
2: its :func:`~legcal.geometry.axes.axis_angles` but for a factor near one (:func:`gibbs_of`).
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from legcal.geometry.axes import turned_axis
from legcal.geometry.lines import normal_basis
from legcal.geometry.rotations import turned
from legcal.geometry.types import Array

# Unknown motions


def moved_points(step: ca.SX, R: ca.SX, t: ca.SX, points: ca.SX) -> ca.SX:
    """Return points (3, n) after R, t and a step (6,): translation [m], then Gibbs vector."""
    return turned_points(step[3:], R @ points) + ca.repmat(t + step[:3], 1, points.shape[1])


def turned_points(w: ca.SX, points: ca.SX) -> ca.SX:
    """Return points (3, n) turned by the rotation that has the Gibbs vector w (3,)."""
    cross = ca.skew(w)
    turn = ca.SX.eye(3) + 2.0 / (1.0 + ca.dot(w, w)) * (cross + ca.mtimes(cross, cross))
    return turn @ points


def stepped_poses(R: Array, t: Array, steps: Array) -> tuple[Array, Array]:
    """Return the poses (n, 3, 3), (n, 3) of :func:`moved_points` for numbers, steps (n, 6)."""
    return turned(R, 2.0 * steps[:, 3:]), t + steps[:, :3]


# Unknown axes


def axis_frames(v: Array) -> Array:
    """Return axes (n, 3) and their normal bases as columns, (n, 3, 3)."""
    return np.concatenate([v[:, :, None], np.swapaxes(normal_basis(v), 1, 2)], axis=2)


def turned_frame(turns: ca.SX, frame: ca.SX) -> ca.SX:
    """Return an axis and its normal basis, columns (3, 3), after two turns of the axis."""
    return turned_points(0.5 * frame[:, 1:] @ turns, frame)


def gibbs_of(angles: Array) -> Array:
    """Return the turns (..., 2) of an axis that is turned by angles (..., 2) [rad]."""
    half = 0.5 * np.linalg.norm(angles, axis=-1, keepdims=True)
    return np.asarray(angles * np.where(half > 0.0, np.tan(half) / np.where(half, half, 1.0), 1.0))


def angles_of(turns: Array) -> Array:
    """Return the angles (..., 2) [rad] of turns, the inverse of :func:`gibbs_of`."""
    half = 0.5 * np.linalg.norm(turns, axis=-1, keepdims=True)
    return np.asarray(
        turns * np.where(half > 0.0, np.arctan(half) / np.where(half, half, 1.0), 1.0)
    )


def axis_slope(nominal: Array, turns: Array) -> Array:
    """Return the derivative (3, 2) of the first column of :func:`turned_frame` by the turns."""
    by_turns = np.array([-0.5 * turns, [0.0, 1.0], [-1.0, 0.0]])
    axis = turned_axis(nominal, angles_of(turns))
    frame = np.vstack([nominal, normal_basis(nominal)])
    return np.asarray(
        (frame.T @ by_turns - 0.5 * np.outer(axis, turns)) / (1.0 + 0.25 * float(turns @ turns))
    )
