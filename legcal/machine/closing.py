"""The closed chain: closing it at a pose, its free motions, mobility, singularities.

:func:`solve_poses` finds poses from the equations of legs alone, :func:`project_pose` the nearest
pose that meets all constraints, :func:`close_at` all joint values of all legs at a pose: sliders
follow from the pose, and joint angles are solved from the closures of the URDF in Pinocchio.

The closures leave a null space of joint rates; the mobility is the rank of the resulting twists of
the platform. The rest of the null space does not move the platform: legs with an S joint at both
ends spin about themselves. Dependent closures (a planar machine welded in space) do not change it.

A platform has as many independent coordinates as freedoms, among x, y, z, roll, pitch, yaw of the
platform link in the base link; roll, pitch and yaw turn about the fixed axes x, y, z in this order.
The other coordinates follow from the constraints of the machine.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import DidNotConverge
from legcal.geometry.lines import cross
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
from legcal.machine.model import (
    B_at,
    Machine,
    Pose,
    pose_of,
    readings_at,
    slider_columns,
    vectors_A_to_B,
    vectors_at,
)
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
    *,
    exact: bool = True,
) -> Array:
    """Return the configuration (nq,) that closes every loop with the platform at a pose.

    Sliders, and motors that carry rods, are set from the pose, so that no leg is ever flipped; the
    other joint angles are solved from ``start``, and for legs that do not close from there also
    from seeded random angles. The pose must meet the constraints; unless it is *exact* the platform
    is free in the final solve and absorbs the errors of axes in the model.

    Raises DidNotConverge if a leg does not close; the message names its closure and the remaining
    distance.
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
    for _ in range(RESTARTS):
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
    off = pose_error(machine, T_base_platform, configuration)
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
        worst = max(worst, (gap, str(closure)))
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
        off = pose_error(machine, T_base_platform, configuration)
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


