"""Platform poses: what legs demand of them, the constraints that hold exactly, and first values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.joint_fit.state import (
    PLATFORM_AXIS,
    TWIST,
    FittedLegs,
    Start,
    State,
)
from legcal.data import Measurements
from legcal.errors import DatasetError, DidNotConverge
from legcal.estimation import Frames, Problem, Tangent
from legcal.geometry import Array
from legcal.machine import (
    Leg,
    PoseEquations,
    freedoms,
    n_bonds,
    pose_equations,
    solve_poses,
    tied_twist_slope,
)

_RANK = 1e-7  # of the largest singular value
_AT_REST = 1e-6  # [m, rad], the last step where demands cannot all be met to rounding


def _binding(legs: Sequence[Leg], poses: Frames) -> PoseEquations:
    """Return the equations that hold without a reading."""
    rows = pose_equations(legs, *poses)
    return rows.of(~rows.measured)


@dataclass(frozen=True, eq=False)
class LegConstraints:
    """What joints, constant lengths and the plane demand of platform poses, exactly."""

    legs: FittedLegs

    def project(self, state: State) -> State:
        """Return the state with every pose moved, as little as possible, to where they hold.

        Where they contradict each other a pose goes where they are met best.
        """
        if np.any(state.radii <= 0.0):
            raise DidNotConverge("The joint fit came to a radius that is not positive.")
        if not any(map(n_bonds, state.legs)):
            return state
        found = solve_poses(state.legs, self.legs.frame_legs, *state.platform_pose)
        size = float(found.size.max(initial=0.0))
        if size < _AT_REST:
            return replace(state, platform_pose=Frames(found.R, found.t))
        raise DidNotConverge(
            "The joint fit could not keep the platform on what its joints allow: found a pose that "
            f"still moves by {size:.2g} m or rad, needed rest; start nearer to the truth (joints "
            "to 5 mm, axes to 3 deg)."
        )

    def tangent(self, problem: Problem[State], state: State) -> Tangent | None:
        """Return the motions of poses that the constraints leave; None where all are free."""
        if self.legs.spatial and not any(map(n_bonds, state.legs)):
            return None
        free = list(freedoms(self.legs.frame_legs))
        n_poses, n_kept = problem.n_own, problem.n_kept
        rows = _binding(state.legs, state.platform_pose)
        Q = np.zeros((n_kept + 1, n_poses, 6))
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
            place = problem.place["legs"][leg]
            by_local = rows.by_local[:, i]
            if place[TWIST] == n_kept:
                slope = tied_twist_slope(state.legs[leg], self.legs.nominal[leg])
                by_local[:, PLATFORM_AXIS] += by_local[:, [TWIST]] * slope
            Q[place] -= by_local.T[..., None] * inverse[None, :, :, i]
        return Tangent(Z, Q[:-1])

    def following(self, state: State, leg: int, column: int) -> Array:
        """Return how poses (n_poses, 6) follow one of the numbers of a leg, all else at rest."""
        free = list(freedoms(self.legs.frame_legs))
        rows = _binding(state.legs, state.platform_pose)
        inverse = np.linalg.pinv(rows.by_pose[:, :, free], rcond=_RANK)
        by_number = np.where(rows.leg == leg, rows.by_local[:, :, column], 0.0)
        motion = np.zeros((len(state.platform_pose.t), 6))
        motion[:, free] = -np.einsum("kfm,km->kf", inverse, by_number)
        return motion


def start_from(
    geometry: Sequence[Leg],
    measurements: Measurements,
    legs: FittedLegs,
    T_camera_Rb: Sequence[RigidTransform],
    T_Rb_Re: Sequence[RigidTransform],
    label: str,
) -> Start:
    """Return a start whose platform poses fit the legs *geometry* and the readings.

    *T_Rb_Re* has a pose nearby for each, in the right assembly mode: the nominal forward
    kinematics.
    """
    q0 = np.array([leg.q0 for leg in geometry])
    lengths = legs.sign * measurements.q[measurements.first_rows] + q0
    poses = platform_poses(geometry, lengths, T_Rb_Re, legs.frame_legs)
    return Start(tuple(geometry), tuple(T_camera_Rb), poses, label)


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
    geometry: Sequence[Leg],
    lengths: Array,
    T_Rb_Re: Sequence[RigidTransform],
    frame_legs: Sequence[int],
) -> tuple[RigidTransform, ...]:
    """Return the platform poses at which the legs have given lengths, all at once.

    Where no pose has these lengths (parameters far from the truth) the pose with the least
    squares of what the legs demand is returned: a fit can still start there.

    Parameters
    ----------
    geometry : sequence of Leg
        The legs in R_b and R_e.
    lengths : (n_poses, n_legs) array
        Leg lengths [m] of actuated legs; NaN where unknown. Others are not looked at.
    T_Rb_Re : sequence of RigidTransform
        Poses nearby, in the right assembly mode.
    frame_legs : sequence of int
        The legs that define R_b and R_e.
    """
    lengthening = lengths - np.array([leg.q0 for leg in geometry])
    found = solve_poses(geometry, frame_legs, *Frames.of(T_Rb_Re), lengthening)
    return Frames(found.R, found.t).motions
