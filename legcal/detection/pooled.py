"""All blocks of an outline fitted together, and the blur of all outlines of an image.

A block alone cannot tell shading from displacement: both brighten the picture inside the outline.
Together they can, since the shading of a leg varies slowly along it. So every block has
its own amplitudes (see :mod:`legcal.detection.shading`), but they scatter about amplitudes that the
outline has in common, which change along it like polynomials; these are known beforehand no better
than by the contrast of the outline. Background and brightness of the leg may change freely from
block to block. Everything is linear but the place of the line and the blur, which are found
by Gauss-Newton steps; the covariance of the line then holds what shading may do to it.
"""

from dataclasses import dataclass, replace

import numpy as np

from legcal.detection.blocks import Blocks
from legcal.detection.encoding import shifts_by_gamma
from legcal.detection.pool import (
    BLUR,
    N_ALONG,
    N_UNKNOWNS,
    OPEN_BLUR,
    SHIFT,
    UNEQUAL_BLUR,
    Pool,
    Round,
)
from legcal.detection.shading import N_AMPLITUDES
from legcal.geometry.types import Array, BoolArray

EVEN_BLUR = 0.03  # of the logarithm of the blur, from edge to edge
FIRST_ROUNDS, LAST_ROUNDS = 2, 8  # at most


@dataclass(frozen=True, eq=False)
class Together:
    """Lines of outlines.

    Attributes
    ----------
    ends : (n_edges, 2) array
        How far each line lies inside the one on which the blocks had settled, where the band
        begins and where it ends [px of the band].
    covariance : (n_edges, 2, 2) array
        Of these [px^2], by noise and by what shading may be.
    blur : float
        Standard deviation of the blur of the image [px].
    by_gamma : (n_edges,) array
        How far each line moves towards the inside with ln gamma [px]; NaN where nothing is seen.
    """

    ends: Array
    covariance: Array
    blur: float
    by_gamma: Array


def fit_together(blocks: Blocks, kept: BoolArray, blur: float, depth: float) -> Together:
    """Fit the blocks of each outline together.

    Parameters
    ----------
    blocks : Blocks
        Settled blocks.
    kept : (n_blocks,) array of bool
        Those that lie on the lines of their edges.
    blur : float
        Rough standard deviation of the blur [px].
    depth : float
        Distance from the outlines at which the blocks end [px].
    """
    pool = Pool.of(blocks, kept, depth)
    n = len(pool.half_width)
    if n == 0 or not np.any(pool.seen):
        nothing = np.full(n, np.nan)
        return Together(np.zeros((n, 2)), np.tile(np.eye(2), (n, 1, 1)), blur, nothing)
    start = Round(
        np.zeros((n, N_ALONG, N_AMPLITUDES)),
        np.zeros((n, 2)),
        np.full(n, np.log(blur)),
        np.full(n, 4.0),
        np.zeros((n, N_ALONG * N_UNKNOWNS, N_ALONG * N_UNKNOWNS)),
    )
    found = pool.rounds(pool.first_amplitudes(start), np.log(blur), OPEN_BLUR, FIRST_ROUNDS)
    even, sigma = _even_blur(found, pool.seen)
    found = replace(found, log_blur=np.full(n, even))
    sigma = float(np.hypot(sigma, EVEN_BLUR))
    found = pool.rounds(found, even, sigma, LAST_ROUNDS)
    at_ends = np.array([[1.0, -1.0], [1.0, 1.0]])
    line = [SHIFT, N_UNKNOWNS + SHIFT]
    covariance = at_ends @ found.inverse[:, line][:, :, line] @ at_ends.T
    by_gamma = shifts_by_gamma(pool, found, sigma)
    return Together(found.line @ at_ends.T, covariance, float(np.exp(even)), by_gamma)


def _even_blur(found: Round, seen: BoolArray) -> tuple[float, float]:
    """Return the logarithm of the blur that most outlines of an image agree on, and its sigma."""
    log_blur = found.log_blur[seen]
    weight = 1.0 / (found.inverse[seen, BLUR, BLUR] + UNEQUAL_BLUR**2)
    even, robust = 0.0, weight
    for _ in range(6):
        even = float(robust @ log_blur / robust.sum())
        robust = weight / (1.0 + 0.25 * weight * (log_blur - even) ** 2)
    return even, float(robust.sum() ** -0.5)
