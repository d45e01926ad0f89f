"""Starting values: platform poses and cameras from any kinematic parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import DatasetError
from legcal.geometry.types import Array, BoolArray
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.leg_steps import turn_of
from legcal.mechanism.parametrization import tied_twist
from legcal.mechanism.sensitivity import freedoms
from legcal.observations.measurements import Measurements
from legcal.refinement.constraints import pose_rows
from legcal.refinement.legs import FittedLegs
from legcal.refinement.state import components, motions, turned

_MAX_ITERATIONS = 60
_STEP = 1e-12  # [m, rad]
_LARGEST_TURN = 0.3  # [rad] in one step


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
    free = list(freedoms(frame_legs))
    reading = lengths - np.array([leg.q0 for leg in geometry])
    R, t = components(T_Rb_Re)
    damping = np.full(len(R), 1e-6)
    error, J = _misses(geometry, reading, R, t)
    cost = np.sum(error**2, axis=1)
    for _ in range(_MAX_ITERATIONS):
        J_free = J[:, :, free]
        N = np.swapaxes(J_free, -1, -2) @ J_free + damping[:, None, None] * np.eye(len(free))
        step = np.zeros((len(t), 6))
        gradient = np.einsum("kli,kl->ki", J_free, error)
        step[:, free] = -np.linalg.solve(N, gradient[..., None])[..., 0]
        turn = np.linalg.norm(step[:, :3], axis=1, keepdims=True)
        step *= np.minimum(1.0, _LARGEST_TURN / np.maximum(turn, 1e-300))
        R_next, t_next = turned(R, step[:, :3]), t + step[:, 3:]
        error_next, J_next = _misses(geometry, reading, R_next, t_next)
        cost_next = np.sum(error_next**2, axis=1)
        better = cost_next <= cost
        damping = np.where(better, np.maximum(damping * 0.1, 1e-14), damping * 10.0)
        R[better], t[better], cost[better] = R_next[better], t_next[better], cost_next[better]
        error[better], J[better] = error_next[better], J_next[better]
        if np.abs(step).max() < _STEP:
            break
    return motions(R, t)


def _misses(
    geometry: Sequence[LegGeometry], reading: Array, R: Array, t: Array
) -> tuple[Array, Array]:
    """Return how far all rows are from met (n_poses, m) [m] and their derivatives by the pose."""
    rows = pose_rows(geometry, R, t)
    wanted = np.where(rows.measured, reading[:, rows.leg], 0.0)
    known = np.isfinite(wanted)
    return np.where(known, rows.values - wanted, 0.0), rows.by_pose * known[..., None]
