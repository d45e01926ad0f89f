"""Rotation matrices and vector products, batched along the leading axes."""

import numpy as np
from scipy.spatial.transform import Rotation

from legcal.geometry.lines import cross, normal_basis
from legcal.geometry.types import Array

_HALF_MORE = 1.5 * np.eye(3)


def cross_matrices(v: Array) -> Array:
    """Return the matrices (..., 3, 3) of w -> v x w."""
    matrix = np.zeros((*v.shape[:-1], 3, 3))
    matrix[..., [2, 0, 1], [1, 2, 0]] = v
    matrix[..., [1, 2, 0], [2, 0, 1]] = -v
    return matrix


def rotation_matrices(w: Array) -> Array:
    """Return the rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad]."""
    return np.asarray(
        Rotation.from_rotvec(w.reshape(-1, 3)).as_matrix().reshape(*w.shape[:-1], 3, 3)
    )


def cayley(w: Array) -> Array:
    """Return Cayley's rotation matrices (..., 3, 3) of w (..., 3), rotations by w [rad] if small.

    w / 2 is the Gibbs vector, tan(angle / 2) along the axis: no branches and no square root.
    """
    K = cross_matrices(0.5 * w)
    scale = 2.0 / (1.0 + 0.25 * np.sum(w**2, axis=-1))[..., None, None]
    return np.asarray(np.eye(3) + scale * (K + K @ K))


def turned(R: Array, w: Array) -> Array:
    """Return rotation matrices rotated from the left by :func:`cayley`, orthogonal to rounding."""
    return orthogonal(cayley(w) @ R)


def orthogonal(R: Array) -> Array:
    """Return rotation matrices (..., 3, 3) with their rounding errors corrected."""
    return np.asarray(R @ (_HALF_MORE - 0.5 * (np.swapaxes(R, -1, -2) @ R)))


def nearest_rotation(matrix: Array) -> Array:
    """Return the nearest rotation matrices to matrices (..., 3, 3), never reflections."""
    U, _, Vt = np.linalg.svd(matrix)
    flip = np.ones(U.shape[:-1])
    flip[..., 2] = np.sign(np.linalg.det(U @ Vt))
    return np.asarray((U * flip[..., None, :]) @ Vt)


def rotation_between(first: Array, second: Array) -> Rotation:
    """Return the smallest rotation of one unit direction (3,) onto another."""
    normal = cross(first, second)
    sine, cosine = float(np.linalg.norm(normal)), float(first @ second)
    if sine == 0.0:
        return Rotation.from_rotvec((0.0 if cosine > 0.0 else np.pi) * normal_basis(first)[0])
    return Rotation.from_rotvec(np.arctan2(sine, cosine) / sine * normal)


def roll_pitch_yaw(rotation: Array) -> Array:
    """Return the angles of a rotation matrix about fixed x, y, z, (3,) [rad], to rounding.

    Near a pitch of 90 degrees the yaw is poorly determined, and the roll compensates for it.
    """
    r = rotation
    yaw = np.arctan2(r[1, 0], r[0, 0])
    s, c = np.sin(yaw), np.cos(yaw)
    pitch = np.arctan2(-r[2, 0], np.hypot(r[0, 0], r[1, 0]))
    roll = np.arctan2(s * r[0, 2] - c * r[1, 2], c * r[1, 1] - s * r[0, 1])
    return np.array([roll, pitch, yaw])
