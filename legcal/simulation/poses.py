"""Platform poses of simulated machines (section 4.3): forward kinematics and random poses.

All poses are solved at once; a pose alone is a batch of one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array, BoolArray
from legcal.mechanism.parameters import KinematicParameters
from legcal.simulation.machine import Machine

_ITERATIONS = 30
_EXACT = 1e-14  # of the lengths
_ON_THE_WAY = 1e-6
_LARGEST_TURN = 0.3  # [rad] in one iteration
_DAMPING = 1e-12  # keeps singular poses solvable, and is nothing beside others
_SINGULAR = 0.1  # smallest singular value of the scaled Jacobian that a pose may have


def leg_vectors(parameters: KinematicParameters, T_Rb_Re: RigidTransform) -> Array:
    """Return A_j B_j of every leg in R_b, (n_legs, 3) [m]."""
    return np.asarray(T_Rb_Re.apply(parameters.platform_joints) - parameters.base_joints)


def leg_vectors_of_poses(parameters: KinematicParameters, T_Rb_Re: RigidTransform) -> Array:
    """Return A_j B_j of every leg in R_b at each of several poses, (n_poses, n_legs, 3) [m]."""
    return _legs(parameters, T_Rb_Re.rotation.as_matrix(), T_Rb_Re.translation)[0]


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
    return solve_poses(parameters, lengths[None, :], RigidTransform.concatenate([start]))[0]


def solve_poses(
    parameters: KinematicParameters, lengths: Array, start: RigidTransform
) -> RigidTransform:
    """Return the platform poses of :func:`solve_pose` for each row of lengths.

    Parameters
    ----------
    parameters : KinematicParameters
        Joint centres in R_b and R_e.
    lengths : (n_poses, 6) array
        Leg lengths [m].
    start : RigidTransform, n_poses of them
        T_Rb_Re near the answers.

    Returns
    -------
    RigidTransform
        T_Rb_Re, n_poses of them.

    Raises
    ------
    DidNotConverge
        If the legs cannot reach some row of lengths from its start.
    """
    R, t, error = _newton(parameters, lengths, start.rotation.as_matrix(), start.translation)
    if not np.all(error == 0.0):
        raise DidNotConverge(
            f"A simulated pose was not found: leg lengths are still {1e3 * error.max():.2g} mm off "
            f"after {_ITERATIONS} iterations; choose lengths that the machine can reach."
        )
    return RigidTransform.from_components(t, Rotation.from_matrix(R))


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

    def draw() -> Array:
        part = rng.integers(0, 2, machine.n_legs)
        return np.asarray(np.abs(part - jitter * rng.random(machine.n_legs)))

    return _drawn_poses(machine, n_poses, draw)


def random_poses(
    machine: Machine, n_poses: int, rng: np.random.Generator
) -> tuple[RigidTransform, ...]:
    """Return random poses with every leg length drawn uniformly from its travel.

    They are followed from home as those of :func:`extreme_poses`.
    """
    return _drawn_poses(machine, n_poses, lambda: rng.random(machine.n_legs))


def follow(machine: Machine, lengths: Array, n_steps: int = 6) -> RigidTransform:
    """Return the pose with given leg lengths that is reached from home without a singularity.

    Raises
    ------
    DidNotConverge
        If it cannot be reached.
    """
    R, t, reached = _followed(machine, lengths[None, :], n_steps)
    if not reached[0]:
        raise DidNotConverge(
            "A simulated pose cannot be reached from home without passing near a singularity; "
            "choose lengths that the machine can reach."
        )
    return RigidTransform.from_components(t[0], Rotation.from_matrix(R[0]))


def poses_from_home(machine: Machine, lengths: Array) -> tuple[RigidTransform, ...]:
    """Return the poses with given leg lengths, followed from home.

    Parameters
    ----------
    machine : Machine
        The machine.
    lengths : (n_poses, n_legs) array
        Leg lengths [m].

    Returns
    -------
    tuple of RigidTransform
        T_Rb_Re; where it cannot be reached, how far it came.
    """
    R, t, _ = _followed(machine, lengths)
    return tuple(RigidTransform.from_components(t, Rotation.from_matrix(R)))


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
    true = RigidTransform.concatenate(list(poses))
    found = poses_of_readings(machine, parameters, true)
    displacement = np.linalg.norm(found.translation - true.translation, axis=-1)
    angle = (found.rotation * true.rotation.inv()).magnitude()
    return float(np.mean(displacement)), float(np.mean(angle))


def poses_of_readings(
    machine: Machine, parameters: KinematicParameters, T_Rb_Re: RigidTransform
) -> RigidTransform:
    """Return the poses that other parameters compute from the readings of true poses.

    Parameters
    ----------
    machine : Machine
        The true machine.
    parameters : KinematicParameters
        Other parameters.
    T_Rb_Re : RigidTransform, n_poses of them
        True poses.

    Returns
    -------
    RigidTransform
        T_Rb_Re of the other parameters, n_poses of them.

    Raises
    ------
    DidNotConverge
        If they cannot have these readings.
    """
    lengths = np.linalg.norm(leg_vectors_of_poses(machine.parameters, T_Rb_Re), axis=-1)
    changed = lengths - machine.parameters.offsets + parameters.offsets
    return solve_poses(parameters, changed, T_Rb_Re)


def _drawn_poses(
    machine: Machine, n_poses: int, draw: Callable[[], Array]
) -> tuple[RigidTransform, ...]:
    """Return poses whose leg lengths are drawn, as parts of the travel, until enough are reached.

    Each round draws as many as are missing, so that the draws are those of one pose at a time.
    """
    lowest, highest = machine.travel.T
    R, t = np.zeros((0, 3, 3)), np.zeros((0, 3))
    for _ in range(1000):
        if len(R) == n_poses:
            break
        part = np.array([draw() for _ in range(n_poses - len(R))])
        R_new, t_new, reached = _followed(machine, lowest + part * (highest - lowest))
        R, t = np.concatenate([R, R_new[reached]]), np.concatenate([t, t_new[reached]])
    if len(R) < n_poses:
        raise DidNotConverge(
            f"Only {len(R)} of {n_poses} random poses of a simulated machine were found; "
            "check its travel."
        )
    return tuple(RigidTransform.from_components(t, Rotation.from_matrix(R)))


def _followed(machine: Machine, lengths: Array, n_steps: int = 6) -> tuple[Array, Array, BoolArray]:
    """Return R and t of rows of lengths followed from home, and which of them were reached.

    The others stay at the last step that was well.
    """
    n = len(lengths)
    R = np.tile(machine.home.rotation.as_matrix(), (n, 1, 1))
    t = np.tile(machine.home.translation, (n, 1))
    reached = np.ones(n, dtype=np.bool_)
    first = np.linalg.norm(leg_vectors(machine.parameters, machine.home), axis=-1)
    size = float(np.mean(np.linalg.norm(machine.parameters.platform_joints, axis=-1)))
    unit = np.array([1.0, 1.0, 1.0, size, size, size])
    for part in np.linspace(0.0, 1.0, n_steps + 1)[1:]:
        here = np.flatnonzero(reached)
        wanted = first + part * (lengths[here] - first)
        accuracy = _EXACT if part == 1.0 else _ON_THE_WAY
        R_new, t_new, error = _newton(machine.parameters, wanted, R[here], t[here], accuracy)
        J = _jacobian(machine.parameters, R_new, t_new) / unit
        smallest = np.linalg.svd(J, compute_uv=False)[:, -1]
        well = (error == 0.0) & (smallest >= _SINGULAR)
        R[here[well]], t[here[well]] = R_new[well], t_new[well]
        reached[here] = well
    return R, t, reached


def _newton(
    parameters: KinematicParameters, lengths: Array, R: Array, t: Array, accuracy: float = _EXACT
) -> tuple[Array, Array, Array]:
    """Return R, t and the remaining error [m] of each pose; zero where Newton's method arrived."""
    R, t = R.copy(), t.copy()
    tolerance = accuracy * lengths.max(axis=1, initial=0.0)
    best = np.full(len(R), np.inf)
    active = np.arange(len(R))
    for _ in range(_ITERATIONS):
        legs, arms = _legs(parameters, R[active], t[active])
        norms = np.linalg.norm(legs, axis=-1)
        error = lengths[active] - norms
        size = np.abs(error).max(axis=1, initial=0.0)
        limit = tolerance[active]
        done = (size < limit) | ((size < 100 * limit) & (size >= best[active]))
        best[active] = np.where(done, 0.0, np.minimum(best[active], size))
        active = active[~done]
        if len(active) == 0:
            break
        u = legs[~done] / norms[~done, :, None]
        J = np.concatenate([u, np.cross(arms[~done], u)], axis=-1)
        N = np.swapaxes(J, -1, -2) @ J + _DAMPING * np.eye(6)
        step = np.linalg.solve(N, np.swapaxes(J, -1, -2) @ error[~done, :, None])[..., 0]
        turn = np.linalg.norm(step[:, 3:], axis=1, keepdims=True)
        t[active] += step[:, :3]
        turned = step[:, 3:] * np.minimum(1.0, _LARGEST_TURN / np.maximum(turn, 1e-300))
        R[active] = _turn(turned) @ R[active]
    return R, t, best


