"""The legs of a simulated machine at platform poses, and how their lengths follow the platform."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array
from legcal.mechanism.parameters import KinematicParameters


def leg_vectors(parameters: KinematicParameters, T_Rb_Re: RigidTransform) -> Array:
    """Return A_j B_j of every leg in R_b at one or several poses, (..., n_legs, 3) [m]."""
    return legs_and_arms(parameters, T_Rb_Re.rotation.as_matrix(), T_Rb_Re.translation)[0]


def legs_and_arms(parameters: KinematicParameters, R: Array, t: Array) -> tuple[Array, Array]:
    """Return A B and R B of all legs at poses R, t of R_e in R_b, both (..., n_legs, 3) [m]."""
    arms = parameters.platform_joints @ np.swapaxes(R, -1, -2)
    return arms + t[..., None, :] - parameters.base_joints, arms


def length_jacobian(parameters: KinematicParameters, R: Array, t: Array) -> Array:
    """Return d lengths / d (translation, rotation vector in R_b), (..., n_legs, 6)."""
    legs, arms = legs_and_arms(parameters, R, t)
    u = legs / np.linalg.norm(legs, axis=-1, keepdims=True)
    return np.concatenate([u, np.cross(arms, u)], axis=-1)
