"""Accuracy of a fit at the platform: change of its poses, and their predicted errors.

Errors over the workspace are at a hundred poses all over the travel, the poses at which ``legcal
evaluate`` compares two models; on pages, at a grid of places in the orientation of home.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.calibration.joint_fit.parameter_choices import Choices
from legcal.calibration.joint_fit.part_errors import part_errors
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.joint_fit.variables import FittedLegs, platform_poses
from legcal.errors import DidNotConverge, NotIdentifiable
from legcal.estimation.problem import Frames
from legcal.geometry.motions import motions_of
from legcal.geometry.types import Array, BoolArray
from legcal.machine.configurations import workspace
from legcal.machine.equations import pose_sensitivity
from legcal.machine.kinematics import platforms_in_base, pose_differences
from legcal.machine.leg import Leg
from legcal.machine.model import Machine, readings_at_poses
from legcal.machine.parameters import (
    Parametrization,
    geometries,
    in_joint_frames,
    parametrization_of,
)
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

    def fields(self, prefix: str = "") -> dict[str, float]:
        """Return means and maxima as documents name them."""
        return {
            f"{prefix}dX_m": self.mean_displacement,
            f"{prefix}dE_rad": self.mean_rotation,
            f"{prefix}dX_max_m": self.max_displacement,
            f"{prefix}dE_max_rad": self.max_rotation,
        }

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

    Raises NotIdentifiable if the readings do not determine a pose.
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


def platform_by_parts(
    machine: Machine, legs: tuple[Leg, ...], J: Array, poses: Sequence[RigidTransform]
) -> Array:
    """Return motions of the platform (n, m) [m] by errors of parts; rotations as joints move."""
    parametrization = parametrization_of(machine, twists=True)
    G = platform_by_parameters(legs, parametrization, machine.frame_legs, poses) @ J
    arm = 0.5 * float(np.linalg.norm(np.ptp(machine.B_platform, axis=0)))
    return np.asarray((G * np.repeat([arm, 1.0], 3)[:, None]).reshape(-1, J.shape[1]))


@dataclass(frozen=True, eq=False)
class WrittenGroup:
    """Parameters of a model in which only a group of parts is calibrated, by errors of parts.

    All else keeps nominal values. The group moves beyond its posterior mean by what serves the
    platform best there: the least squares, over the workspace, of what the posterior means of all
    else do to it; rotations as they move the joints of the platform.
    """

    J: Array  # (p, m) derivatives of the parameters
    left: Array  # (m, m) errors that the model keeps, by posterior means of the errors

    @classmethod
    def of(
        cls, machine: Machine, legs: tuple[Leg, ...], J: Array, chosen: BoolArray
    ) -> WrittenGroup:
        """Return the model with *chosen* parts (m,) of legs in the frames of their joints.

        They do not serve the platform where readings do not determine its pose.
        """
        left = np.diag(np.where(chosen, 0.0, 1.0))
        poses = None
        if machine.is_determined and not chosen.all():
            poses = workspace_poses(machine, legs)
        if poses is not None:
            G = platform_by_parts(machine, legs, J, poses)
            serving = np.linalg.lstsq(G[:, chosen], G[:, ~chosen], rcond=_WELL)[0]
            left[np.ix_(chosen, ~chosen)] = -serving
        return cls(J, left)

    def covariance(self, posterior: Array, squares: Array) -> Array:
        """Return the covariance (p, p) of the parameters.

        By that of the errors after the fit, and the mean squares of their means (m, m).
        """
        return self.J @ (posterior + self.left @ squares @ self.left.T) @ self.J.T


def written_covariance(machine: Machine, legs: FittedLegs, choices: Choices, C: Array) -> Array:
    """Return the covariance (p, p) of the model that is written, C that of all parameters.

    Means of errors after the fit are not known before it: their mean squares are what the fit
    takes from the prior.
    """
    if choices.built is None or choices.only == "all":
        return C
    errors = part_errors(legs, choices.built)
    framed = in_joint_frames(legs.nominal, legs.frame_legs)
    written = WrittenGroup.of(machine, framed, errors.J, errors.of_group(choices.only))
    posterior = errors.posterior(errors.centre, C)[1]
    return written.covariance(posterior, np.diag(errors.sigma**2) - posterior)


def _root_of_sum(squares: Array) -> Array:
    """Root of sums of squares, (n_poses,), clipped against negative rounding."""
    return np.asarray(np.sqrt(np.maximum(squares.sum(axis=1), 0.0)))


_WELL = 1e-3  # of the largest singular value: motions of the platform by a group that count
N_ACROSS, N_LEVELS = 7, 3  # points of the grid in x and y, and in z
MIN_PLACES = 6  # smallest number of reachable points of a grid
_FLAT = 1e-3  # extent of a planar workspace, relative to the largest extent
_CLOSED = 2.5e-6  # largest difference of a point and the pose by its readings [leg lengths, rad]
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

    Raises NotIdentifiable if the readings of a pose do not determine it: the machine is singular
    there.
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


@dataclass(frozen=True, eq=False)
class PlatformMap:
    """Displacements of the platform at places of the workspace."""

    # x, y, z: (n_x,), (n_y,), (n_z,): the grid of origins of the platform link in the base link [m]
    x: Array
    y: Array
    z: Array
    # change, sigma: (n_z, n_y, n_x): change from the nominal to the calibrated model at the same
    # readings, and predicted error of the calibrated model, one standard deviation [m]; NaN out of
    # reach
    change: Array
    sigma: Array


def platform_map(machine: Machine, solution: Solution) -> PlatformMap | None:
    """Return the platform errors over the workspace; None if readings do not determine the pose.

    None also if no random poses can be drawn within the travels of the model, or if it reaches few
    places in the orientation of home.
    """
    if not machine.is_determined:
        return None
    try:
        _, drawn = workspace(machine)
    except DidNotConverge:
        return None
    x, y, z = _grid(np.array([T.translation for T in drawn]))
    grids = np.meshgrid(z, y, x, indexing="ij")
    places = np.stack([grid.ravel() for grid in grids[::-1]], axis=1)
    R = np.broadcast_to(machine.home.rotation.as_matrix(), (len(places), 3, 3))
    readings = readings_at_poses(machine, np.concatenate([R, places[..., None]], axis=2))
    inside = np.flatnonzero(_inside(machine, readings))
    poses = motions_of(R[inside], places[inside])
    errors = _errors(machine, solution, readings[inside], poses) if len(inside) else None
    if errors is None:
        return None
    reached, change, sigma = errors
    if len(change.displacement) < MIN_PLACES:
        return None
    maps = np.full((2, len(places)), np.nan)
    maps[:, inside[reached]] = change.displacement, sigma.displacement
    return PlatformMap(x, y, z, *maps.reshape(2, *grids[0].shape))


def _grid(position: Array) -> list[Array]:
    """Return points along x and y over the whole workspace, and levels of z inside it."""
    low, high = position.min(axis=0), position.max(axis=0)
    flat = high - low < _FLAT * float(np.max(high - low))
    x, y = (np.linspace(a, b, N_ACROSS) for a, b in zip(low[:2], high[:2], strict=True))
    z = np.quantile(position[:, 2], np.arange(1, N_LEVELS + 1) / (N_LEVELS + 1.0))
    return [axis[:1] if is_flat else axis for axis, is_flat in zip((x, y, z), flat, strict=True)]


def _inside(machine: Machine, q: Array) -> BoolArray:
    """Return a mask of the rows of readings (n, n_legs) within the travels."""
    inside = np.ones(len(q), dtype=np.bool_)
    for j, leg in enumerate(machine.legs):
        if leg.is_motor:
            inside &= (q[:, j] >= leg.travel[0]) & (q[:, j] <= leg.travel[1])
    return inside


def _errors(
    machine: Machine, solution: Solution, q: Array, T_base_platform: Sequence[RigidTransform]
) -> tuple[BoolArray, PlatformError, PlatformError] | None:
    """Return a mask of the poses that both models reach, and change and predicted error there."""
    wanted = platforms_in_base(machine, T_base_platform)
    nominal = poses_at_readings(machine, geometries(machine), q, wanted)
    calibrated = poses_at_readings(machine, solution.legs, q, nominal)
    distance, angle = pose_differences(nominal, wanted)
    reached = (distance < _CLOSED * machine.size) & (angle < _CLOSED)
    reached &= reach_readings(machine, solution.legs, q, calibrated)
    indices = np.flatnonzero(reached)
    if not len(indices):
        return None
    reached_poses = [calibrated[k] for k in indices]
    try:
        moves = platform_by_parameters(
            solution.legs, solution.kinematic.parametrization, machine.frame_legs, reached_poses
        )
    except NotIdentifiable:  # a point of the grid is singular
        return None
    sigma = expected_error(moves, solution.kinematic.total_covariance)
    change = PlatformError(*pose_differences(reached_poses, [nominal[k] for k in indices]))
    return reached, change, sigma