def _turn(w: Array) -> Array:
    """Return the rotations of Gibbs vectors w / 2 (n, 3): by w [rad] where that is small."""
    g = 0.5 * w
    cross = np.zeros((len(w), 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]] = g
    cross[:, [1, 2, 0], [2, 0, 1]] = -g
    scale = 2.0 / (1.0 + np.sum(g**2, axis=1))[:, None, None]
    return np.asarray(np.eye(3) + scale * (cross + cross @ cross))


def _legs(parameters: KinematicParameters, R: Array, t: Array) -> tuple[Array, Array]:
    """Return A B and R B of all legs at all poses, both (n_poses, n_legs, 3) [m]."""
    arms = parameters.platform_joints @ np.swapaxes(R, -1, -2)
    return arms + t[..., None, :] - parameters.base_joints, arms


def length_jacobian(parameters: KinematicParameters, T_Rb_Re: RigidTransform) -> Array:
    """Return d lengths / d (translation, rotation vector in R_b) at poses, (n_poses, n_legs, 6)."""
    return _jacobian(parameters, T_Rb_Re.rotation.as_matrix(), T_Rb_Re.translation)


def _jacobian(parameters: KinematicParameters, R: Array, t: Array) -> Array:
    """Return d lengths / d (translation, rotation vector in R_b), (n_poses, n_legs, 6)."""
    legs, arms = _legs(parameters, R, t)
    u = legs / np.linalg.norm(legs, axis=-1, keepdims=True)
    return np.concatenate([u, np.cross(arms, u)], axis=-1)
