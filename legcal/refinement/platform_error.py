"""What errors of the parameters mean at the platform, the motors at their readings: eq (20).

A small change d_xi of the parameters moves the platform by J d_xi at a pose. A covariance C of the
parameters is one of J C J^T there: the same readings, given to the calibrated model and to the
true machine, put the platform that far apart. Errors of the readings are not in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.parametrization import Parametrization
from legcal.mechanism.sensitivity import pose_sensitivity
from legcal.refinement.state import components


@dataclass(frozen=True, eq=False)
class PlatformError:
    """How far the platform is off at poses, one number a pose.

    Attributes
    ----------
    displacement : (n_poses,) array
        Displacement of the origin of R_e, the platform joint of the first frame leg [m].
    rotation : (n_poses,) array
        Angle of rotation [rad].

    Notes
    -----
    A predicted error is one standard deviation of the whole vector: the root of the expected
    square of its length.
    """

    displacement: Array
    rotation: Array

    @property
    def mean_displacement(self) -> float:
        """Mean over the poses [m]."""
        return float(self.displacement.mean())

    @property
    def mean_rotation(self) -> float:
        """Mean over the poses [rad]."""
        return float(self.rotation.mean())

    @property
    def max_displacement(self) -> float:
        """Largest of all poses [m]."""
        return float(self.displacement.max())

    @property
    def max_rotation(self) -> float:
        """Largest of all poses [rad]."""
        return float(self.rotation.max())


def predict_platform_error(
    legs: Sequence[LegGeometry],
    parametrization: Parametrization,
    covariance: Array,
    frame_legs: Sequence[int],
    T_Rb_Re: Sequence[RigidTransform],
) -> PlatformError:
    """Return the predicted platform error at poses, one standard deviation.

    Parameters
    ----------
    legs : sequence of LegGeometry
        The calibrated legs in R_b and R_e.
    parametrization : Parametrization
        Their parameters.
    covariance : (p, p) array
        The covariance of these parameters [m^2, m rad, rad^2]; zero for what is known.
    frame_legs : sequence of int
        The legs that define R_b and R_e: three in space, two in a plane.
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
    J = platform_by_parameters(legs, parametrization, frame_legs, T_Rb_Re)
    return expected_error(J, covariance)


def platform_by_parameters(
    legs: Sequence[LegGeometry],
    parametrization: Parametrization,
    frame_legs: Sequence[int],
    T_Rb_Re: Sequence[RigidTransform],
) -> Array:
    """Return the derivative of platform poses by the parameters, (n_poses, 6, p).

    Rotation vectors in R_b come first [rad], displacements of the origin of R_e second [m].

    Raises
    ------
    NotIdentifiable
        If the readings do not determine a pose.
    """
    return pose_sensitivity(legs, parametrization, frame_legs, *components(T_Rb_Re))


def expected_error(by_parameters: Array, covariance: Array) -> PlatformError:
    """Return one standard deviation of the platform at poses.

    Parameters
    ----------
    by_parameters : (n_poses, 6, p) array
        From :func:`platform_by_parameters`.
    covariance : (p, p) array
        Of the parameters.
    """
    variance = np.sum((by_parameters @ covariance) * by_parameters, axis=2)
    return PlatformError(_root_of_sum(variance[:, 3:]), _root_of_sum(variance[:, :3]))


def moved_by(by_parameters: Array, changes: Array) -> PlatformError:
    """Return how far small changes of the parameters move the platform at poses.

    Parameters
    ----------
    by_parameters : (n_poses, 6, p) array
        From :func:`platform_by_parameters`.
    changes : (p, c) array
        Independent changes of the parameters [m, rad], of which the root of the sum of squares
        is told.
    """
    motion = np.sum((by_parameters @ changes) ** 2, axis=2)
    return PlatformError(_root_of_sum(motion[:, 3:]), _root_of_sum(motion[:, :3]))


def _root_of_sum(squares: Array) -> Array:
    """Return the root of sums of squares, (n_poses,), which rounding may leave below zero."""
    return np.asarray(np.sqrt(np.maximum(squares.sum(axis=1), 0.0)))
