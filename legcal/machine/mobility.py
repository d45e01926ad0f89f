"""Mobility of the closed machine, free motions of its joints, and singularities.

The closures leave a null space of joint rates; the mobility is the rank of the resulting twists of
the platform. The rest of the null space does not move the platform: legs with an S joint at both
ends spin about themselves. Dependent closures (a planar machine welded in space) do not change it.

A platform has as many independent coordinates as freedoms, among x, y, z, roll, pitch, yaw of the
platform link in the base link; roll, pitch and yaw turn about the fixed axes x, y, z in this order.
The other coordinates follow from the constraints of the machine.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.lines import cross
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.equations import machine_equations
from legcal.machine.model import (
    B_at,
    Machine,
    Pose,
    pose_of,
    slider_columns,
    vectors_A_to_B,
    vectors_at,
)
from legcal.machine.solver import poses_after, solve

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
    chain = machine.chain
    weights = chain.row_weights(machine.size)

    def equations(points: Array) -> tuple[Array, Array]:
        residual, jacobian = chain.linearize(points[0])
        return (weights * residual)[None], (weights[:, None] * jacobian)[None]

    solution = solve(
        equations,
        lambda points, step: chain.integrate(points[0], step[0])[None],
        configuration[None],
        tolerance=0.01 * CLOSED,
        unit=chain.column_units(machine.size),
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


def dimensionless(
    machine: Machine,
    poses: Array,
    motors: Sequence[int] | None = None,
) -> Array:
    """Return the Jacobians of :func:`singularity`, (k, n_rows, 6): rotation, displacement.

    Poses are matrices T_base_platform (k, 3 or 4, 4). *motors* limits the motors, all by default.
    """
    motors = list(machine.motors if motors is None else motors)
    equations = machine_equations(machine, poses[:, :3, :3], poses[:, :3, 3])
    counts = ~equations.measured | np.isin(equations.leg, motors)
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
    equations = machine_equations(machine, pose[:, :, :3], pose[:, :, 3])
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
        rows = machine_equations(machine, poses[:, :, :3], poses[:, :, 3])
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
