"""How noisy a picture is on both sides of an outline, and what each pixel therefore counts.

Noise grows with light, and a surface has texture: a dark background is several times quieter than a
lit leg in front of it, so that the foot of the blurred step tells more of its place than the top.
"""

from itertools import pairwise

import numpy as np
from scipy.special import ndtr

from legcal.detection.limb import Samples
from legcal.geometry.types import Array, BoolArray, IntArray

BEYOND = (1.0, 2.5)  # distance from an outline from which on the step is over: [px] and in blurs
N_SMOOTH = 3  # functions by which a side of a block is smooth: constant, linear, quadratic
ENOUGH = 8  # pixels on a side of a block
LEAST_NOISE = 0.3  # of rounded grey levels: their standard deviation
LARGEST_RATIO = 8.0  # of the noise on both sides that is believed
FEWEST = 3  # blocks of an outline that tell its noise


def evened_weights(
    d: Samples,
    light: Samples,
    weight: Samples,
    bounds: IntArray,
    kept: BoolArray,
    blur: float,
) -> Samples:
    """Return weights with which all pixels beside an outline are equally noisy.

    Parameters
    ----------
    d, light, weight : (n_blocks, m) array of float32
        Distances inside the outlines [px], light, and inverse noise in some unit so far; zero for
        pixels that are not to be used.
    bounds : (n_edges + 1,) array of int
        First block of each outline.
    kept : (n_blocks,) array of bool
        Blocks that lie on their outlines.
    blur : float
        Standard deviation of the blur [px].

    Returns
    -------
    (n_blocks, m) array of float32
        Either side of an outline keeps the noise that its median block shows there, and across the
        blurred step the variance changes as light does.
    """
    beyond = max(BEYOND[0], BEYOND[1] * blur)
    outer, inner = (
        _of_edges(_variance(side, light, weight * (side > beyond)), kept, bounds)
        for side in (-d, d)
    )
    least = LEAST_NOISE**2
    outer, inner = np.maximum(outer, least), np.maximum(inner, least)
    ratio = np.where(np.isfinite(outer) & np.isfinite(inner), inner / outer, 1.0)
    ratio = np.clip(ratio, LARGEST_RATIO**-2, LARGEST_RATIO**2)
    of_block = np.repeat(ratio, np.diff(bounds)).astype(np.float32)[:, None]
    rise = ndtr(d / np.float32(blur)).astype(np.float32)
    # In units of the noise in the middle of the step, which keeps the mean noise about the same.
    return np.asarray(weight * np.sqrt(0.5 * (1.0 + of_block) / (1.0 + (of_block - 1.0) * rise)))


def _variance(distance: Samples, light: Samples, weight: Samples) -> Array:
    """Return the variance of the pixels on one side of each block about a parabola, (n_blocks,)."""
    n = np.count_nonzero(weight, axis=1)
    x = (distance - np.float32(2.0)).astype(np.float64)
    functions = np.stack([np.ones_like(x), x, x * x], axis=1) * weight[:, None, :]
    level = np.sum(light * weight, axis=1) / np.maximum(weight.sum(axis=1), 1e-3)
    y = ((light - level[:, None]) * weight).astype(np.float64)
    normal = functions @ functions.swapaxes(1, 2) + 1e-6 * np.eye(N_SMOOTH)
    right = functions @ y[..., None]
    explained = np.sum(right * np.linalg.solve(normal, right), axis=(1, 2))
    free = np.maximum(n - N_SMOOTH, 1)
    return np.where(n >= ENOUGH, np.maximum(np.sum(y * y, axis=1) - explained, 0.0) / free, np.nan)


def _of_edges(variance: Array, kept: BoolArray, bounds: IntArray) -> Array:
    """Return the median variance of the kept blocks of each edge, NaN where too few tell it."""
    of_edge = np.full(len(bounds) - 1, np.nan)
    for i, (first, last) in enumerate(pairwise(bounds.tolist())):
        told = variance[first:last][kept[first:last] & np.isfinite(variance[first:last])]
        if len(told) >= FEWEST:
            of_edge[i] = np.median(told)
    return of_edge
