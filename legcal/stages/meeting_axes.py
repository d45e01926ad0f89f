"""Where axes meet and what they are normal to, eqs (6) and (7): a revolute joint in a camera frame.

The legs of a revolute joint lie in a plane through its centre A, normal to its axis v. In a planar
mechanism all legs of a view share the normal: their bundles form one *pool*.
"""

from __future__ import annotations

import numpy as np

from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array, IntArray
from legcal.observations.leg_axes import LegAxes
from legcal.stages.bundles import Bundles
from legcal.stages.meeting_points import (
    MOST_REWEIGHTINGS,
    derivative_of_miss,
    miss_of_joint,
    progress,
    robust_weights,
)

_LONGEST = 0.2  # step: [rad] of an axis, and in its distance of a centre


def plain_axes(axes: LegAxes, bundles: Bundles, pool: IntArray) -> tuple[Array, Array]:
    """Return v of (7), every equation with the same weight, and the inverse of its normal matrix.

    Parameters
    ----------
    axes : LegAxes
        Axes in the camera frames.
    bundles : Bundles
        Which of them are legs of one joint.
    pool : (n,) array of int
        Bundles with the same number, 0 and so on, share v.

    Returns
    -------
    (n, 3) array, (n, 2, 2) array
        Unit vectors of any sign, and the inverse matrices by turns of v about its
        :func:`legcal.geometry.lines.normal_basis`.
    """
    u = axes.u[bundles.rows]
    scatter = _by_pool(bundles.total(u[:, :, None] * u[:, None, :]), pool)
    v = np.linalg.eigh(scatter)[1][:, :, 0]
    N = normal_basis(v)
    information = N[:, ::-1] @ scatter @ np.swapaxes(N[:, ::-1], 1, 2)
    information *= np.array([[1.0, -1.0], [-1.0, 1.0]])  # v turned about e1 by t is v - t e2
    return v[pool], np.asarray(np.linalg.inv(information))[pool]


def weighted_joints(
    axes: LegAxes, bundles: Bundles, pool: IntArray, A: Array, v: Array
) -> tuple[Array, Array, Array]:
    """Return A and v of revolute joints weighted by the covariances of the axes, (6) and (7).

    What an image knows badly is the tilt of a leg towards the camera. It enters the miss
    of A, in proportion to the distance, and the angle to v: both are weighted together, by their
    joint covariance. The derivatives are those at the adjusted directions, which meet in A and are
    normal to v; at the observed ones, tilts would pass for turns, and v would come out biased.

    Parameters
    ----------
    axes, bundles, pool
        As in :func:`plain_axes`.
    A, v : (n, 3) array
        Points [m] and unit vectors to start from, v the same in a pool.

    Returns
    -------
    A : (n, 3) array
        Centres [m].
    v : (n, 3) array
        Unit vectors, the same in a pool but for bundles that say nothing of their joints.
    covariance : (n, 5, 5) array
        Of A [m^2] and of two turns of v about its normal basis [rad^2].
    """
    A, v, C, going = A.copy(), v.copy(), np.zeros((len(A), 5, 5)), np.arange(len(A))
    for k in range(MOST_REWEIGHTINGS):
        some = bundles.some(np.isin(np.arange(len(A)), going))
        step, C[going] = _step(axes, some, pool[going], A[going], v[going])
        A[going] -= step[:, :3]
        v[going] = turned(v[going], -step[:, 3:])
        moves, sound = progress(k, step, A[going], C[going])
        going = going[sound & np.isin(pool[going], pool[going[moves & sound]])]
        if not len(going):
            break
    return A, v, C


def _step(
    axes: LegAxes, bundles: Bundles, pool: IntArray, A: Array, v: Array
) -> tuple[Array, Array]:
    """Return a Gauss-Newton step (n, 5) of A and v and their covariances (n, 5, 5)."""
    rows, bundle = bundles.rows, bundles.bundle
    residual, spread, tilt = miss_of_joint(axes, rows, A[bundle], v[bundle])
    weight = robust_weights(bundles, residual, spread)
    alpha = (tilt @ np.linalg.solve(spread, residual[..., None]))[..., 0]
    J = derivative_of_miss(axes, rows, v[bundle], alpha)
    back = np.swapaxes(J, 1, 2) @ weight
    right = (back @ residual[..., None])[..., 0]
    of_pool = np.unique(pool, return_inverse=True)[1].ravel()
    step, C = _pooled(bundles.total(back @ J), bundles.total(right), of_pool)
    return _limited(step, np.linalg.norm(A, axis=1)), C


def turned(v: Array, turn: Array) -> Array:
    """Return unit vectors (n, 3) turned about their normal bases by small angles (n, 2)."""
    w = np.einsum("ni,nia->na", turn, normal_basis(v))
    moved = v + np.cross(w, v)
    return np.asarray(moved / np.linalg.norm(moved, axis=1, keepdims=True))


def _limited(step: Array, distance: Array) -> Array:
    """Return steps (n, 5) within which their equations are nearly linear, shorter if need be."""
    size = np.maximum(
        np.linalg.norm(step[:, :3], axis=1) / distance, np.linalg.norm(step[:, 3:], axis=1)
    )
    return np.asarray(step / np.maximum(size / _LONGEST, 1.0)[:, None])


def flipped(covariance: Array) -> Array:
    """Return covariances (..., 5, 5) of A and v as those of A and -v.

    The second vector of the normal basis changes its sign with v.
    """
    sign = np.array([1.0, 1.0, 1.0, 1.0, -1.0])
    return np.asarray(covariance * np.outer(sign, sign))


def _pooled(F: Array, b: Array, pool: IntArray) -> tuple[Array, Array]:
    """Return steps (n, 5) and covariances of A and v from normal equations, v being pooled."""
    C_A = np.linalg.inv(F[:, :3, :3])
    G = -C_A @ F[:, :3, 3:]  # how A follows v
    rest = F[:, 3:, 3:] + np.swapaxes(F[:, :3, 3:], 1, 2) @ G
    right = b[:, 3:] + (np.swapaxes(G, 1, 2) @ b[:, :3, None])[..., 0]
    C_v = np.linalg.inv(_by_pool(rest, pool))
    turn = (C_v @ _by_pool(right, pool)[..., None])[..., 0][pool]
    C_v = C_v[pool]
    A = (C_A @ b[:, :3, None] + G @ turn[..., None])[..., 0]
    C = np.zeros((len(F), 5, 5))
    C[:, :3, :3] = C_A + G @ C_v @ np.swapaxes(G, 1, 2)
    C[:, :3, 3:] = G @ C_v
    C[:, 3:, :3] = np.swapaxes(C[:, :3, 3:], 1, 2)
    C[:, 3:, 3:] = C_v
    return np.column_stack([A, turn]), C


def _by_pool(values: Array, pool: IntArray) -> Array:
    """Return the sums of values (n, ...) over each pool."""
    total = np.zeros((int(pool.max(initial=-1)) + 1, *values.shape[1:]))
    np.add.at(total, pool, values)
    return total
