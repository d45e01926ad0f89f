"""Starting values: platform poses and cameras from any kinematic parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import DatasetError
from legcal.geometry.types import Array
from legcal.mechanism.parameters import KinematicParameters
from legcal.observations.measurements import Measurements
from legcal.refinement.legs import FittedLegs
from legcal.refinement.state import State, motions, turned

_MAX_ITERATIONS = 60
_STEP = 1e-12  # [m, rad]
_LARGEST_TURN = 0.3  # [rad] in one step


@dataclass(frozen=True, eq=False)
class Start:
    """Where a fit begins.

    Attributes
    ----------
    parameters : KinematicParameters
    T_camera_Rb : tuple of RigidTransform
        Camera poses, one a view.
    T_Rb_Re : tuple of RigidTransform
        Platform poses, one a pose.
    label : str
        Where it comes from: ``nominal`` or ``staged``.
    """

    parameters: KinematicParameters
    T_camera_Rb: tuple[RigidTransform, ...]
    T_Rb_Re: tuple[RigidTransform, ...]
    label: str

    def state(self, radii: Array) -> State:
        """Return the state of the fit with these radii [m]."""
        return State(
            self.parameters.base_joints,
            self.parameters.platform_joints,
            self.parameters.offsets,
            radii,
            *_arrays(self.T_camera_Rb),
            *_arrays(self.T_Rb_Re),
        )


def start_from(
    parameters: KinematicParameters,
    measurements: Measurements,
    legs: FittedLegs,
    T_camera_Rb: Sequence[RigidTransform],
    T_Rb_Re: Sequence[RigidTransform],
    label: str,
) -> Start:
    """Return a start whose platform poses fit the parameters and the readings.

    Parameters
    ----------
    parameters : KinematicParameters
        Joints and offsets, nominal or from the four steps [m].
    measurements : Measurements
    legs : FittedLegs
    T_camera_Rb : sequence of RigidTransform
        Camera poses, one a view: from :func:`cameras_from_hints` or from step 2.
    T_Rb_Re : sequence of RigidTransform
        A platform pose, one a pose, in the right assembly mode: the nominal forward kinematics.
    label : str
        Name of the start.

    Returns
    -------
    Start
    """
    lengths = legs.sign * measurements.q[measurements.first_rows] + parameters.offsets
    poses = platform_poses(parameters, lengths, T_Rb_Re)
    return Start(parameters, tuple(T_camera_Rb), poses, label)


def cameras_from_hints(
    measurements: Measurements, T_base_Rb: RigidTransform
) -> tuple[RigidTransform, ...]:
    """Return T_camera_Rb of every view from its rough pose in the base link.

    Raises
    ------
    DatasetError
        If a view has no rough pose.
    """
    missing = [view.name for view in measurements.views if view.T_base_camera is None]
    if missing:
        raise DatasetError(
            f"The fit could not be started: the views {', '.join(missing)} have no T_base_camera; "
            "a camera pose good to 2 cm and 2 deg is needed; add it to dataset.yaml."
        )
    return tuple(
        view.T_base_camera.inv() * T_base_Rb
        for view in measurements.views
        if view.T_base_camera is not None
    )


def platform_poses(
    parameters: KinematicParameters, lengths: Array, T_Rb_Re: Sequence[RigidTransform]
) -> tuple[RigidTransform, ...]:
    """Return the platform poses at which the legs have given lengths, all at once.

    Where no pose has these lengths (parameters far from the truth) the pose with the least
    squares of the length errors is returned: a fit can still start there.

    Parameters
    ----------
    parameters : KinematicParameters
        Joints [m].
    lengths : (n_poses, n_legs) array
        Leg lengths [m]; NaN where unknown.
    T_Rb_Re : sequence of RigidTransform
        Poses nearby, in the right assembly mode.

    Returns
    -------
    tuple of RigidTransform
        T_Rb_Re.
    """
    R, t = _arrays(T_Rb_Re)
    known = np.isfinite(lengths)
    wanted = np.where(known, lengths, 0.0)
    damping = np.full(len(R), 1e-6)
    error, J = _length_errors(parameters, R, t, wanted, known)
    cost = np.sum(error**2, axis=1)
    for _ in range(_MAX_ITERATIONS):
        N = np.swapaxes(J, -1, -2) @ J + damping[:, None, None] * np.eye(6)
        step = -np.linalg.solve(N, np.einsum("kli,kl->ki", J, error)[..., None])[..., 0]
        turn = np.linalg.norm(step[:, :3], axis=1, keepdims=True)
        step *= np.minimum(1.0, _LARGEST_TURN / np.maximum(turn, 1e-300))
        R_next, t_next = turned(R, step[:, :3]), t + step[:, 3:]
        error_next, J_next = _length_errors(parameters, R_next, t_next, wanted, known)
        cost_next = np.sum(error_next**2, axis=1)
        better = cost_next <= cost
        damping = np.where(better, np.maximum(damping * 0.1, 1e-14), damping * 10.0)
        R[better], t[better], cost[better] = R_next[better], t_next[better], cost_next[better]
        error[better], J[better] = error_next[better], J_next[better]
        if np.abs(step).max() < _STEP:
            break
    return motions(R, t)


def _length_errors(
    parameters: KinematicParameters, R: Array, t: Array, wanted: Array, known: Array
) -> tuple[Array, Array]:
    """Return length errors (n_poses, n_legs) [m] and their derivatives (n_poses, n_legs, 6)."""
    arm = np.einsum("kij,lj->kli", R, parameters.platform_joints)
    leg = arm + t[:, None, :] - parameters.base_joints
    length = np.linalg.norm(leg, axis=-1)
    u = leg / length[..., None]
    J = np.concatenate([np.cross(arm, u), u], axis=-1)
    return np.where(known, length - wanted, 0.0), J * known[..., None]


def _arrays(motions: Sequence[RigidTransform]) -> tuple[Array, Array]:
    """Return rotation matrices and translations of motions."""
    T = np.array([T.as_matrix() for T in motions]).reshape(-1, 4, 4)
    return T[:, :3, :3].copy(), T[:, :3, 3].copy()
