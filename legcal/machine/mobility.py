"""Mobility of the closed machine, free motions of its joints, and singularities.

The closures leave a null space of joint rates; the mobility is the rank of the resulting twists of
the platform. The rest of the null space does not move the platform: legs with an S joint at both
ends spin about themselves. Dependent closures (a planar machine welded in space) do not change it.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.lines import cross
from legcal.geometry.types import Array
from legcal.machine.equations import is_constrained, machine_equations
from legcal.machine.model import (
    B_at,
    Machine,
    slider_columns,
    vectors_A_to_B,
    vectors_at,
)
from legcal.machine.pose_input import Pose, pose_of
from legcal.machine.solver import solve

CLOSED = 2.5e-12  # residual of a closed chain [mean leg lengths, rad]
RANK_TOLERANCE = 1e-7  # relative to the largest singular value, with lengths in leg lengths
STEP = 0.05  # step to a generic configuration [rad], and relative to the leg length
CONFIGURATIONS = 3
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
    unit = _column_units(machine)
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
    chain, weights = machine.chain, _row_weights(machine)

    def equations(points: Array) -> tuple[Array, Array]:
        residual, jacobian = chain.linearize(points[0])
        return (weights * residual)[None], (weights[:, None] * jacobian)[None]

    solution = solve(
        equations,
        lambda points, step: chain.integrate(points[0], step[0])[None],
        configuration[None],
        tolerance=0.01 * CLOSED,
        unit=_column_units(machine),
        steps=15,
    )
    return solution.points[0] if solution.worst[0] < CLOSED else None


def free_motions(machine: Machine, configuration: Array) -> Array:
    """Return a basis (nv, k) of the tangent steps that keep all loops closed, with idle spins.

    It is orthonormal, with lengths in leg lengths.
    """
    units = _column_units(machine)
    jacobian = machine.chain.linearize(configuration)[1] * units
    jacobian *= _row_weights(machine)[:, None]
    _, values, right = np.linalg.svd(jacobian)
    rank = int(np.sum(values > RANK_TOLERANCE * values[0])) if len(values) else 0
    return np.asarray(units[:, None] * right[rank:].T)


def _row_weights(machine: Machine) -> Array:
    """Return the weights of closure residuals: lengths in leg lengths beside [rad]."""
    weights, row = np.ones(machine.chain.n_rows), 0
    for closure in machine.chain.closures:
        weights[row : row + 3] = 1.0 / machine.size
        row += closure.rows
    return weights


def _column_units(machine: Machine) -> Array:
    """Return the units of tangent steps: [m] and [rad] per dimensionless step."""
    units = np.full(machine.chain.nv, machine.size)
    units[machine.chain.rotation_columns()] = 1.0
    return units


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
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    turned = B_at(machine, poses) - t[:, None]
    vectors = vectors_at(machine, poses)
    lengths = np.linalg.norm(vectors, axis=2)
    scale = lengths.mean(axis=1)[:, None, None]
    centre = turned.mean(axis=1, keepdims=True)
    if is_constrained(machine):
        equations = machine_equations(machine, R, t)
        counts = ~equations.measured | np.isin(equations.leg, motors)
        jacobian = equations.by_pose[:, counts]
        gradient, moment = jacobian[:, :, 3:], jacobian[:, :, :3]
        return np.concatenate([(moment - cross(centre, gradient)) / scale, gradient], axis=2)
    u = (vectors / lengths[..., None])[:, motors]  # plain lengths; one rod for each actuator
    return np.concatenate([cross((turned - centre)[:, motors] / scale, u), u], axis=2)


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
