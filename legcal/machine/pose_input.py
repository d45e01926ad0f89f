"""Poses as callers give them: transforms of SciPy, SE3 of Pinocchio, matrices."""

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from legcal.errors import UsageError
from legcal.geometry.motions import motion_of
from legcal.geometry.types import Array


class Homogeneous(Protocol):
    """A motion as Pinocchio's ``SE3``."""

    @property
    def homogeneous(self) -> Array:
        """The matrix (4, 4)."""


Pose = RigidTransform | Homogeneous | ArrayLike  # of callers
MAX_ROUNDING = 1e-4  # of rotation matrices of callers, such as printed ones


def pose_of(pose: Pose) -> RigidTransform:
    """Return a pose given as a transform of SciPy, an SE3 of Pinocchio or a matrix (4, 4) [m].

    Raises
    ------
    UsageError
        If it is no rigid motion.
    """
    if isinstance(pose, RigidTransform) and pose.single:
        return pose
    matrix = getattr(pose, "homogeneous", pose)
    if isinstance(matrix, RigidTransform):
        matrix = matrix.as_matrix()
    try:
        T = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError):
        T = np.empty(0)
    needed = "needed one RigidTransform, pinocchio.SE3 or matrix (4, 4) in metres"
    if T.shape != (4, 4):
        kind = f"an array of shape {T.shape}" if T.size else f"a {type(pose).__name__}"
        raise UsageError(f"The pose could not be read: found {kind}, {needed}; convert it.")
    R = T[:3, :3]
    wrong = np.abs(R @ R.T - np.eye(3)).max(initial=np.abs(T[3] - [0.0, 0.0, 0.0, 1.0]).max())
    if not (np.all(np.isfinite(T)) and wrong <= MAX_ROUNDING and np.linalg.det(R) > 0.0):
        raise UsageError(
            "The pose could not be read: found a matrix that is no rigid motion, needed a rotation "
            "matrix, a translation in metres, and 0 0 0 1 in the last row; correct the matrix."
        )
    return motion_of(R, T[:3, 3])
