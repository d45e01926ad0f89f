"""Poses of the platform as the paper has them: of R_e in R_b, and how two of them differ."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.frames import product
from legcal.geometry.types import Array
from legcal.mechanism.model import Mechanism


def platform_in_base(mechanism: Mechanism, T_base_platform: RigidTransform) -> RigidTransform:
    """Return T_Rb_Re, the pose of the frame on the platform joints, from that of the links."""
    return product(mechanism.T_base_Rb.inv(), T_base_platform, mechanism.T_platform_Re)


def pose_differences(
    poses: Sequence[RigidTransform], references: Sequence[RigidTransform]
) -> tuple[Array, Array]:
    """Return the displacement [m] and the rotation angle [rad] between poses of R_e, eq (20).

    Parameters
    ----------
    poses, references : sequence of RigidTransform
        T_Rb_Re of two models at the same readings.

    Returns
    -------
    displacement : (n_poses,) array
        Delta X: of the platform joint of the first frame leg, the origin of R_e [m].
    rotation : (n_poses,) array
        Delta E: the angle of the rotation between both orientations [rad].
    """
    T, T_reference = (
        np.array([pose.as_matrix() for pose in several]).reshape(-1, 4, 4)
        for several in (poses, references)
    )
    displacement = np.linalg.norm(T[:, :3, 3] - T_reference[:, :3, 3], axis=1)
    if len(T) == 0:
        return displacement, np.zeros(0)
    between = np.swapaxes(T_reference[:, :3, :3], 1, 2) @ T[:, :3, :3]
    return displacement, np.asarray(Rotation.from_matrix(between).magnitude())
