"""Poses and the closed chain, solved: poses of legs at readings, the chain at a pose.

:func:`solve_poses` finds poses from the equations of legs alone, :func:`project_pose` the nearest
pose that meets all constraints, :func:`close_at` all joint values of all legs at a pose: sliders
follow from the pose, and joint angles are solved from the closures of the URDF in Pinocchio.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import DidNotConverge
from legcal.geometry.motions import motion_of
from legcal.geometry.types import Array, BoolArray, IntArray
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
from legcal.machine.mobility import CLOSED, leg_scale
from legcal.machine.model import Machine, readings_at, slider_columns
from legcal.machine.solver import Equations, Retraction, poses_after, postures_after, solve

# Tolerances [rad], and lengths relative to the leg length.
POSE_TOLERANCE = 2.5e-11  # pose error of the platform of a closed chain
AXIS_TOLERANCE = 2e-3  # closure error due to inexact axes; no other posture comes so close
RESTARTS = 60
TOLERANCE, ROUNDING = 1e-13, 2.5e-15  # residuals of a solved pose, in leg lengths
MAX_POSE_ERROR = 0.01  # largest distance of a given pose from a closed one, in leg lengths
DEPENDENT = 1e-7  # singular value of dependent equations, relative to the largest


def close_at(
    machine: Machine,
    T_base_platform: RigidTransform,
    start: Array | None = None,
    restarts: int = RESTARTS,
    *,
    exact: bool = True,
) -> Array:
    """Return the configuration (nq,) that closes every loop with the platform at a pose.

    Sliders, and motors that carry rods, are set from the pose, so that no leg is ever flipped; the
    other joint angles are solved from ``start``, and for legs that do not close from there also
    from seeded random angles. The pose must meet the constraints; unless it is *exact* the platform
    is free in the final solve and absorbs the errors of axes in the model.

    Raises
    ------
    DidNotConverge
        If a leg does not close; the message names its closure and the remaining distance.
    """
    chain, metre = machine.chain, leg_scale(machine, T_base_platform)
    most = POSE_TOLERANCE if exact else AXIS_TOLERANCE
    tolerance = metre * most, most
    angles = np.zeros(chain.nv, dtype=np.bool_)
    for joint in machine.urdf.joints.values():
        if joint.type in ("revolute", "continuous", "prismatic"):
            angles[chain.v_index(joint.name)] = True
    set_first = slider_columns(machine, range(machine.n_legs))[1]
    angles[set_first] = False
    configuration = _placed(machine, T_base_platform, start, tolerance)
    rng = np.random.default_rng(20020701)
    # Gaps in leg lengths: gaps of short legs would weigh too little beside angles.
    for _ in range(restarts):
        equations, retract = closure_equations(machine, T_base_platform, metre, angles)
        solution = solve(
            equations, retract, configuration[None], tolerance=0.01 * CLOSED, damped=True
        )
        configuration = solution.points[0]
        stuck = np.abs(solution.values[0]) > AXIS_TOLERANCE
        if not stuck.any():
            break
        columns = np.zeros(chain.nv, dtype=np.bool_)
        columns[angles] = np.abs(solution.jacobian[0, stuck]).max(axis=0) > 1e-9
        step = np.where(columns, rng.uniform(-np.pi, np.pi, chain.nv), 0.0)
        configuration = chain.integrate(configuration, step)
    everything = closure_equations(machine, T_base_platform, metre, angles)
    left = everything[0](configuration[None])[0][0]
    if np.abs(left).max(initial=0.0) >= CLOSED:
        angles[set_first] = True
        pose = T_base_platform if exact else None
        freedoms = angles if exact else np.ones(chain.nv, dtype=np.bool_)
        equations, retract = closure_equations(machine, pose, metre, freedoms)
        solution = solve(
            equations, retract, configuration[None], tolerance=0.01 * CLOSED, damped=True
        )
        configuration, left = solution.points[0], solution.values[0]
    off = _pose_error(machine, T_base_platform, configuration)
    if np.abs(left).max(initial=0.0) >= CLOSED:
        gap = worst_closure(machine, metre * left)
        problem = f"{gap}, needed less than {metre * CLOSED:.0e} m"
    elif off[0] > tolerance[0] or off[1] > tolerance[1]:
        problem = (
            f"the platform moved {_error_in_words(off)} away, needed a pose that the legs allow"
        )
    else:
        return configuration
    raise _not_closed(machine, T_base_platform, problem)


def worst_closure(machine: Machine, residual: Array) -> str:
    """Return the closure with the largest residual, in words."""
    row = 0
    worst = (0.0, "the platform pose")
    for closure in machine.chain.closures:
        gap = float(np.abs(residual[row : row + closure.rows]).max())
        worst = max(worst, (gap, f"'{closure.frame_1}' and '{closure.frame_2}'"))
        row += closure.rows
    return f"{worst[1]} stay {worst[0]:.3g} m apart"


def _placed(
    machine: Machine,
    T_base_platform: RigidTransform,
    start: Array | None,
    tolerance: tuple[float, float],
) -> Array:
    """Return a configuration with the platform and the sliders set."""
    chain = machine.chain
    configuration = chain.neutral() if start is None else start.copy()
    if machine.platform_joint is not None:
        configuration = chain.with_platform(
            configuration,
            machine.platform_joint,
            machine.base,
            machine.platform,
            T_base_platform,
        )
        off = _pose_error(machine, T_base_platform, configuration)
        if off[0] > tolerance[0] or off[1] > tolerance[1]:
            raise _not_closed(
                machine,
                T_base_platform,
                f"the virtual joint '{machine.platform_joint}' leaves it "
                f"{_error_in_words(off)} away, needed a joint that reaches it",
            )
    q = readings_at(machine, T_base_platform)
    sliding = [j for j, leg in enumerate(machine.legs) if leg.prismatic is not None]
    configuration[slider_columns(machine, sliding)[0]] = q[sliding]
    return configuration


def closure_equations(
    machine: Machine, T: RigidTransform | None, metre: float, free: BoolArray | IntArray
) -> tuple[Equations, Retraction]:
    """Return the closures as functions of free tangent coordinates, the platform fixed at T.

    Lengths are divided by ``metre``.
    """
    chain = machine.chain
    weld = T if machine.platform_joint is None else None
    of_weld = [1.0 / metre] * 3 + [1.0] * 3
    weights = np.append(chain.row_weights(metre), of_weld if weld is not None else [])

    def equations(points: Array) -> tuple[Array, Array]:
        residual, jacobian = chain.linearize(points[0])
        if weld is not None:
            of_pose, by_joints = chain.welded(machine.base, machine.platform, weld)
            residual = np.concatenate([residual, of_pose])
            jacobian = np.concatenate([jacobian, by_joints])
        return (residual * weights)[None], (jacobian[:, free] * weights[:, None])[None]

    def retract(points: Array, step: Array) -> Array:
        full = np.zeros(chain.nv)
        full[free] = step[0]
        return chain.integrate(points[0], full)[None]

    return equations, retract


def _pose_error(
    machine: Machine, T_base_platform: RigidTransform, configuration: Array
) -> tuple[float, float]:
    """Return distance [m] and angle [rad] of the platform from its required pose."""
    R, t = machine.chain.placement(configuration, machine.base, machine.platform)
    matrix = T_base_platform.as_matrix()
    chord = float(np.linalg.norm(R - matrix[:3, :3]))  # accurate for small and large angles
    turn = 2.0 * float(np.arcsin(min(1.0, chord / np.sqrt(8.0))))
    return float(np.linalg.norm(t - matrix[:3, 3])), turn


def _error_in_words(off: tuple[float, float]) -> str:
    """Return a distance and an angle in words, without one that is negligible beside the other."""
    parts = f"{1e3 * off[0]:.3g} mm", f"{np.degrees(off[1]):.3g} deg"
    return " and ".join(text for text, x in zip(parts, off, strict=True) if x > 1e-6 * max(off))


def _not_closed(machine: Machine, T_base_platform: RigidTransform, problem: str) -> DidNotConverge:
    """Return the error of a pose at which the chain does not close."""
    place = "(" + ", ".join(f"{1e3 * x:.1f}" for x in T_base_platform.translation) + ")"
    return DidNotConverge(
        f"the legs could not be closed with the platform at {place} mm: "
        f"{problem}; check that the legs reach this pose ({machine.urdf.wording.home}).",
        file=machine.yaml_path,
    )


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

    points = np.concatenate([R, t[..., None]], axis=2).reshape(-1, 12)
    points = np.concatenate([points, q], axis=1)
    length = mean_length(legs, points[0, :12].reshape(3, 4)) if len(points) else 1.0
    solution = solve(
        equations, postures_after, points, tolerance=ROUNDING * length, unit=scale, rank=DEPENDENT
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
