"""Forward kinematics of simulated machines: Newton's method on many poses at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array, BoolArray
from legcal.mechanism.parameters import KinematicParameters
from legcal.simulation.leg_vectors import leg_vectors, legs_and_arms, length_jacobian
from legcal.simulation.machine import Machine

_ITERATIONS = 30
_EXACT = 1e-14  # of the lengths
_ON_THE_WAY = 1e-6
_LARGEST_TURN = 0.3  # [rad] in one iteration
_DAMPING = 1e-12  # keeps singular poses solvable, and is nothing beside others
_SINGULAR = 0.1  # smallest singular value of the scaled Jacobian that a pose may have
_STEPS = 6  # from home


class Followed(NamedTuple):
    """Where a machine came to from home.

    Attributes
    ----------
    R, t : (n, 3, 3) and (n, 3) array
        Poses of R_e in R_b [m]; where the lengths were not reached, the last one on the way.
    reached : (n,) array of bool
        Which have the lengths that were asked for.
    """

    R: Array
    t: Array
    reached: BoolArray

    @property
    def T_Rb_Re(self) -> RigidTransform:
        """The poses."""
        return RigidTransform.from_components(self.t, Rotation.from_matrix(self.R))


def solve_poses(
    parameters: KinematicParameters, lengths: Array, start: RigidTransform
) -> RigidTransform:
    """Return the platform poses with given leg lengths that Newton's method finds from a start.

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


def follow_from_home(machine: Machine, lengths: Array) -> Followed:
    """Return the poses with given leg lengths that are reached from home in small steps.

    They are in the assembly mode of home; those beyond or beside a singularity are not reached.

    Parameters
    ----------
    machine : Machine
        The machine.
    lengths : (n_poses, n_legs) array
        Leg lengths [m].

    Returns
    -------
    Followed
    """
    n = len(lengths)
    R = np.tile(machine.home.rotation.as_matrix(), (n, 1, 1))
    t = np.tile(machine.home.translation, (n, 1))
    reached = np.ones(n, dtype=np.bool_)
    first = np.linalg.norm(leg_vectors(machine.parameters, machine.home), axis=-1)
    size = float(np.mean(np.linalg.norm(machine.parameters.platform_joints, axis=-1)))
    unit = np.array([1.0, 1.0, 1.0, size, size, size])
    for part in np.linspace(0.0, 1.0, _STEPS + 1)[1:]:
        here = np.flatnonzero(reached)
        wanted = first + part * (lengths[here] - first)
        accuracy = _EXACT if part == 1.0 else _ON_THE_WAY
        R_new, t_new, error = _newton(machine.parameters, wanted, R[here], t[here], accuracy)
        J = length_jacobian(machine.parameters, R_new, t_new) / unit
        smallest = np.linalg.svd(J, compute_uv=False)[:, -1]
        well = (error == 0.0) & (smallest >= _SINGULAR)
        R[here[well]], t[here[well]] = R_new[well], t_new[well]
        reached[here] = well
    return Followed(R, t, reached)


def _newton(
    parameters: KinematicParameters, lengths: Array, R: Array, t: Array, accuracy: float = _EXACT
) -> tuple[Array, Array, Array]:
    """Return R, t and the remaining error [m] of each pose; zero where Newton's method arrived."""
    R, t = R.copy(), t.copy()
    tolerance = accuracy * lengths.max(axis=1, initial=0.0)
    best = np.full(len(R), np.inf)
    active = np.arange(len(R))
    for _ in range(_ITERATIONS):
        legs, arms = legs_and_arms(parameters, R[active], t[active])
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
