"""What a fit means at the platform: what it changes there, and how well that is known.

Errors over the workspace are those at a hundred poses all over the travel, the same at which
``legcal evaluate`` compares two models.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.calibration.joint_fit.sensitivity import Sensitivity
from legcal.calibration.joint_fit.variables import platform_poses
from legcal.errors import DidNotConverge
from legcal.estimation.problem import Frames
from legcal.geometry.types import Array, BoolArray
from legcal.machine.configurations import workspace
from legcal.machine.equations import pose_sensitivity
from legcal.machine.kinematics import platforms_in_base, pose_differences
from legcal.machine.leg import Leg, LegKind
from legcal.machine.model import Machine
from legcal.machine.parameters import Parametrization, geometries


@dataclass(frozen=True, eq=False)
class PlatformError:
    """How far the platform is off at poses, one number a pose.

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
    """Return one standard deviation of the platform at poses."""
    variance = np.sum((by_parameters @ covariance) * by_parameters, axis=2)
    return PlatformError(_root_of_sum(variance[:, 3:]), _root_of_sum(variance[:, :3]))


def moved_by(by_parameters: Array, changes: Array) -> PlatformError:
    """Return how far small changes of the parameters move the platform at poses."""
    motion = np.sum((by_parameters @ changes) ** 2, axis=2)
    return PlatformError(_root_of_sum(motion[:, 3:]), _root_of_sum(motion[:, :3]))


def _root_of_sum(squares: Array) -> Array:
    """Return the root of sums of squares, (n_poses,), which rounding may leave below zero."""
    return np.asarray(np.sqrt(np.maximum(squares.sum(axis=1), 0.0)))


# Of the length of a leg
_REACHED = 2.5e-8
_REACHED_BY_ALL = 0.03  # how far readings of redundant motors may disagree


@dataclass(frozen=True, eq=False)
class Effect:
    """What a mistake in something that counts as known would do to the platform."""

    what: str  # the mistake: ``a focal length 1 % longer``
    # How far the platform would move, over the workspace; at the readings of the dataset where that
    # is not known
    error: PlatformError


@brief
@dataclass(frozen=True, eq=False)
class PlatformAccuracy:
    """What a fit means at the platform; angles and distances as in :class:`PlatformError`."""

    # From the nominal to the calibrated platform at the readings of every pose
    change: PlatformError
    sigma: PlatformError  # Predicted error of the calibrated platform there, one standard deviation
    # The same at poses all over the travel; None where the model cannot reach them
    workspace: PlatformError | None
    effects: tuple[Effect, ...]  # what mistakes in what counts as known would do


def platform_accuracy(
    machine: Machine,
    legs: Sequence[Leg],
    parametrization: Parametrization,
    covariance: Array,
    q: Array,
    T_Rb_Re: Sequence[RigidTransform],
    sensitivities: Sequence[Sensitivity] = (),
) -> PlatformAccuracy | None:
    """Return what calibrated legs mean at the platform.

    Raises
    ------
    NotIdentifiable
        If the readings of a pose do not determine it: the machine is singular there.
    """
    if not machine.is_determined:
        return None

    def follow(poses: Sequence[RigidTransform]) -> Array:
        """Return how calibrated poses move with the parameters."""
        return platform_by_parameters(legs, parametrization, machine.frame_legs, poses)

    calibrated = poses_at_readings(machine, legs, q, T_Rb_Re)
    nominal = poses_at_readings(machine, geometries(machine), q, T_Rb_Re)
    here, poses = follow(calibrated), _workspace_poses(machine, legs)
    everywhere = None if poses is None else follow(poses)
    judged = here if everywhere is None else everywhere
    return PlatformAccuracy(
        PlatformError(*pose_differences(calibrated, nominal)),
        expected_error(here, covariance),
        None if everywhere is None else expected_error(everywhere, covariance),
        tuple(Effect(s.what, moved_by(judged, s.steps)) for s in sensitivities),
    )


def _workspace_poses(machine: Machine, legs: Sequence[Leg]) -> Sequence[RigidTransform] | None:
    """Return where calibrated legs put the platform at readings all over the travel."""
    try:
        readings, drawn = workspace(machine)
    except DidNotConverge:  # travel or home of the model forbid it, which harms no calibration
        return None
    poses = poses_at_readings(machine, legs, readings, platforms_in_base(machine, drawn))
    reached = np.flatnonzero(reach_readings(machine, legs, readings, poses))
    return [poses[k] for k in reached] or None


def reach_readings(
    machine: Machine, legs: Sequence[Leg], q: Array, T_Rb_Re: Sequence[RigidTransform]
) -> BoolArray:
    """Return at which poses (n_poses,) the legs have the lengths of their readings.

    Some lengths are possible nowhere, and :func:`poses_at_readings` then gives the nearest pose.
    """
    R, t = Frames.of(T_Rb_Re)
    reached = np.ones(len(t), dtype=np.bool_)
    for leg, reading in zip(legs, q.T, strict=True):
        if leg.kind is LegKind.ACTUATED:
            A, wanted = leg.A, leg.sign * reading + leg.q0
        elif leg.actuator is not None:
            A, wanted = leg.actuator.at(leg.A, reading), leg.q0
        else:
            continue
        length = np.linalg.norm(R @ leg.B + t - A, axis=1)
        most = _REACHED_BY_ALL if machine.is_redundant else _REACHED
        reached &= np.abs(length - wanted) < most * length
    return reached


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
