"""Rigid motions inside the steps: registration of points, and unknown motions in CasADi."""

from __future__ import annotations

import casadi as ca
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array, IntArray


def register_points(P_from: Array, P_to: Array) -> RigidTransform:
    """Return the rigid motion that lays points on points best, unweighted, in closed form.

    A mirror is never returned, and coplanar points are enough.

    Parameters
    ----------
    P_from, P_to : (n, 3) array
        The same points in two frames [m], at least three and not collinear.

    Returns
    -------
    RigidTransform
        T_to_from.
    """
    R, t = register_groups(P_from, P_to, np.zeros(len(P_from), dtype=np.intp))
    return RigidTransform.from_components(t[0], Rotation.from_matrix(R[0]))


def register_groups(
    P_from: Array, P_to: Array, group: IntArray, weight: Array | None = None
) -> tuple[Array, Array]:
    """Return the motion of :func:`register_points` for each group of points.

    Parameters
    ----------
    P_from, P_to : (n, 3) array
        The same points in two frames [m].
    group : (n,) array of int
        The group of each point: 0, 1 and so on.
    weight : (n,) array, optional
        Weight of each point; all weigh the same without it.

    Returns
    -------
    (n_groups, 3, 3) array, (n_groups, 3) array
        Rotation matrix and translation [m] of T_to_from.
    """
    arm_from, arm_to, centre_from, centre_to, weight = _arms(P_from, P_to, group, weight)
    moment = np.zeros((len(centre_to), 3, 3))
    np.add.at(moment, group, weight[:, None, None] * arm_to[:, :, None] * arm_from[:, None, :])
    U, _, Vt = np.linalg.svd(moment)
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    R = U @ Vt
    return R, centre_to - np.einsum("gij,gj->gi", R, centre_from)


def register_in_plane(
    P_from: Array, P_to: Array, group: IntArray, weight: Array | None = None
) -> tuple[Array, Array]:
    """Return the motion in the plane z = 0 that lays points on points best, for each group.

    Two points are enough; heights are not looked at. Otherwise as :func:`register_groups`.
    """
    arm_from, arm_to, centre_from, centre_to, weight = _arms(P_from, P_to, group, weight)
    (x, y), (i, j) = arm_from.T[:2], arm_to.T[:2]
    sine, cosine = (
        np.bincount(group, weights=weight * part) for part in (x * j - y * i, x * i + y * j)
    )
    R = Rotation.from_rotvec(np.arctan2(sine, cosine)[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    t = centre_to - np.einsum("gij,gj->gi", R, centre_from)
    t[:, 2] = 0.0
    return R, t


def _arms(
    P_from: Array, P_to: Array, group: IntArray, weight: Array | None
) -> tuple[Array, Array, Array, Array, Array]:
    """Return points from the centres of their groups, these centres, and the weights."""
    weight = np.ones(len(group)) if weight is None else weight
    whole = np.bincount(group, weights=weight)[:, None]

    def centres(points: Array) -> Array:
        found = np.zeros((len(whole), 3))
        np.add.at(found, group, weight[:, None] * points)
        return found / whole

    centre_from, centre_to = centres(P_from), centres(P_to)
    return P_from - centre_from[group], P_to - centre_to[group], centre_from, centre_to, weight


def moved_points(step: ca.SX, R: ca.SX, t: ca.SX, points: ca.SX) -> ca.SX:
    """Return points moved by an unknown rigid motion, counted from a start.

    Parameters
    ----------
    step : (6, 1) SX
        Translation [m], and Gibbs vector w of the turn that follows the start's rotation:
        tan(angle / 2) along the axis. It has no branches and no square root.
    R, t : (3, 3) SX, (3, 1) SX
        Rotation matrix and translation [m] of the motion at step = 0.
    points : (3, n) SX
        Points, one a column.

    Returns
    -------
    (3, n) SX
    """
    return turned_points(step[3:], R @ points) + ca.repmat(t + step[:3], 1, points.shape[1])


def turned_points(w: ca.SX, points: ca.SX) -> ca.SX:
    """Return points (3, n) turned by the rotation that has the Gibbs vector w (3, 1)."""
    cross = ca.skew(w)
    turn = ca.SX.eye(3) + 2.0 / (1.0 + ca.dot(w, w)) * (cross + ca.mtimes(cross, cross))
    return turn @ points


def moved(step: Array, start: RigidTransform) -> RigidTransform:
    """Return the motion that :func:`moved_points` applies, for numbers."""
    w = step[3:]
    size = float(np.linalg.norm(w))
    turn = Rotation.from_rotvec(w * (2.0 * np.arctan(size) / size if size > 0.0 else 2.0))
    return RigidTransform.from_components(start.translation + step[:3], turn * start.rotation)


def whitener(covariance: Array) -> Array:
    """Return W with W covariance W' = 1, for symmetric positive covariances (..., n, n)."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))
