"""What errors of parameters do to the platform at the poses of a design."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.sensitivity import pose_sensitivity
from legcal.refinement.solution import Solution
from legcal.refinement.start import platform_poses
from legcal.studies.outline_design import OutlineDesign


class Misses(NamedTuple):
    """Root mean square errors of the platform over poses.

    Attributes
    ----------
    displacement : float
        Of the origin of R_e [m].
    rotation : float
        Angle [rad].
    """

    displacement: float
    rotation: float


def platform_misses(design: OutlineDesign, legs: Sequence[LegGeometry]) -> Misses:
    """Return how far from the truth legs put the platform at the exact readings, rms over poses.

    See :func:`platform_errors`.
    """
    shift, turn = platform_errors(design, legs)
    return Misses(float(np.sqrt(np.mean(shift**2))), float(np.sqrt(np.mean(turn**2))))


def platform_errors(design: OutlineDesign, legs: Sequence[LegGeometry]) -> tuple[Array, Array]:
    """Return how far from the truth legs put the platform at the exact readings.

    Parameters
    ----------
    design : OutlineDesign
        The truth.
    legs : sequence of LegGeometry
        Nominal or found, in R_b and R_e. Where they cannot have these readings, the platform
        stands where it misses them least.

    Returns
    -------
    shift, turn : (n_poses,) array
        Displacement of the origin of R_e [m] and angle [rad].
    """
    together = RigidTransform.from_components(design.t, Rotation.from_matrix(design.R))
    poses = tuple(together[k] for k in range(len(design.t)))
    lengths = design.sign * design.q + np.array([leg.q0 for leg in legs])
    there = platform_poses(legs, lengths, poses, design.frame_legs)
    shift = [T.translation - T_true.translation for T, T_true in zip(there, poses, strict=True)]
    turn = [
        (T_true.rotation.inv() * T.rotation).magnitude()
        for T, T_true in zip(there, poses, strict=True)
    ]
    return np.linalg.norm(shift, axis=1), np.array(turn)


def predicted_misses(design: OutlineDesign, solution: Solution) -> Misses:
    """Return what the covariance of a solution says of them.

    Raises
    ------
    NotIdentifiable
        If the readings do not determine a pose.
    """
    follow = pose_sensitivity(
        solution.legs, solution.parametrization, design.frame_legs, design.R, design.t
    )
    variance = np.einsum(
        "kia,ab,kib->ki", follow, solution.kinematic_covariance, follow, optimize=True
    )
    turn, shift = variance[:, :3].sum(axis=1), variance[:, 3:].sum(axis=1)
    return Misses(float(np.sqrt(shift.mean())), float(np.sqrt(turn.mean())))
