"""With which gamma to read the photographs of a camera that nobody told: the next one to try.

Outlines that were measured with a wrong gamma lie off, and a fit sees by how much, but less than
all of it: how far each of them moves is known roughly, and shifts that they share take some. It
sees nothing where the gamma is right all the same, and that is found by secants. Where outlines
tell little, it may see nothing where the gamma is wrong as well: what is found is stated so.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from legcal.geometry.types import Array
from legcal.refinement.gammas import SEEN_SHARE, EstimatedGamma

ROUNDS = 2  # of measuring outlines with another gamma, at most
SETTLED = 0.12  # what a fit sees, in the logarithm: no more than limbs feign
SIGNIFICANT = 2.0  # standard deviations of the fit: less may be chance
SEEN_SHARES = (0.25, 1.2)  # what is believed when they have
LARGEST_STEP = 0.7  # of the logarithm
RANGE = (1.0, 3.0)  # of gammas that are tried: photographs are linear, or encoded for screens


def next_gammas(found: Sequence[Sequence[EstimatedGamma]]) -> dict[str, float]:
    """Return the gammas to read photographs with, by view; nothing where fits see none but theirs.

    Parameters
    ----------
    found : sequence of sequence of EstimatedGamma
        What successive fits have found, to outlines that were measured anew for each.
    """
    gammas: dict[str, float] = {}
    for one in found[-1]:
        of_camera = [other for fit in found for other in fit if other.views == one.views]
        read = np.log([other.measured_with for other in of_camera])
        seen = np.log([other.gamma for other in of_camera]) - read
        if abs(seen[-1]) > max(SETTLED, SIGNIFICANT * one.fitted_sigma):
            step = np.clip(seen[-1] / _share(read, seen), -LARGEST_STEP, LARGEST_STEP)
            other = float(np.clip(np.exp(read[-1] + step), *RANGE))
            if abs(np.log(other) - read[-1]) > SETTLED:
                gammas |= dict.fromkeys(one.views, other)
    return gammas


def _share(read: Array, seen: Array) -> float:
    """Return which share of a wrong gamma fits see, by the last two of them."""
    if len(read) < 2 or abs(read[-1] - read[-2]) < SETTLED:
        return SEEN_SHARE
    share = -(seen[-1] - seen[-2]) / (read[-1] - read[-2])
    return float(np.clip(share, *SEEN_SHARES))
