"""Random platform poses of simulated machines (section 4.3)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array
from legcal.simulation.extremes import near_ends
from legcal.simulation.forward import follow_from_home
from legcal.simulation.machine import Machine

_ROUNDS = 1000


def extreme_poses(machine: Machine, n_poses: int, rng: np.random.Generator) -> RigidTransform:
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

    Returns
    -------
    RigidTransform
        T_Rb_Re, n_poses of them.

    Raises
    ------
    DidNotConverge
        If too few are reached.
    """
    n = machine.n_legs
    return _drawn(machine, n_poses, lambda: near_ends(rng.integers(0, 2, n), rng.random(n)))


def random_poses(machine: Machine, n_poses: int, rng: np.random.Generator) -> RigidTransform:
    """Return random poses with every leg length drawn uniformly from its travel.

    They are followed from home as those of :func:`extreme_poses`.
    """
    return _drawn(machine, n_poses, lambda: rng.random(machine.n_legs))


def _drawn(machine: Machine, n_poses: int, draw: Callable[[], Array]) -> RigidTransform:
    """Return poses whose leg lengths are drawn, as parts of the travel, until enough are reached.

    Each round draws as many as are missing, so that the draws are those of one pose at a time.
    """
    lowest, highest = machine.travel.T
    R, t = np.zeros((0, 3, 3)), np.zeros((0, 3))
    for _ in range(_ROUNDS):
        if len(R) == n_poses:
            break
        part = np.array([draw() for _ in range(n_poses - len(R))])
        new = follow_from_home(machine, lowest + part * (highest - lowest))
        R = np.concatenate([R, new.R[new.reached]])
        t = np.concatenate([t, new.t[new.reached]])
    if len(R) < n_poses:
        raise DidNotConverge(
            f"Only {len(R)} of {n_poses} random poses of a simulated machine were found; "
            "check its travel."
        )
    return RigidTransform.from_components(t, Rotation.from_matrix(R))
