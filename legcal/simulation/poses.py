"""Platform poses of simulated machines (section 4.3): forward kinematics and random poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array
from legcal.mechanism.parameters import KinematicParameters
from legcal.simulation.machine import Machine

_ITERATIONS = 30


def leg_vectors(parameters: KinematicParameters, T_Rb_Re: RigidTransform) -> Array:
    """Return A_j B_j of every leg in R_b, (n_legs, 3) [m]."""
    return np.asarray(T_Rb_Re.apply(parameters.platform_joints) - parameters.base_joints)


def solve_pose(
    parameters: KinematicParameters, lengths: Array, start: RigidTransform
) -> RigidTransform:
    """Return the platform pose with given leg lengths that Newton's method finds from a start.

    Parameters
    ----------
    parameters : KinematicParameters
        Joint centres in R_b and R_e.
    lengths : (6,) array
        Leg lengths [m].
    start : RigidTransform
        T_Rb_Re near the answer.

    Returns
    -------
    RigidTransform
        T_Rb_Re.

    Raises
    ------
    DidNotConverge
        If the legs cannot reach these lengths from this start.
    """
    A, B = parameters.base_joints, parameters.platform_joints
    t, R = start.translation, start.rotation.as_matrix()
    tolerance = 1e-14 * float(np.max(lengths))
    best = np.inf
    for _ in range(_ITERATIONS):
        arms = B @ R.T
        legs = arms + t - A
        norms = np.sqrt(np.sum(legs * legs, axis=1))
        error = lengths - norms
        size = float(np.abs(error).max())
        if size < tolerance or (size < 100 * tolerance and size >= best):
            return RigidTransform.from_components(t, Rotation.from_matrix(R))
        best = min(best, size)
        u = legs / norms[:, None]
        step = np.linalg.lstsq(np.hstack([u, np.cross(arms, u)]), error, rcond=None)[0]
        t = t + step[:3]
        R = Rotation.from_rotvec(_limited(step[3:], 0.3)).as_matrix() @ R
    raise DidNotConverge(
        f"A simulated pose was not found: leg lengths are still {1e3 * best:.2g} mm off after "
        f"{_ITERATIONS} iterations; choose lengths that the machine can reach."
    )


def extreme_poses(
    machine: Machine, n_poses: int, rng: np.random.Generator, *, jitter: float = 0.12
) -> tuple[RigidTransform, ...]:
    """Return random poses with every leg near its shortest or its longest (section 4.3).

    Poses are followed from home in small steps, so that they stay in its assembly mode; those
    that cannot be reached or pass near a singularity are drawn again.

    Parameters
    ----------
    machine : Machine
        The machine.
    n_poses : int
        Number of poses.
    rng : numpy.random.Generator
        Source of the poses.
    jitter : float
        Legs stay within this part of the travel from one end of it.

    Returns
    -------
    tuple of RigidTransform
        T_Rb_Re.
    """
    lowest, highest = machine.travel.T
    poses: list[RigidTransform] = []
    for _ in range(1000 * n_poses):
        if len(poses) == n_poses:
            return tuple(poses)
        part = rng.integers(0, 2, machine.n_legs)
        part = np.abs(part - jitter * rng.random(machine.n_legs))
        try:
            poses.append(follow(machine, lowest + part * (highest - lowest)))
        except DidNotConverge:
            continue
    raise DidNotConverge(
        f"Only {len(poses)} of {n_poses} extreme poses of a simulated machine were found; "
        "check its travel."
    )


def follow(machine: Machine, lengths: Array, n_steps: int = 6) -> RigidTransform:
    """Return the pose with given leg lengths that is reached from home without a singularity.

    Raises
    ------
    DidNotConverge
        If it cannot be reached.
    """
    T = machine.home
    first = np.linalg.norm(leg_vectors(machine.parameters, T), axis=-1)
    for part in np.linspace(0.0, 1.0, n_steps + 1)[1:]:
        T = solve_pose(machine.parameters, first + part * (lengths - first), T)
        size = float(np.mean(np.linalg.norm(machine.parameters.platform_joints, axis=-1)))
        scaled = _jacobian(machine.parameters, T) / np.array([1.0, 1.0, 1.0, size, size, size])
        if np.linalg.svd(scaled, compute_uv=False)[-1] < 0.1:
            raise DidNotConverge("A simulated pose is near a singularity; draw another.")
    return T


def platform_error(
    machine: Machine, parameters: KinematicParameters, poses: Sequence[RigidTransform]
) -> tuple[float, float]:
    """Return the mean displacement and rotation of the platform that parameters cause, eq (20).

    Parameters
    ----------
    machine : Machine
        The true machine.
    parameters : KinematicParameters
        Other parameters, given the readings of the true machine.
    poses : sequence of RigidTransform
        True poses T_Rb_Re.

    Returns
    -------
    float, float
        Mean displacement of the origin of R_e [m] and mean angle [rad].
    """
    true = machine.parameters
    displacement, angle = [], []
    for T in poses:
        lengths = np.linalg.norm(leg_vectors(true, T), axis=-1)
        found = solve_pose(parameters, lengths - true.offsets + parameters.offsets, T)
        displacement.append(float(np.linalg.norm(found.translation - T.translation)))
        angle.append(float((found.rotation * T.rotation.inv()).magnitude()))
    return float(np.mean(displacement)), float(np.mean(angle))


def _jacobian(parameters: KinematicParameters, T_Rb_Re: RigidTransform) -> Array:
    """Return d lengths / d (translation, rotation vector in R_b), (n_legs, 6)."""
    legs = leg_vectors(parameters, T_Rb_Re)
    u = legs / np.linalg.norm(legs, axis=-1, keepdims=True)
    arms = T_Rb_Re.rotation.apply(parameters.platform_joints)
    return np.hstack([u, np.cross(arms, u)])


def _limited(step: Array, largest: float) -> Array:
    """Return a step shortened to the largest allowed norm."""
    norm = float(np.linalg.norm(step))
    return step if norm <= largest else step * (largest / norm)
