"""Criteria of a plan: errors of the platform over the workspace, or of parameters.

The error of the platform is the root mean square displacement of its joints at poses all over the
workspace, for the covariance of the machine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from legcal.calibration.joint_fit.platform import (
    PlatformError,
    expected_error,
    platform_by_parameters,
)
from legcal.calibration.joint_fit.variables import FittedLegs
from legcal.errors import DidNotConverge, NotIdentifiable, UsageError
from legcal.files.schema import closest
from legcal.geometry.lines import cross
from legcal.geometry.types import Array
from legcal.machine.configurations import workspace
from legcal.machine.kinematics import platforms_in_base
from legcal.machine.model import Machine
from legcal.planning.exchange import Criterion


class Goal(StrEnum):
    """The quantity that a plan minimises."""

    MEAN = "mean"  # error of the platform, mean over the workspace
    WORST = "worst"  # error of the platform, maximum over the workspace
    D_OPTIMAL = "d"  # determinant of the covariance of all parameters
    PARAMETERS = "parameters"  # sigma of named parameters


@dataclass(frozen=True, eq=False)
class Workspace:
    """Sensitivity of the platform to the parameters, over the workspace."""

    by_parameters: Array  # (w, 6, p): rotation vectors, displacements of the origin of R_e
    joints: Array  # (w, n_joints, 3, p): displacements of platform joints [m]

    def error(self, covariance: Array) -> PlatformError:
        """Return the error of the platform for a covariance (p, p) of the parameters."""
        return expected_error(self.by_parameters, covariance)


def workspace_of(machine: Machine, legs: FittedLegs) -> Workspace | None:
    """Return the workspace of a machine; None if readings do not determine its poses."""
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
    goal: Goal,
    work: Workspace | None,
    legs: FittedLegs,
    basis: Array,  # (n_parameters, p)
    named: Sequence[str] = (),
) -> Criterion:
    """Return the criterion of a goal, a function of covariances (n, p, p).

    Raises UsageError if the goal does not apply to the machine.
    """
    units, names = legs.parametrization.units, legs.parametrization.names
    length = float(np.mean([np.linalg.norm(leg.B) + leg.q0 for leg in legs.nominal]))
    unit = np.array([1.0 if unit == "m" else length for unit in units])
    if goal in (Goal.MEAN, Goal.WORST):
        if work is None:
            raise UsageError(
                "The plan could not minimise the error of the platform: the readings of this "
                "machine do not determine its pose; choose --criterion d or parameters."
            )
        moves = np.concatenate(list(np.moveaxis(work.joints, 1, 0)), axis=1) @ basis
        weights = np.einsum("wri,wrj->wij", moves, moves) / work.joints.shape[1]
        if goal is Goal.MEAN:
            mean = weights.mean(axis=0)
            return lambda S: np.sqrt(np.maximum(np.einsum("ij,nij->n", mean, S), 0.0))
        return lambda S: np.sqrt(np.maximum(np.einsum("wij,nij->nw", weights, S).max(axis=1), 0.0))
    if goal is Goal.PARAMETERS:
        unknown = [name for name in named if name not in names]
        if unknown or not named:
            found = f"'{unknown[0]}'" if unknown else "no name"
            hint = closest(unknown[0], names) if unknown else f"name one, such as {names[0]}."
            raise UsageError(
                f"The plan could not minimise the sigma of parameters: found {found}, needed names "
                f"of parameters of the machine; {hint}"
            )
        rows = (basis * unit[:, None])[[names.index(name) for name in named]]
        return lambda S: np.sqrt(np.einsum("ri,nij,rj->n", rows, S, rows) / len(rows))
    p = basis.shape[1]
    scale = float(np.linalg.slogdet(basis.T @ np.diag(unit**2) @ basis)[1])
    return lambda S: np.exp((np.linalg.slogdet(S)[1] + scale) / (2.0 * p))
