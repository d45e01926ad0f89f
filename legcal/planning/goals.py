"""The criterion of a plan: the mean error of the platform over the workspace.

It is the root mean square distance by which the covariance of the machine moves all joints of the
platform, over the poses that stand for the workspace. Where readings do not give the pose of the
platform, the criterion is the determinant of the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legcal.calibration.joint_fit.platform import (
    PlatformError,
    expected_error,
    platform_by_parameters,
)
from legcal.calibration.joint_fit.variables import FittedLegs
from legcal.errors import DidNotConverge, NotIdentifiable
from legcal.geometry.lines import cross
from legcal.geometry.types import Array
from legcal.machine.configurations import workspace
from legcal.machine.kinematics import platforms_in_base
from legcal.machine.model import Machine
from legcal.planning.exchange import Criterion


@dataclass(frozen=True, eq=False)
class Workspace:
    """How parameters move the platform, all over the workspace."""

    by_parameters: Array  # (w, 6, p): rotation vectors, displacements of the origin of R_e
    joints: Array  # (w, n_joints, 3, p): displacements of platform joints [m]

    def error(self, covariance: Array) -> PlatformError:
        """Return what a covariance (p, p) of the kinematic parameters means there."""
        return expected_error(self.by_parameters, covariance)


def workspace_of(machine: Machine, legs: FittedLegs) -> Workspace | None:
    """Return the workspace of a machine; None where readings do not give poses."""
    if not machine.is_determined:
        return None
    try:
        poses = platforms_in_base(machine, workspace(machine)[1])
        by = platform_by_parameters(legs.nominal, legs.parametrization, machine.frame_legs, poses)
    except (DidNotConverge, NotIdentifiable):
        return None
    R = np.array([T.rotation.as_matrix() for T in poses])
    arms = np.einsum("wij,lj->wli", R, np.array([leg.B for leg in legs.nominal]))
    turned = -cross(arms[:, :, None], np.swapaxes(by[:, None, :3], 2, 3))  # (w, l, p, 3)
    return Workspace(by, np.swapaxes(turned, 2, 3) * -1.0 + by[:, None, 3:])


def criterion_of(
    work: Workspace | None,
    legs: FittedLegs,
    basis: Array,  # (n_parameters, p)
) -> Criterion:
    """Return the criterion: of covariances (n, p, p) in the coordinates of a basis."""
    if work is not None:
        moves = np.concatenate(list(np.moveaxis(work.joints, 1, 0)), axis=1) @ basis
        weights = np.einsum("wri,wrj->wij", moves, moves) / work.joints.shape[1]
        mean = weights.mean(axis=0)
        return lambda S: np.sqrt(np.maximum(np.einsum("ij,nij->n", mean, S), 0.0))
    length = float(np.mean([np.linalg.norm(leg.B) + leg.q0 for leg in legs.nominal]))
    unit = np.array([1.0 if unit == "m" else length for unit in legs.parametrization.units])
    p = basis.shape[1]
    scale = float(np.linalg.slogdet(basis.T @ np.diag(unit**2) @ basis)[1])
    return lambda S: np.exp((np.linalg.slogdet(S)[1] + scale) / (2.0 * p))
