"""What extreme leg lengths are (section 4.3): near the shortest or near the longest."""

from __future__ import annotations

import numpy as np

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.mechanism.model import Mechanism

JITTER = 0.12  # of the travel, by which extreme lengths stay away from its ends at most


def near_ends(end: IntArray, chance: Array) -> Array:
    """Return places in the travel, 0 the shortest and 1 the longest, near given ends of it.

    Parameters
    ----------
    end : (n_legs,) array of int
        0 or 1, the end.
    chance : (n_legs,) array
        How far away from it, in parts of the most that there is.

    Returns
    -------
    (n_legs,) array
    """
    return np.asarray(np.abs(end - JITTER * chance))


def are_extreme(mechanism: Mechanism, readings: Array) -> BoolArray:
    """Say in which poses every motor is near an end of its travel, (n_poses,).

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    readings : (n_poses, n_legs) array
        Joint value of every leg [m].
    """
    motors = list(mechanism.motors)
    lower, upper = np.array([mechanism.legs[j].travel for j in motors]).reshape(-1, 2).T
    part = (readings[:, motors] - lower) / (upper - lower)
    return np.asarray(np.all(np.minimum(part, 1.0 - part) <= JITTER, axis=1))
