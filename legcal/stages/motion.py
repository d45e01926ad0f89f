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


def register_groups(P_from: Array, P_to: Array, group: IntArray) -> tuple[Array, Array]:
    """Return the motion of :func:`register_points` for each group of points.

    Parameters
    ----------
    P_from, P_to : (n, 3) array
        The same points in two frames [m].
    group : (n,) array of int
        The group of each point: 0, 1 and so on.

    Returns
    -------
    (n_groups, 3, 3) array, (n_groups, 3) array
        Rotation matrix and translation [m] of T_to_from.
    """
    n_points = np.bincount(group)[:, None]

    def total(values: Array) -> Array:
        found = np.zeros((len(n_points), *values.shape[1:]))
        np.add.at(found, group, values)
        return found

    centre_from, centre_to = total(P_from) / n_points, total(P_to) / n_points
    arm_from, arm_to = P_from - centre_from[group], P_to - centre_to[group]
    U, _, Vt = np.linalg.svd(total(arm_to[:, :, None] * arm_from[:, None, :]))
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    R = U @ Vt
    return R, centre_to - np.einsum("gij,gj->gi", R, centre_from)


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
    w = step[3:]
    cross = ca.skew(w)
    turn = ca.SX.eye(3) + 2.0 / (1.0 + ca.dot(w, w)) * (cross + ca.mtimes(cross, cross))
    return turn @ (R @ points) + ca.repmat(t + step[:3], 1, points.shape[1])


def moved(step: Array, start: RigidTransform) -> RigidTransform:
    """Return the motion that :func:`moved_points` applies, for numbers."""
    w = step[3:]
    size = float(np.linalg.norm(w))
    turn = Rotation.from_rotvec(w * (2.0 * np.arctan(size) / size if size > 0.0 else 2.0))
    return RigidTransform.from_components(start.translation + step[:3], turn * start.rotation)


def whitener(covariance: Array) -> Array:
    """Return W with W covariance W' = 1, for symmetric positive covariances (..., n, n)."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))
