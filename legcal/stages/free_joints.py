"""Joint centres as unknowns: some of their coordinates are zero by the choice of R_b and R_e."""

from __future__ import annotations

import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.mechanism.parameters import free_coordinates
from legcal.stages.nominal import NominalMechanism
from legcal.stages.solution import Solution


def joint_positions(mechanism: NominalMechanism) -> IntArray:
    """Return where each coordinate stands among the unknowns, (n_legs, 3); -1 where it is zero.

    The free coordinates are the first unknowns of a step, leg by leg.
    """
    free = free_coordinates(mechanism.n_legs, mechanism.frame_legs)
    positions = np.full(free.shape, -1, dtype=np.intp)
    positions[free] = np.arange(free.sum())
    return positions


def n_free_coordinates(mechanism: NominalMechanism) -> int:
    """Return the number of free coordinates."""
    return int(joint_positions(mechanism).max()) + 1


def free_values(mechanism: NominalMechanism, joints: Array) -> Array:
    """Return the free coordinates of joint centres (n_legs, 3), as unknowns."""
    return joints[joint_positions(mechanism) >= 0]


def joints_from(mechanism: NominalMechanism, x: Array) -> Array:
    """Return joint centres (n_legs, 3) from their free coordinates at the head of x."""
    positions = joint_positions(mechanism)
    return np.where(positions >= 0, x[positions], 0.0)


def loose_joints(mechanism: NominalMechanism, solution: Solution) -> list[str]:
    """Return the names of the legs whose joints can move without any residual noticing."""
    positions = joint_positions(mechanism)
    unseen = np.append(solution.unseen(n_free_coordinates(mechanism)), False)
    return [mechanism.leg_names[int(j)] for j in np.flatnonzero(unseen[positions].any(axis=1))]
