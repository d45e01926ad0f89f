"""What extreme leg lengths are (section 4.3): near the shortest or near the longest."""

from __future__ import annotations

import numpy as np

from legcal.geometry.types import Array, IntArray

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
