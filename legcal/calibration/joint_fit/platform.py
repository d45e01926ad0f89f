"""Accuracy of a fit at the platform: change of its poses, and their predicted errors.

Errors over the workspace are at a hundred poses all over the travel, the poses at which ``legcal
evaluate`` compares two models.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.calibration.joint_fit.variables import platform_poses
from legcal.errors import DidNotConverge
from legcal.estimation.problem import Frames
from legcal.geometry.types import Array, BoolArray
from legcal.machine.configurations import workspace
from legcal.machine.equations import pose_sensitivity
from legcal.machine.kinematics import platforms_in_base, pose_differences
from legcal.machine.leg import Leg
from legcal.machine.model import Machine
from legcal.machine.parameters import Parametrization, geometries
from legcal.machine.rods import length_errors


@dataclass(frozen=True, eq=False)
class PlatformError:
    """Errors of the platform at poses.

    Notes
    -----
    A predicted error is one standard deviation of the whole vector: the root of the expected
    square of its length.
    """

    # (n_poses,) Displacement of the origin of R_e, the platform joint of the first frame leg [m]
    displacement: Array
    rotation: Array  # (n_poses,) angle of rotation [rad]

    @property
    def mean_displacement(self) -> float:
        """Mean over the poses [m]."""
        return float(self.displacement.mean())

    @property
    def mean_rotation(self) -> float:
        """Mean over the poses [rad]."""
        return float(self.rotation.mean())

    @property
    def rms(self) -> tuple[float, float]:
        """Root mean squares over the poses: displacement [m], rotation [rad]."""
        displacement, rotation = (x @ x / len(x) for x in (self.displacement, self.rotation))
        return float(np.sqrt(displacement)), float(np.sqrt(rotation))

    @property
    def max_displacement(self) -> float:
        """Largest of all poses [m]."""
        return float(self.displacement.max())

    @property
    def max_rotation(self) -> float:
        """Largest of all poses [rad]."""
        return float(self.rotation.max())


def platform_by_parameters(
    legs: Sequence[Leg],
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
    return pose_sensitivity(legs, parametrization, frame_legs, *Frames.of(T_Rb_Re))


def expected_error(by_parameters: Array, covariance: Array) -> PlatformError:
    """Return the predicted error of the platform at poses, one standard deviation."""
    variance = np.sum((by_parameters @ covariance) * by_parameters, axis=2)
    return PlatformError(_root_of_sum(variance[:, 3:]), _root_of_sum(variance[:, :3]))


def moved_by(by_parameters: Array, changes: Array) -> PlatformError:
    """Return the motion of the platform at poses by small changes of the parameters."""
    motion = np.sum((by_parameters @ changes) ** 2, axis=2)
    return PlatformError(_root_of_sum(motion[:, 3:]), _root_of_sum(motion[:, :3]))


def _root_of_sum(squares: Array) -> Array:
    """Root of sums of squares, (n_poses,), clipped against negative rounding."""
    return np.asarray(np.sqrt(np.maximum(squares.sum(axis=1), 0.0)))


# Leg lengths: residual of a pose that reaches its readings
_REACHED = 2.5e-8
_REACHED_BY_ALL = 0.03  # with redundant motors, whose readings may disagree


@brief
@dataclass(frozen=True, eq=False)
class PlatformAccuracy:
    """Accuracy at the platform; angles and distances as in :class:`PlatformError`."""

    # From the nominal to the calibrated platform at the readings of every pose
    change: PlatformError
    sigma: PlatformError  # Predicted error of the calibrated platform there, one standard deviation
    # Predicted error over the travel; None where the model cannot reach it
    workspace: PlatformError | None
    # Motion by errors of fixed quantities, by what they are: over the workspace, or at the readings
    # of the dataset if that is unknown
    effects: Mapping[str, PlatformError]


def platform_accuracy(
    machine: Machine,
    legs: Sequence[Leg],
    parametrization: Parametrization,
    covariance: Array,
    q: Array,
    T_Rb_Re: Sequence[RigidTransform],
    sensitivities: Mapping[str, Array],
) -> PlatformAccuracy | None:
    """Return the accuracy of calibrated legs at the platform.

    Raises
    ------
    NotIdentifiable
        If the readings of a pose do not determine it: the machine is singular there.
    """
    if not machine.is_determined:
        return None

    def follow(poses: Sequence[RigidTransform]) -> Array:
        """Return derivatives (n_poses, 6, p) of calibrated poses by the parameters."""
        return platform_by_parameters(legs, parametrization, machine.frame_legs, poses)

    calibrated = poses_at_readings(machine, legs, q, T_Rb_Re)
    nominal = poses_at_readings(machine, geometries(machine), q, T_Rb_Re)
    sensitivity_at_readings, poses = follow(calibrated), workspace_poses(machine, legs)
    sensitivity_in_workspace = None if poses is None else follow(poses)
    judged_sensitivity = (
        sensitivity_at_readings if sensitivity_in_workspace is None else sensitivity_in_workspace
    )
    return PlatformAccuracy(
        PlatformError(*pose_differences(calibrated, nominal)),
        expected_error(sensitivity_at_readings, covariance),
        None
        if sensitivity_in_workspace is None
        else expected_error(sensitivity_in_workspace, covariance),
        {what: moved_by(judged_sensitivity, steps) for what, steps in sensitivities.items()},
    )


def workspace_poses(machine: Machine, legs: Sequence[Leg]) -> Sequence[RigidTransform] | None:
    """Poses of the calibrated platform at readings all over the travel."""
    try:
        readings, drawn = workspace(machine)
    except DidNotConverge:  # of travel or home of the model; not needed for calibration
        return None
    poses = poses_at_readings(machine, legs, readings, platforms_in_base(machine, drawn))
    reached = np.flatnonzero(reach_readings(machine, legs, readings, poses))
    return [poses[k] for k in reached] or None


def reach_readings(
    machine: Machine, legs: Sequence[Leg], q: Array, T_Rb_Re: Sequence[RigidTransform]
) -> BoolArray:
    """Return a mask of poses (n_poses,) where the legs have the lengths of their readings.

    For readings without a pose, :func:`poses_at_readings` returns the nearest pose.
    """
    R, t = Frames.of(T_Rb_Re)
    motors = [leg.is_motor for leg in legs]
    most = _REACHED_BY_ALL if machine.is_redundant else _REACHED
    errors = length_errors(legs, R, t, q)[:, motors]
    return np.asarray(np.all(np.abs(errors) < most * machine.size, axis=1))


def poses_at_readings(
    machine: Machine,
    legs: Sequence[Leg],
    q: Array,
    nearby: Sequence[RigidTransform],
) -> tuple[RigidTransform, ...]:
    """Return T_Rb_Re of legs at readings (n_poses, n_legs), near known poses."""
    read = np.array([leg.is_motor for leg in legs], dtype=np.bool_)
    lengthening = np.where(read, machine.sign * q, np.nan)
    return platform_poses(legs, lengthening, nearby, machine.frame_legs)
