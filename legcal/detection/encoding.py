"""How far outlines move with the gamma that is taken for the camera's.

Light that is read with a gamma g is a power of g of the grey level, so that with ln g it changes by
light times its logarithm, apart from a factor. That change is fitted like the light itself, by the
same equations: amplitudes take up most of it, the blur of the image some, and what is left looks
like a shift.
"""

import numpy as np

from legcal.detection.pool import BLUR, OPEN_BLUR, SHIFT, UNEQUAL_BLUR, Pool, Round
from legcal.geometry.types import Array


def shifts_by_gamma(pool: Pool, at: Round, even_blur: float) -> Array:
    """Return how far the outlines of an image move towards the inside with ln gamma.

    Parameters
    ----------
    pool : Pool
        The blocks of all edges.
    at : Round
        Where they were fitted.
    even_blur : float
        By how much the blur of an edge differs from that of the image, in its logarithm.

    Returns
    -------
    (n_edges,) array
        In the middle of each [px]; NaN where nothing is seen.
    """
    normal, right = pool.response_to_gamma(at)
    moved, inverse = _solved(normal, right, 0.0, OPEN_BLUR)
    counts = pool.seen / (inverse[:, BLUR, BLUR] + UNEQUAL_BLUR**2)
    widened = float(counts @ moved[:, BLUR] / counts.sum())
    moved, _ = _solved(normal, right, widened, even_blur)
    return np.where(pool.seen, moved[:, SHIFT], np.nan)


def _solved(normal: Array, right: Array, widened: float, sigma: float) -> tuple[Array, Array]:
    """Return the unknowns of edges (n, k) and their covariance, the blur known to sigma."""
    whole, target = normal.copy(), right.copy()
    whole[:, BLUR, BLUR] += sigma**-2
    target[:, BLUR] += widened * sigma**-2
    inverse = np.asarray(np.linalg.inv(whole), dtype=np.float64)
    return (inverse @ target[..., None])[..., 0], inverse
