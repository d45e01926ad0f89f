"""What the covariance of the parameters means at the platform."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array
from legcal.mechanism.leg import LegKind
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.parameters import KinematicParameters
from legcal.mechanism.parametrization import parametrize
from legcal.mechanism.sensitivity import pose_sensitivity


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
    legs = _legs(parameters)
    names = [f"leg{j + 1}" for j in range(len(legs))]
    J = pose_sensitivity(
        legs,
        parametrize(names, legs, frame_legs),
        frame_legs,
        np.array([T.rotation.as_matrix() for T in T_Rb_Re]).reshape(-1, 3, 3),
        np.array([T.translation for T in T_Rb_Re]).reshape(-1, 3),
    )
    variance = np.einsum("kia,ab,kib->ki", J, covariance, J, optimize=True)
    return PlatformError(np.sqrt(variance[:, 3:].sum(axis=1)), np.sqrt(variance[:, :3].sum(axis=1)))


def _legs(parameters: KinematicParameters) -> list[LegGeometry]:
    """Return legs with point-like joints; those without an offset are passive."""
    kinds = np.where(np.isfinite(parameters.offsets), LegKind.ACTUATED, LegKind.PASSIVE)
    joints = zip(parameters.base_joints, parameters.platform_joints, strict=True)
    return [
        LegGeometry("S", "S", LegKind(kind), A, B, float(q0))
        for (A, B), kind, q0 in zip(joints, kinds, parameters.offsets, strict=True)
    ]
