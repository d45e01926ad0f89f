"""What the covariance of the parameters means at the platform.

Legs keep their lengths, so an error d xi of the parameters moves the platform by
delta = -J_pose^-1 J_xi d xi: implicit differentiation of |R B + t - A| = sign q + q0.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array
from legcal.mechanism.parameters import KinematicParameters, free_coordinates


@dataclass(frozen=True, eq=False)
class PlatformError:
    """Predicted errors of the pose of R_e in R_b, one standard deviation.

    Attributes
    ----------
    displacement : (n_poses,) array
        Root mean square displacement of the origin of R_e [m].
    rotation : (n_poses,) array
        Root mean square angle of rotation [rad].
    """

    displacement: Array
    rotation: Array

    @property
    def mean_displacement(self) -> float:
        """Root mean square over all poses [m]."""
        return float(np.sqrt(np.mean(self.displacement**2)))

    @property
    def mean_rotation(self) -> float:
        """Root mean square over all poses [rad]."""
        return float(np.sqrt(np.mean(self.rotation**2)))


def pose_sensitivity(
    parameters: KinematicParameters, frame_legs: Sequence[int], T_Rb_Re: Sequence[RigidTransform]
) -> Array:
    """Return the derivative of platform poses with respect to the parameters, readings given.

    Parameters
    ----------
    parameters : KinematicParameters
        Joints in R_b and R_e, offsets [m]; legs without an offset are left out.
    frame_legs : sequence of 3 int
        The legs that define R_b and R_e.
    T_Rb_Re : sequence of RigidTransform
        Platform poses.

    Returns
    -------
    (n_poses, 6, n_parameters) array
        Rotation vector in R_b [rad/m] and displacement of the origin of R_e, by the free
        parameters.

    Raises
    ------
    NotIdentifiable
        If the readings do not determine a pose.
    """
    measured = np.isfinite(parameters.offsets)
    R = np.array([T.rotation.as_matrix() for T in T_Rb_Re]).reshape(-1, 3, 3)
    t = np.array([T.translation for T in T_Rb_Re]).reshape(-1, 1, 3)
    arm = np.einsum("kij,lj->kli", R, parameters.platform_joints)
    leg = arm + t - parameters.base_joints
    u = leg / np.linalg.norm(leg, axis=-1, keepdims=True)
    n_legs = len(measured)
    by_joint = np.zeros((2, len(R), n_legs, n_legs, 3))
    each = np.arange(n_legs)
    by_joint[0][:, each, each] = -u
    by_joint[1][:, each, each] = np.einsum("kji,klj->kli", R, u)
    free = free_coordinates(n_legs, frame_legs)
    by_offset = np.broadcast_to(-np.eye(n_legs), (len(R), n_legs, n_legs))
    J_xi = np.concatenate(
        [by_joint[0][:, :, free], by_joint[1][:, :, free], by_offset[:, :, measured]], axis=-1
    )[:, measured]
    J_pose = np.concatenate([np.cross(arm, u), u], axis=-1)[:, measured]
    singular = np.linalg.svd(J_pose, compute_uv=False)
    bad = np.flatnonzero((singular[:, -1] < 1e-9 * singular[:, 0]) | (singular.shape[1] < 6))
    if len(bad):
        raise NotIdentifiable(
            f"The platform error could not be predicted: the {int(measured.sum())} readings do "
            f"not determine platform pose {bad[0] + 1}, where the machine is singular; six "
            "independent ones are needed; leave this pose out."
        )
    return np.asarray(-np.linalg.pinv(J_pose) @ J_xi)


def predict_platform_error(
    parameters: KinematicParameters,
    covariance: Array,
    frame_legs: Sequence[int],
    T_Rb_Re: Sequence[RigidTransform],
) -> PlatformError:
    """Return the predicted platform error at poses, one standard deviation.

    Parameters
    ----------
    parameters : KinematicParameters
        The calibrated parameters [m].
    covariance : (n_parameters, n_parameters) array
        Their covariance [m^2], as in :class:`legcal.refinement.solution.Solution`.
    frame_legs : sequence of 3 int
        The legs that define R_b and R_e.
    T_Rb_Re : sequence of RigidTransform
        Platform poses.

    Returns
    -------
    PlatformError

    Raises
    ------
    NotIdentifiable
        If the readings do not determine a pose.
    """
    J = pose_sensitivity(parameters, frame_legs, T_Rb_Re)
    variance = np.einsum("kia,ab,kib->ki", J, covariance, J, optimize=True)
    return PlatformError(np.sqrt(variance[:, 3:].sum(axis=1)), np.sqrt(variance[:, :3].sum(axis=1)))
