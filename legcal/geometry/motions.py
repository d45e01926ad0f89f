"""Rigid motions."""

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array

_ONE = np.eye(3)


def frame_on_points(
    points: Array,  # (3, 3) joint centres in some frame L [m]
    normal: Array | None = None,  # (3,) unit normal of the plane of motion in L, for two points
) -> RigidTransform:
    """Return the frame that three points define: origin, x axis, xy plane (z completes).

    Two points define the frame of a planar mechanism: its z axis is the normal of the plane, its
    x axis the direction of the second point in that plane.
    """
    x = points[1] - points[0]
    spread = float(np.linalg.norm(points - points[0], axis=1).max())
    if len(points) == 3:
        z = np.cross(x, points[2] - points[0])
    else:
        z = np.array([0.0, 0.0, 1.0]) if normal is None else normal
        x = x - (x @ z) * z
        z = z * float(x @ x)
    if spread == 0.0 or np.linalg.norm(z) < 1e-9 * spread**2:
        raise ValueError("the points that should define a frame coincide or are collinear")
    x = x / np.linalg.norm(x)
    z = z / np.linalg.norm(z)
    return motion_of(np.column_stack([x, np.cross(z, x), z]), points[0])


def motion_of(
    R: Array,  # (..., 3, 3) rotation matrix, orthogonal but for rounding, which is corrected
    t: Array,  # (..., 3) translation [m]
) -> RigidTransform:
    """Return the rigid motion of a rotation matrix and a translation.

    Quick: ``RigidTransform.from_components`` decomposes every matrix anew, which is most of the
    time of reading a model.
    """
    matrix = np.zeros((*R.shape[:-2], 4, 4))
    matrix[..., :3, :3] = R @ (1.5 * _ONE - 0.5 * (np.swapaxes(R, -1, -2) @ R))
    matrix[..., :3, 3] = t
    matrix[..., 3, 3] = 1.0
    return RigidTransform(matrix, normalize=False, copy=False)


def product(*motions: RigidTransform) -> RigidTransform:
    """Return the product of motions, as ``*`` does, quickly; see :func:`motion_of`."""
    matrix = motions[0].as_matrix()
    for motion in motions[1:]:
        matrix = matrix @ motion.as_matrix()
    return motion_of(matrix[..., :3, :3], matrix[..., :3, 3])


def roll_pitch_yaw(
    rotation: Array,  # (3, 3) rotation matrix
) -> Array:
    """Return the angles of a rotation about fixed x, y, z, (3,) [rad], to rounding everywhere.

    Near a pitch of 90 degrees the yaw is badly determined: whatever it comes out as, the roll
    makes up for it.
    """
    r = rotation
    yaw = np.arctan2(r[1, 0], r[0, 0])
    s, c = np.sin(yaw), np.cos(yaw)
    pitch = np.arctan2(-r[2, 0], np.hypot(r[0, 0], r[1, 0]))
    roll = np.arctan2(s * r[0, 2] - c * r[1, 2], c * r[1, 1] - s * r[0, 1])
    return np.array([roll, pitch, yaw])
