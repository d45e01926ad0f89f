"""What joints, rods and the plane demand of platform poses, whatever the measurements say.

A revolute or universal axis, a constant length and the plane of a planar mechanism hold exactly.
The state of the fit meets them at every pose, and a step stays tangent to them: with the
constraints C_pose dp + C_xi dxi = 0 of a pose, dp = Z y + Q dxi, Z a basis of the null space of
C_pose and Q = -C_pose^+ C_xi. What is left of the pose is y alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.mechanism.equations import demanded
from legcal.mechanism.leg import LegKind
from legcal.mechanism.leg_geometry import Demand, LegGeometry
from legcal.mechanism.parametrization import tied_twist_slope
from legcal.mechanism.sensitivity import freedoms
from legcal.refinement.layout import Layout
from legcal.refinement.legs import FittedLegs
from legcal.refinement.state import State, turned

_RANK = 1e-7  # of the largest singular value
_MET = 1e-13  # [m]
_NEARLY_MET = 1e-10  # [m], of demands that cannot all be met to rounding
_MAX_STEPS = 20
_PLATFORM_AXIS, _TWIST = slice(9, 11), 11  # among the numbers of a leg


@dataclass(frozen=True, eq=False)
class PoseRows:
    """The equations of legs at poses; all rows are lengths.

    Attributes
    ----------
    values : (n_poses, m) array
        How far each row is from met [m]; for a row that holds by a reading |AB| - q0.
    by_pose : (n_poses, m, 6) array
        Derivative by rotation [rad] and displacement [m] of R_e in R_b.
    by_local : (n_poses, m, 12) array
        Derivative by the numbers of the row's leg.
    leg : (m,) array of int
        The leg of each row.
    measured : (m,) array of bool
        Which rows hold by a reading.
    """

    values: Array
    by_pose: Array
    by_local: Array
    leg: IntArray
    measured: BoolArray

    def of(self, rows: BoolArray) -> PoseRows:
        """Return some of the rows."""
        return PoseRows(
            self.values[:, rows],
            self.by_pose[:, rows],
            self.by_local[:, rows],
            self.leg[rows],
            self.measured[rows],
        )


@dataclass(frozen=True, eq=False)
class Tangent:
    """The motions of platform poses that the constraints leave.

    Attributes
    ----------
    Z : (n_poses, 6, f) array
        Basis of the motions at rest parameters; zero columns where a pose has fewer.
    Q : (n_kept, n_poses, 6) array
        Motion by each unknown other than poses.
    """

    Z: Array
    Q: Array


def pose_rows(
    legs: Sequence[LegGeometry], R: Array, t: Array, *, by_local: bool = True
) -> PoseRows:
    """Return what all legs demand at poses R (k, 3, 3), t (k, 3) of R_e in R_b.

    Without *by_local* these derivatives have no columns.
    """
    found = [demanded(leg, R, t, by_local=by_local) for leg in legs]
    counts = [len(part.demands) for part in found]
    measured = [
        leg.kind is LegKind.ACTUATED and demand is Demand.LENGTH
        for leg, part in zip(legs, found, strict=True)
        for demand in part.demands
    ]
    return PoseRows(
        np.concatenate([part.values for part in found], axis=1),
        np.concatenate([part.by_pose for part in found], axis=1),
        np.concatenate([part.by_local for part in found], axis=1),
        np.repeat(np.arange(len(legs)), counts),
        np.array(measured, dtype=np.bool_),
    )


def is_constrained(legs: Sequence[LegGeometry], frame_legs: Sequence[int]) -> bool:
    """Say whether anything is demanded of poses besides readings."""
    return len(frame_legs) < 3 or any(map(n_bonds, legs))


def on_constraints(state: State, frame_legs: Sequence[int]) -> State:
    """Return the state with every pose moved, as little as possible, to where constraints hold.

    Where they contradict each other a pose goes where they are met best.

    Raises
    ------
    DidNotConverge
        If a pose does not come to rest.
    """
    if not any(map(n_bonds, state.legs)):
        return state
    free = list(freedoms(frame_legs))
    R, t, size = state.R_pose, state.t_pose, np.inf
    for _ in range(_MAX_STEPS):
        rows = _binding(state.legs, R, t, by_local=False)
        step = np.zeros((len(t), 6))
        inverse = np.linalg.pinv(rows.by_pose[:, :, free], rcond=_RANK)
        step[:, free] = -np.einsum("kij,kj->ki", inverse, rows.values)
        previous, size = size, float(np.abs(step).max(initial=0.0))
        R, t = turned(R, step[:, :3]), t + step[:, 3:]
        if size < _MET or (size < _NEARLY_MET and size > 0.5 * previous):
            return replace(state, R_pose=R, t_pose=t)
        if not size < 1e3:
            break
    raise DidNotConverge(
        "The fit of everything could not keep the platform on what its joints allow: found a pose "
        f"that still moves by {size:.2g} m or rad, needed rest; start nearer to the truth (joints "
        "to 5 mm, axes to 3 deg)."
    )


def tangent(state: State, layout: Layout, legs: FittedLegs) -> Tangent | None:
    """Return the motions of poses that the constraints leave; None where all are free."""
    if not is_constrained(state.legs, legs.frame_legs):
        return None
    free = list(freedoms(legs.frame_legs))
    n_poses = layout.n_poses
    rows = _binding(state.legs, state.R_pose, state.t_pose)
    Q = np.zeros((layout.n_kept + 1, n_poses, 6))
    if len(rows.leg) == 0:
        Z = np.broadcast_to(np.eye(6)[:, free], (n_poses, 6, len(free))).copy()
        return Tangent(Z, Q[:-1])
    _, s, vt = np.linalg.svd(rows.by_pose[:, :, free])
    n = s.shape[1]
    held = s > _RANK * s[:, :1]
    least = int(held.sum(axis=1).min(initial=n))
    basis = np.swapaxes(vt, -1, -2)[:, :, least:].copy()
    basis[:, :, : n - least] *= ~held[:, None, least:]
    Z = np.zeros((n_poses, 6, basis.shape[2]))
    Z[:, free] = basis
    inverse = np.zeros((n_poses, 6, len(rows.leg)))
    inverse[:, free] = np.linalg.pinv(rows.by_pose[:, :, free], rcond=_RANK)
    for i, leg in enumerate(rows.leg):
        place = np.minimum(layout.place[leg], layout.n_kept)
        by_local = rows.by_local[:, i]
        if place[_TWIST] == layout.n_kept:
            slope = tied_twist_slope(state.legs[leg], legs.nominal[leg])
            by_local[:, _PLATFORM_AXIS] += by_local[:, [_TWIST]] * slope
        Q[place] -= by_local.T[..., None] * inverse[None, :, :, i]
    return Tangent(Z, Q[:-1])


def following(state: State, frame_legs: Sequence[int], leg: int, column: int) -> Array:
    """Return how poses (n_poses, 6) follow one of the numbers of a leg, all else at rest."""
    free = list(freedoms(frame_legs))
    rows = _binding(state.legs, state.R_pose, state.t_pose)
    inverse = np.linalg.pinv(rows.by_pose[:, :, free], rcond=_RANK)
    by_number = np.where(rows.leg == leg, rows.by_local[:, :, column], 0.0)
    motion = np.zeros((len(state.t_pose), 6))
    motion[:, free] = -np.einsum("kfm,km->kf", inverse, by_number)
    return motion


def n_bonds(leg: LegGeometry) -> int:
    """Return how many equations of a leg hold without a reading."""
    return len(leg.demands) - (leg.kind is not LegKind.CONSTANT)


def _binding(legs: Sequence[LegGeometry], R: Array, t: Array, *, by_local: bool = True) -> PoseRows:
    """Return the rows that hold without a reading."""
    rows = pose_rows(legs, R, t, by_local=by_local)
    return rows.of(~rows.measured)
