"""Rigid motions inside the steps: registration of points, and unknown motions in CasADi."""

from __future__ import annotations

import casadi as ca
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array


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
    centre_from, centre_to = P_from.mean(axis=0), P_to.mean(axis=0)
    U, _, Vt = np.linalg.svd((P_to - centre_to).T @ (P_from - centre_from))
    handed = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    rotation = Rotation.from_matrix(U * handed @ Vt)
    return RigidTransform.from_components(centre_to - rotation.apply(centre_from), rotation)


def moved_points(step: ca.SX, start: RigidTransform, points: ca.SX) -> ca.SX:
    """Return points moved by an unknown rigid motion, counted from a start.

    Parameters
    ----------
    step : (6, 1) SX
        Translation [m], and Gibbs vector w of the turn that follows the start's rotation:
        tan(angle / 2) along the axis. It has no branches and no square root.
    start : RigidTransform
        The motion at step = 0.
    points : (3, n) SX
        Points, one a column.

    Returns
    -------
    (3, n) SX
    """
    turned = ca.mtimes(ca.DM(start.rotation.as_matrix()), points)
    w = step[3:]
    cross = ca.skew(w)
    matrix = ca.SX.eye(3) + 2.0 / (1.0 + ca.dot(w, w)) * (cross + ca.mtimes(cross, cross))
    shift = ca.DM(start.translation) + step[:3]
    return ca.mtimes(matrix, turned) + ca.repmat(shift, 1, points.shape[1])


def moved(step: Array, start: RigidTransform) -> RigidTransform:
    """Return the motion that :func:`moved_points` applies, for numbers."""
    w = step[3:]
    size = float(np.linalg.norm(w))
    turn = Rotation.from_rotvec(w * (2.0 * np.arctan(size) / size if size > 0.0 else 2.0))
    return RigidTransform.from_components(start.translation + step[:3], turn * start.rotation)


def whitener(covariance: Array) -> Array:
    """Return W with W covariance W' = 1, for symmetric positive covariances (..., n, n)."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))
