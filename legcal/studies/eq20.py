"""Eq (20): what errors of the parameters do to the platform, as computed and as expected."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform
from scipy.special import elliprg

from legcal.geometry.types import Array
from legcal.mechanism.parameters import KinematicParameters, free_coordinates
from legcal.simulation.forward import solve_poses
from legcal.simulation.leg_vectors import leg_vectors, length_jacobian
from legcal.simulation.machine import Machine


@dataclass(frozen=True)
class PlatformErrors:
    """Means over poses of eq (20).

    Attributes
    ----------
    dX : float
        Displacement of B_1 from A_1, which are the origins of R_e and R_b [m].
    dE : float
        Norm of the Euler angles of the rotation between both orientations, as printed [rad].
    angle : float
        Angle of that rotation [rad]: the norm of Euler angles is near it while both are small.
    """

    dX: float
    dE: float
    angle: float


def platform_errors(
    machine: Machine, parameters: KinematicParameters, T_Rb_Re: RigidTransform
) -> PlatformErrors:
    """Return the errors of eq (20) that parameters cause at poses of the true machine.

    Parameters
    ----------
    machine : Machine
        The true machine: its readings are given to the parameters.
    parameters : KinematicParameters
        Identified parameters.
    T_Rb_Re : RigidTransform, n_poses of them
        True poses.

    Raises
    ------
    DidNotConverge
        If the parameters cannot have these readings.
    """
    found = poses_of_readings(machine, parameters, T_Rb_Re)
    turn = T_Rb_Re.rotation.inv() * found.rotation
    displacement = np.linalg.norm(found.translation - T_Rb_Re.translation, axis=-1)
    euler = np.linalg.norm(turn.as_euler("xyz"), axis=-1)
    return PlatformErrors(
        float(displacement.mean()), float(euler.mean()), float(turn.magnitude().mean())
    )


def poses_of_readings(
    machine: Machine, parameters: KinematicParameters, T_Rb_Re: RigidTransform
) -> RigidTransform:
    """Return the poses that other parameters compute from the readings of true poses.

    Parameters
    ----------
    machine : Machine
        The true machine.
    parameters : KinematicParameters
        Other parameters.
    T_Rb_Re : RigidTransform, n_poses of them
        True poses.

    Returns
    -------
    RigidTransform
        T_Rb_Re of the other parameters, n_poses of them.

    Raises
    ------
    DidNotConverge
        If they cannot have these readings.
    """
    lengths = np.linalg.norm(leg_vectors(machine.parameters, T_Rb_Re), axis=-1)
    changed = lengths - machine.parameters.offsets + parameters.offsets
    return solve_poses(parameters, changed, T_Rb_Re)


def expected_errors(machine: Machine, covariance: Array, T_Rb_Re: RigidTransform) -> PlatformErrors:
    """Return the expected errors of eq (20) for Gaussian errors of the parameters, to first order.

    Parameters
    ----------
    machine : Machine
        The true machine.
    covariance : (n, n) array
        Covariance of its parameters, in the order of ``parameters.to_vector`` [m^2].
    T_Rb_Re : RigidTransform, n_poses of them
        True poses.
    """
    follow = platform_by_parameters(machine, T_Rb_Re)
    of_pose = follow @ covariance @ np.swapaxes(follow, -1, -2)
    dX = float(expected_norm(of_pose[:, :3, :3]).mean())
    dE = float(expected_norm(of_pose[:, 3:, 3:]).mean())
    return PlatformErrors(dX, dE, dE)


def platform_by_parameters(machine: Machine, T_Rb_Re: RigidTransform) -> Array:
    """Return d (translation, rotation vector in R_b) / d parameters at fixed readings.

    The legs keep their lengths but for the offsets: u . (dt + w x R B + R dB - dA) = dq0.

    Returns
    -------
    (n_poses, 6, n_parameters) array
    """
    R, t = T_Rb_Re.rotation.as_matrix(), T_Rb_Re.translation
    J = length_jacobian(machine.parameters, R, t)
    n_poses, n_legs = J.shape[:2]
    u = J[..., :3]
    to_base = np.zeros((n_poses, n_legs, n_legs, 3))
    to_platform = np.zeros((n_poses, n_legs, n_legs, 3))
    leg = np.arange(n_legs)
    to_base[:, leg, leg] = u
    to_platform[:, leg, leg] = -(u @ R)
    free = free_coordinates(n_legs, machine.frame_legs)
    to_offsets = np.tile(np.eye(n_legs), (n_poses, 1, 1))
    change = np.concatenate([to_base[:, :, free], to_platform[:, :, free], to_offsets], axis=-1)
    return np.asarray(np.linalg.pinv(J) @ change)


def expected_norm(covariance: Array) -> Array:
    """Return the expected norm of Gaussian vectors with covariances (..., 3, 3).

    The length of a Gaussian vector is that of its direction times a chi-distributed number of
    mean sqrt(8 / pi); the mean over directions is Carlson's elliptic integral R_G.
    """
    value = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    mean = elliprg(value[..., 0], value[..., 1], value[..., 2])
    return np.asarray(np.sqrt(8.0 / np.pi) * mean)
