"""Roots and least squares of equations, for many points of a manifold at once.

One solver for platform poses and for configurations of the closed chain: minimum-norm Gauss-Newton
steps, damped if they do not reduce the cost (Levenberg-Marquardt). If the solution must be the one
connected to the start, steps are not damped but must contract.
"""

from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from legcal.geometry.motions import moved_poses
from legcal.geometry.types import Array, BoolArray

Equations = Callable[[Array], tuple[Array, Array]]  # points (k, ...) to (k, m) and (k, m, n)
Retraction = Callable[[Array, Array], Array]  # points (k, ...) and steps (k, n) to points

RANK = 1e-9  # singular value below which directions are dependent, relative to the largest
INITIAL_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-3, 1e-12, 1e6  # relative to the mean eigenvalue
MIN_STEP = 1e-14  # least step, in units
MAX_TURN = 0.5  # largest rotation of a pose in one step [rad]


class Solved(NamedTuple):
    """The result of an iteration."""

    points: Array  # (k, ...)
    values: Array  # (k, m) residuals
    jacobian: Array  # (k, m, n)
    size: Array  # (k,) largest component of the last step, in its unit
    converged: BoolArray  # (k,) residual below the tolerance, or a least-squares minimum

    @property
    def worst(self) -> Array:
        """The largest residual of each point, (k,)."""
        return np.asarray(np.abs(self.values).max(axis=1, initial=0.0))


def solve(
    equations: Equations,
    retract: Retraction,
    points: Array,
    *,
    tolerance: Array | float,
    unit: Array | float = 1.0,
    rank: float = RANK,
    damped: bool = False,
    steps: int = 60,
    max_stalled: int | None = None,
) -> Solved:
    """Return the solutions (k, ...) from start points, by damped Gauss-Newton steps.

    *tolerance* applies to residuals; sizes of steps are relative to *unit* (n,). Steps are damped
    from the start if *damped*, else after one that does not reduce the cost. Points with little
    improvement in more than *max_stalled* steps are given up.
    """
    values, jacobian = equations(points)
    points, values, jacobian = points.copy(), values.copy(), jacobian.copy()
    cost = np.einsum("km,km->k", values, values)
    damping = np.minimum(INITIAL_DAMPING if damped else 0.0, cost)
    size = np.zeros(len(points))
    stalled = np.zeros(len(points), dtype=np.intp)
    moving = np.ones(len(points), dtype=np.bool_)
    for _ in range(steps):
        worst = np.abs(values).max(axis=1, initial=0.0)
        moving &= worst > tolerance
        if not moving.any():
            break
        rows = _rows(moving)
        step = np.zeros((len(points), jacobian.shape[2]))
        step[rows] = _damped(jacobian[rows] * unit, values[rows], damping[rows], rank)
        size[rows] = np.abs(step[rows]).max(axis=1, initial=0.0)
        trial = retract(points, step * unit)
        ahead, slopes = equations(trial)
        ahead_cost = np.einsum("km,km->k", ahead, ahead)
        better = moving & (ahead_cost < cost)
        if max_stalled is not None:
            stalled = np.where(better, np.where(ahead_cost > 0.9 * cost, stalled + 1, 0), stalled)
            moving &= stalled <= max_stalled
        rows = _rows(better)
        points[rows], values[rows], jacobian[rows] = trial[rows], ahead[rows], slopes[rows]
        cost[rows] = ahead_cost[rows]
        at_rest = (worst < 100.0 * tolerance) | (size < MIN_STEP) | (damping > MAX_DAMPING)
        moving &= better | ~at_rest
        damping = np.where(better, 0.1 * damping, np.maximum(10.0 * damping, 1e-8))
    return Solved(points, values, jacobian, size, ~moving)


def newton(
    equations: Equations,
    retract: Retraction,
    points: Array,
    *,
    tolerance: float,
    contraction: float,
    first: float = 1.0,
    unit: Array | float = 1.0,
    steps: int = 12,
) -> Solved:
    """Return the result of contracting Newton steps from points (k, ...).

    Each step must be shorter than the one before, times *contraction*; *first* bounds the first one
    in the same way. Otherwise a point has not converged, unless its residual is below the
    tolerance.
    """
    values, jacobian = equations(points)
    size = np.full(len(points), first)
    converged = np.abs(values).max(axis=1, initial=0.0) < tolerance
    moving = ~converged
    for _ in range(steps):
        if not moving.any():
            break
        step = -_least(jacobian * unit, values, RANK)
        previous, size = size, np.abs(step).max(axis=1, initial=0.0)
        moving &= size <= contraction * previous
        if not moving.any():
            break
        points = retract(points, step * unit * moving[:, None])
        values, jacobian = equations(points)
        converged |= moving & (
            (size < tolerance) | (np.abs(values).max(axis=1, initial=0.0) < tolerance)
        )
        moving &= ~converged
    return Solved(points, values, jacobian, size, converged)


def poses_after(poses: Array, step: Array) -> Array:
    """Return poses (k, 3, 4) after rotations and displacements (k, 6).

    Steps with large rotations are shortened.
    """
    turn = np.linalg.norm(step[:, :3], axis=1, keepdims=True)
    step = step * np.minimum(1.0, MAX_TURN / np.maximum(turn, 1e-300))
    R, t = moved_poses(poses[:, :, :3], poses[:, :, 3], step[:, :3], step[:, 3:])
    return np.concatenate([R, t[..., None]], axis=2)


def postures_after(points: Array, step: Array) -> Array:
    """Return poses with readings (k, 12 + n) after steps (k, 6 + n); see :func:`poses_after`."""
    poses = poses_after(points[:, :12].reshape(-1, 3, 4), step[:, :6])
    return np.concatenate([poses.reshape(-1, 12), points[:, 12:] + step[:, 6:]], axis=1)


def _rows(chosen: BoolArray) -> BoolArray | slice:
    """Return an index of the chosen rows, without a copy if all are chosen."""
    return slice(None) if chosen.all() else chosen


def _damped(jacobian: Array, values: Array, damping: Array, rank: float) -> Array:
    """Return steps (k, n), with damping relative to the mean eigenvalue."""
    free = damping < MIN_DAMPING
    if free.all():
        return -_least(jacobian, values, rank)
    transposed = np.swapaxes(jacobian, 1, 2)
    normal = transposed @ jacobian
    diagonal = np.einsum("knn->kn", normal)
    mean = np.maximum(diagonal.mean(axis=1), 1e-12)
    diagonal += np.where(free, 1.0, damping * mean)[:, None]
    step = -np.linalg.solve(normal, transposed @ values[..., None])[..., 0]
    if free.any():
        step[free] = -_least(jacobian[free], values[free], rank)
    return np.asarray(step)


def _least(jacobian: Array, values: Array, rank: float) -> Array:
    """Return the minimum-norm least-squares solutions (k, n) of linear equations.

    Square ones without a near dependence are solved directly.
    """
    steps = np.full((len(values), jacobian.shape[2]), np.inf)
    if jacobian.shape[1] == jacobian.shape[2]:
        with suppress(np.linalg.LinAlgError):
            steps = np.linalg.solve(jacobian, values[..., None])[..., 0]
    far = ~(np.abs(steps).max(axis=1, initial=0.0) < 1.0)
    if far.any():
        steps[far] = (np.linalg.pinv(jacobian[far], rcond=rank) @ values[far, :, None])[..., 0]
    return np.asarray(steps)
