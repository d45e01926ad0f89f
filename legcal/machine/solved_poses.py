"""Platform poses from the equations of the legs alone: nearest poses, and poses at readings."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.motions import motion_of
from legcal.geometry.types import Array
from legcal.machine.equations import (
    PoseEquations,
    constraints_at,
    describe_worst,
    equations_at_readings,
    freedoms,
    is_constrained,
    is_overdetermined,
    least_squares_equations,
    machine_equations,
    pose_equations,
    posture_constraints,
)
from legcal.machine.leg import Leg, mean_length
from legcal.machine.mobility import leg_scale
from legcal.machine.model import Machine
from legcal.machine.solver import poses_after, solve

TOLERANCE, ROUNDING = 1e-13, 2.5e-15  # residuals of a solved pose, in leg lengths
MAX_POSE_ERROR = 0.01  # largest distance of a given pose from a closed one, in leg lengths
DEPENDENT = 1e-7  # singular value of dependent equations, relative to the largest


class SolvedPoses(NamedTuple):
    """Platform poses of R_e in R_b with the least residuals of legs."""

    R: Array  # (k, 3, 3)
    t: Array  # (k, 3) [m]
    missed: Array  # (k,) largest remaining residual [m]
    # (k,) last step [rad, mean leg lengths]; not small if a pose has not converged
    size: Array


def solve_poses(
    legs: Sequence[Leg],
    frame_legs: Sequence[int],
    R: Array,
    t: Array,
    lengthening: Array | None = None,
    steps: int = 60,
    scale: Array | None = None,
) -> SolvedPoses:
    """Return the poses of R_e in R_b, near R, t, at which the leg equations hold at readings.

    *lengthening* (k, n_legs) is s q of actuated legs [m] and q of rods on actuators [m, rad], NaN
    if unknown; without it the nearest poses that meet the constraints are returned. If no pose
    meets all equations (parameters far from the truth) the result is the least-squares pose; with
    redundant motors it minimises the squares of the lengths, with exact constraints. After few
    *steps* poses may not have converged. Distances are relative to *scale* (6,), by default 1 rad
    and the mean leg length.
    """
    fixed = np.ones(6, dtype=np.bool_)
    fixed[list(freedoms(frame_legs))] = False

    def equations(poses: Array) -> tuple[Array, Array]:
        if lengthening is None:
            rows = pose_equations(legs, poses[:, :, :3], poses[:, :, 3], by_local=False)
            rows = rows.of(~rows.measured)
        else:
            rows = equations_at_readings(legs, poses[:, :, :3], poses[:, :, 3], lengthening)
        jacobian = rows.by_pose.copy()
        jacobian[:, :, fixed] = 0.0
        return rows.values, jacobian

    poses = np.concatenate([R, t[..., None]], axis=2)
    length = mean_length(legs, poses[0]) if len(poses) else 1.0
    if scale is None:
        scale = np.repeat([1.0, length], 3)
    how: dict[str, Any] = {"tolerance": ROUNDING * length, "unit": scale, "rank": DEPENDENT}
    solution = solve(equations, poses_after, poses, steps=steps, **how)
    poses, missed, size = solution.points, solution.worst, solution.size
    if lengthening is None or len(poses) == 0:
        return SolvedPoses(poses[:, :, :3], poses[:, :, 3], missed, size)

    def constraints_and_readings(poses: Array) -> PoseEquations:
        rows = equations_at_readings(legs, poses[:, :, :3], poses[:, :, 3], lengthening)
        rows.by_pose[:, :, fixed] = 0.0
        return rows.of(~rows.measured | np.isfinite(lengthening[0, rows.leg]))

    if is_overdetermined(constraints_and_readings(poses), freedoms(frame_legs)):
        solution = solve(
            lambda poses: least_squares_equations(constraints_and_readings(poses)),
            poses_after,
            poses,
            steps=steps,
            **how,
        )
        poses, size = solution.points, solution.size
        missed = np.abs(equations(poses)[0]).max(axis=1, initial=0.0)
    return SolvedPoses(poses[:, :, :3], poses[:, :, 3], missed, size)


def solve_postures(
    legs: Sequence[Leg], frame_legs: Sequence[int], R: Array, t: Array, q: Array, scale: Array
) -> tuple[SolvedPoses, Array]:
    """Return the poses near R, t and readings near q (k, n) at which all constraints hold.

    Both move as little as possible, relative to *scale* (6 + n,); q are readings of actuators.
    """
    free = [*freedoms(frame_legs), *range(6, 6 + q.shape[1])]
    fixed = np.setdiff1d(np.arange(6 + q.shape[1]), free)

    def equations(points: Array) -> tuple[Array, Array]:
        poses = points[:, :12].reshape(-1, 3, 4)
        rows = posture_constraints(legs, poses[:, :, :3], poses[:, :, 3], points[:, 12:])
        jacobian = np.concatenate([rows.by_pose, rows.by_q], axis=2)
        jacobian[:, :, fixed] = 0.0
        return rows.values, jacobian

    def retract(points: Array, step: Array) -> Array:
        poses = poses_after(points[:, :12].reshape(-1, 3, 4), step[:, :6])
        return np.concatenate([poses.reshape(-1, 12), points[:, 12:] + step[:, 6:]], axis=1)

    points = np.concatenate([R, t[..., None]], axis=2).reshape(-1, 12)
    points = np.concatenate([points, q], axis=1)
    length = mean_length(legs, points[0, :12].reshape(3, 4)) if len(points) else 1.0
    solution = solve(
        equations, retract, points, tolerance=ROUNDING * length, unit=scale, rank=DEPENDENT
    )
    poses = solution.points[:, :12].reshape(-1, 3, 4)
    solved = SolvedPoses(poses[:, :, :3], poses[:, :, 3], solution.worst, solution.size)
    return solved, solution.points[:, 12:]


def project_pose(
    machine: Machine, T: RigidTransform, max_error: float = MAX_POSE_ERROR
) -> tuple[RigidTransform, str | None]:
    """Return the nearest pose that meets all constraints, and the obstacle if none is near.

    Residuals at the start, T_base_platform, may be up to *max_error* leg lengths.
    """
    if not is_constrained(machine):
        return T, None
    scale = leg_scale(machine, T)
    first = constraints_at(machine, T)
    worst = np.abs(first.values).max()
    if worst <= TOLERANCE * scale:
        return T, None
    if worst > max_error * scale:
        return T, describe_worst(machine, first)

    def equations(poses: Array) -> tuple[Array, Array]:
        rows = machine_equations(machine, poses[:, :, :3], poses[:, :, 3])
        constraints = ~rows.measured
        return rows.values[:, constraints], rows.by_pose[:, constraints]

    unit = np.array([1.0 / scale] * 3 + [1.0] * 3)
    solution = solve(
        equations, poses_after, T.as_matrix()[None, :3], tolerance=TOLERANCE * scale, unit=unit
    )
    projected = motion_of(solution.points[0, :, :3], solution.points[0, :, 3])
    if solution.worst[0] <= 1e-9 * scale:
        return projected, None
    return projected, describe_worst(machine, constraints_at(machine, projected))