def pose_error(
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
        rows = machine_equations(machine, poses)
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


CLOSED = 2.5e-12  # residual of a closed chain [mean leg lengths, rad]
RANK_TOLERANCE = 1e-7  # relative to the largest singular value, with lengths in leg lengths
STEP = 0.05  # step to a generic configuration [rad], and relative to the leg length
CONFIGURATIONS = 3
COORDINATES = ("x", "y", "z", "roll", "pitch", "yaw")
_REACHED = 1e-9  # largest error of a pose reached, relative to the size of the machine
_FREE = 0.1  # least independent motion of a chosen coordinate
LOOSE = 0.01  # singularity measure of home below which motors hardly hold the platform
MAX_CHANGE = 0.5  # norm of J0^-1 J1 - 1 that excludes a singularity between J0 and J1


def leg_scale(machine: Machine, T_base_platform: RigidTransform) -> float:
    """Return the mean length of the legs at a pose [m]."""
    return float(np.linalg.norm(vectors_A_to_B(machine, T_base_platform), axis=1).mean())


def mobility(machine: Machine, configurations: Sequence[Array]) -> int:
    """Return the number of freedoms of the platform.

    It is evaluated at the configuration where the closures have the largest rank. Some of the
    configurations should only be near home, because a symmetric home may be singular.
    """
    return min(freedoms_at(machine, c) for c in configurations)[1]


def freedoms_at(machine: Machine, configuration: Array) -> tuple[int, int]:
    """Return the freedoms of all joints, and of the platform alone, at a closed configuration."""
    null_space = free_motions(machine, configuration)
    return null_space.shape[1], _moved(machine, null_space)


def motor_rank(machine: Machine, configurations: Sequence[Array]) -> int:
    """Return the number of freedoms of the platform that the motors hold.

    It is the mobility minus the freedoms with fixed motors, at the configuration of
    :func:`mobility` with the fewest.
    """
    _, sliders = slider_columns(machine, machine.motors)
    scale, left = machine.size, []
    for configuration in configurations:
        null_space = free_motions(machine, configuration)
        _, values, right = np.linalg.svd(null_space[sliders] / scale)
        left.append(_moved(machine, null_space @ right[int(np.sum(values > RANK_TOLERANCE)) :].T))
    return machine.mobility - min(left)


def _moved(machine: Machine, motions: Array) -> int:
    """Return the rank of platform twists by motions (nv, k) of the joints, at the linearisation."""
    scale = machine.size
    twist = machine.chain.twist(machine.base, machine.platform) @ motions
    twist[:3] /= scale
    return int(np.sum(np.linalg.svd(twist, compute_uv=False) > RANK_TOLERANCE))


def generic_configurations(machine: Machine, count: int) -> list[Array]:
    """Return home, then up to ``count - 1`` closed ones nearby in seeded directions."""
    chain, configurations = machine.chain, [machine.home_configuration]
    rng = np.random.default_rng(1965)
    unit = chain.column_units(machine.size)
    jacobian = chain.linearize(machine.home_configuration)[1] * unit
    inverse = np.linalg.pinv(jacobian, rcond=RANK_TOLERANCE)
    for _ in range(count - 1):
        direction = rng.normal(size=chain.nv)
        direction -= inverse @ (jacobian @ direction)
        size = float(np.abs(direction).max())
        if size < RANK_TOLERANCE:
            break  # nothing moves
        step = STEP * unit * direction / size
        configuration = project(machine, chain.integrate(machine.home_configuration, step))
        if configuration is not None:
            configurations.append(configuration)
    return configurations


def project(machine: Machine, configuration: Array) -> Array | None:
    """Return the closed configuration nearest to an almost closed one, None if there is none."""
    every = np.ones(machine.chain.nv, dtype=np.bool_)
    solution = solve(
        *closure_equations(machine, None, machine.size, every),
        configuration[None],
        tolerance=0.01 * CLOSED,
        unit=machine.chain.column_units(machine.size),
        steps=15,
    )
    return solution.points[0] if solution.worst[0] < CLOSED else None


def free_motions(machine: Machine, configuration: Array) -> Array:
    """Return a basis (nv, k) of the tangent steps that keep all loops closed, with idle spins.

    It is orthonormal, with lengths in leg lengths.
    """
    chain = machine.chain
    units = chain.column_units(machine.size)
    jacobian = chain.linearize(configuration)[1] * units
    jacobian *= chain.row_weights(machine.size)[:, None]
    _, values, right = np.linalg.svd(jacobian)
    rank = int(np.sum(values > RANK_TOLERANCE * values[0])) if len(values) else 0
    return np.asarray(units[:, None] * right[rank:].T)


def singularity(mechanism: Machine, T_base_platform: Pose) -> float:
    """Return the smallest singular value of the dimensionless Jacobian of the legs' equations.

    Rows are the lengths of actuated and constant legs and all other constraints, as lengths at the
    end of their leg; columns are a rotation about the mean of the platform joints and a
    displacement. Lengths are in mean leg lengths at the pose and angles in radian, so that the
    number is dimensionless and independent of the size of the machine and the frames of its links.

    Parameters
    ----------
    mechanism : Machine
        The machine.
    T_base_platform : RigidTransform, SE3 or (4, 4) array
        A pose; its readings need not be inside the travel.

    Returns
    -------
    float
        Zero at a singular pose, and if the motors do not determine the pose; of the order of the
        platform size in leg lengths at a good pose.
    """
    return float(singularities(mechanism, pose_of(T_base_platform).as_matrix()[None])[0])


def singularities(machine: Machine, poses: Array) -> Array:
    """Return :func:`singularity` at poses (k, 3 or 4, 4), (k,)."""
    jacobian = dimensionless(machine, poses)
    if jacobian.shape[1] < 6:
        return np.zeros(len(poses))
    return np.asarray(np.linalg.svd(jacobian, compute_uv=False)[:, 5])


def dimensionless(machine: Machine, poses: Array) -> Array:
    """Return the Jacobians of :func:`singularity`, (k, n_rows, 6): rotation, displacement.

    Poses are matrices T_base_platform (k, 3 or 4, 4).
    """
    equations = machine_equations(machine, poses)
    counts = ~equations.measured | np.isin(equations.leg, machine.motors)
    gradient, moment = equations.by_pose[:, counts, 3:], equations.by_pose[:, counts, :3]
    scale = np.linalg.norm(vectors_at(machine, poses), axis=2).mean(axis=1)[:, None, None]
    centre = (B_at(machine, poses) - poses[:, None, :3, 3]).mean(axis=1, keepdims=True)
    return np.concatenate([(moment - cross(centre, gradient)) / scale, gradient], axis=2)


def is_on_same_side(reference: Array, jacobian: Array) -> bool:
    """Return whether two Jacobians of :func:`dimensionless` are on the same side of singularities.

    Determinants of square Jacobians then have the same sign. With more rows (dependent constraints)
    the sum of the products of all minors, det(J0' J1), is positive. It is zero if the motors do not
    determine the pose.
    """
    return len(reference) >= reference.shape[1] and bool(
        np.linalg.det(reference.T @ jacobian) > 0.0
    )


def excludes_singularity(reference: Array, jacobian: Array) -> bool:
    """Return whether two Jacobians are too close for a singular one between them."""
    difference = jacobian - reference
    if reference.shape[0] == reference.shape[1]:
        try:
            change = np.linalg.solve(reference, difference)
        except np.linalg.LinAlgError:
            change = np.full_like(reference, np.inf)
        if float(np.abs(change).sum(axis=1).max()) < MAX_CHANGE:
            return True
    left, values, right = np.linalg.svd(reference, full_matrices=False)
    rank = int(np.sum(values > 1e-6 * values[0]))
    change = (left[:, :rank].T @ difference @ right[:rank].T) / values[:rank, None]
    return float(np.linalg.norm(change, 2)) < MAX_CHANGE


def independent_coordinates(machine: Machine) -> IntArray:
    """Return the independent coordinates of a machine as indices, positions before angles.

    Coordinates are chosen in order. One is chosen if a motion that the constraints allow at home,
    and that keeps those chosen before, moves it by at least a tenth of the motion; rotations count
    in leg lengths.
    """
    pose = machine.home.as_matrix()[None, :3]
    equations = machine_equations(machine, pose)
    scale = machine.size
    unit = np.array([1.0 / scale] * 3 + [1.0] * 3)
    constraints = equations.by_pose[0, ~equations.measured] * unit
    _, _, rows = np.linalg.svd(np.vstack([constraints, np.zeros((6, 6))]))
    free = rows[6 - machine.mobility :] * unit  # (m, 6) motions
    slopes = coordinates_of(pose)[1][0]
    moved = (slopes @ free.T) * np.array([1.0] * 3 + [scale] * 3)[:, None]
    chosen: list[int] = []
    for least in (_FREE, 0.0):  # the second pass takes any that is left
        for k in range(len(COORDINATES)):
            basis = np.linalg.qr(moved[chosen].T)[0] if chosen else np.zeros((machine.mobility, 0))
            new = moved[k] - basis @ (basis.T @ moved[k])
            if k not in chosen and len(chosen) < machine.mobility and np.linalg.norm(new) > least:
                chosen.append(k)
    return np.array(sorted(chosen), dtype=np.intp)


def poses_at_coordinates(
    machine: Machine, columns: IntArray, coordinates: Array, near: Array
) -> tuple[Array, BoolArray]:
    """Return the poses (k, 3, 4) at values (k, m) of some coordinates, and which were reached (k,).

    The search for values [m, rad] of the coordinates *columns* starts at poses *near*, (3, 4) or
    (k, 3, 4).
    """
    scale = machine.size

    def equations(poses: Array) -> tuple[Array, Array]:
        rows = machine_equations(machine, poses)
        keep = ~rows.measured
        values, slopes = coordinates_of(poses)
        unit = np.where(columns < 3, 1.0, scale)
        off = turned_back(values[:, columns] - coordinates, columns) * unit
        return (
            np.concatenate([rows.values[:, keep], off], axis=1),
            np.concatenate([rows.by_pose[:, keep], slopes[:, columns] * unit[:, None]], axis=1),
        )

    unit = np.array([1.0 / scale] * 3 + [1.0] * 3)
    start = np.broadcast_to(near, (len(coordinates), 3, 4)).copy()
    solution = solve(equations, poses_after, start, tolerance=1e-14 * scale, unit=unit)
    return solution.points, solution.worst <= _REACHED * scale


def coordinates_of(poses: Array) -> tuple[Array, Array]:
    """Return x, y, z, roll, pitch, yaw (k, 6) [m, rad] of poses, and their slopes (k, 6, 6).

    Slopes are by rotations about the origin of the platform link and displacements in the base.
    """
    R = poses[:, :, :3]
    roll = np.arctan2(R[:, 2, 1], R[:, 2, 2])
    pitch = np.arctan2(-R[:, 2, 0], np.hypot(R[:, 2, 1], R[:, 2, 2]))
    yaw = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    values = np.concatenate([poses[:, :, 3], np.stack([roll, pitch, yaw], axis=1)], axis=1)
    slopes = np.zeros((len(poses), 6, 6))
    slopes[:, :3, 3:] = np.eye(3)
    cos_y, sin_y = np.cos(yaw), np.sin(yaw)
    cos_p, tan_p = np.cos(pitch), np.tan(pitch)
    slopes[:, 3, 0], slopes[:, 3, 1] = cos_y / cos_p, sin_y / cos_p
    slopes[:, 4, 0], slopes[:, 4, 1] = -sin_y, cos_y
    slopes[:, 5, 0], slopes[:, 5, 1], slopes[:, 5, 2] = cos_y * tan_p, sin_y * tan_p, 1.0
    return values, slopes


def turned_back(differences: Array, columns: IntArray) -> Array:
    """Return differences of coordinates, those of angles within half a turn."""
    turns = np.where(columns < 3, 0.0, 2.0 * np.pi)
    return np.asarray(
        differences - turns * np.round(differences / np.where(columns < 3, 1.0, turns))
    )
