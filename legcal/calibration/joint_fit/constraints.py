"""Starting values: platform poses and cameras from any kinematic parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.joint_fit.state import FittedLegs, Layout, State
from legcal.data import Measurements
from legcal.errors import DatasetError, DidNotConverge
from legcal.geometry import Array, BoolArray, components, motions_of
from legcal.machine import (
    LegGeometry,
    PoseEquations,
    freedoms,
    n_bonds,
    pose_equations,
    solve_poses,
    tied_twist,
    tied_twist_slope,
    turn_of,
)

_RANK = 1e-7  # of the largest singular value
_AT_REST = 1e-6  # [m, rad], the last step where demands cannot all be met to rounding
_PLATFORM_AXIS, _TWIST = slice(9, 11), 11  # among the numbers of a leg


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
    found = solve_poses(state.legs, frame_legs, state.R_pose, state.t_pose)
    size = float(found.size.max(initial=0.0))
    if size < _AT_REST:
        return replace(state, R_pose=found.R, t_pose=found.t)
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


def _binding(legs: Sequence[LegGeometry], R: Array, t: Array) -> PoseEquations:
    """Return the rows that hold without a reading."""
    rows = pose_equations(legs, R, t)
    return rows.of(~rows.measured)


@dataclass(frozen=True, eq=False)
class Start:
    """Where a fit begins.

    Attributes
    ----------
    legs : tuple of LegGeometry
        The legs in R_b and R_e.
    T_camera_Rb : tuple of RigidTransform
        Camera poses, one a view.
    T_Rb_Re : tuple of RigidTransform
        Platform poses, one a pose.
    label : str
        Where it comes from: ``nominal`` or ``staged``.
    T_Rb_board : RigidTransform
        The calibration board, where images show one.
    """

    legs: tuple[LegGeometry, ...]
    T_camera_Rb: tuple[RigidTransform, ...]
    T_Rb_Re: tuple[RigidTransform, ...]
    label: str
    T_Rb_board: RigidTransform = field(default_factory=RigidTransform.identity)


def start_from(
    geometry: Sequence[LegGeometry],
    measurements: Measurements,
    legs: FittedLegs,
    T_camera_Rb: Sequence[RigidTransform],
    T_Rb_Re: Sequence[RigidTransform],
    label: str,
) -> Start:
    """Return a start whose platform poses fit the parameters and the readings.

    Parameters
    ----------
    geometry : sequence of LegGeometry
        The legs, nominal or from the four steps, in R_b and R_e.
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
    q0 = np.array([leg.q0 for leg in geometry])
    lengths = legs.sign * measurements.q[measurements.first_rows] + q0
    poses = platform_poses(geometry, lengths, T_Rb_Re, legs.frame_legs)
    return Start(tuple(geometry), tuple(T_camera_Rb), poses, label)


def with_values(
    geometry: Sequence[LegGeometry], legs: FittedLegs, values: Mapping[int, float]
) -> tuple[LegGeometry, ...]:
    """Return legs some of whose parameters, by their number, have given values [m, rad]."""
    wanted = np.append(legs.vector(tuple(geometry)), 0.0)
    wanted[list(values)] = list(values.values())
    asked = np.isin(legs.parametrization.place, list(values))
    return tuple(
        _with_numbers(leg, nominal, wanted[place], is_asked) if is_asked.any() else leg
        for leg, nominal, place, is_asked in zip(
            geometry, legs.nominal, legs.parametrization.place, asked, strict=True
        )
    )


def _with_numbers(
    leg: LegGeometry, nominal: LegGeometry, numbers: Array, asked: BoolArray
) -> LegGeometry:
    """Return a leg some of whose numbers have given values; axes count from the nominal ones."""
    moved = replace(
        leg,
        A=np.where(asked[:3], numbers[:3], leg.A),
        B=np.where(asked[3:6], numbers[3:6], leg.B),
        q0=float(numbers[6]) if asked[6] else leg.q0,
        base_axis=_axis_at(leg.base_axis, nominal.base_axis, numbers[7:9], asked[7:9]),
        platform_axis=_axis_at(
            leg.platform_axis, nominal.platform_axis, numbers[9:11], asked[9:11]
        ),
    )
    if leg.twist is None or not asked[9:].any():
        return moved
    return replace(moved, twist=tied_twist(moved, nominal, float(numbers[11])))


def _axis_at(
    axis: Array | None, nominal: Array | None, angles: Array, asked: BoolArray
) -> Array | None:
    """Return an axis at angles from the nominal one, as it was if none is asked for."""
    if axis is None or nominal is None or not asked.any():
        return axis
    there = np.asarray(turn_of(nominal, angles).apply(nominal))
    return there if there @ axis > 0.0 else -there


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
    geometry: Sequence[LegGeometry],
    lengths: Array,
    T_Rb_Re: Sequence[RigidTransform],
    frame_legs: Sequence[int],
) -> tuple[RigidTransform, ...]:
    """Return the platform poses at which the legs have given lengths, all at once.

    Where no pose has these lengths (parameters far from the truth) the pose with the least
    squares of what the legs demand is returned: a fit can still start there.

    Parameters
    ----------
    geometry : sequence of LegGeometry
        The legs in R_b and R_e.
    lengths : (n_poses, n_legs) array
        Leg lengths [m] of actuated legs; NaN where unknown. Others are not looked at.
    T_Rb_Re : sequence of RigidTransform
        Poses nearby, in the right assembly mode.
    frame_legs : sequence of int
        The legs that define R_b and R_e.

    Returns
    -------
    tuple of RigidTransform
        T_Rb_Re.
    """
    lengthening = lengths - np.array([leg.q0 for leg in geometry])
    found = solve_poses(geometry, frame_legs, *components(T_Rb_Re), lengthening)
    return motions_of(found.R, found.t)
