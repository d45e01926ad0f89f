"""Grey levels as light, and weights of pixels by their noise.

Grey levels are light to the power 1 / gamma. Noise grows with light, and a surface has texture: a
dark background is several times quieter than a lit leg in front of it, so that the foot of the
blurred step determines its place better than the top.
"""

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from legcal.geometry import Array, BoolArray, IntArray
from legcal.vision import Grey

Samples = NDArray[np.float32]

DARK = 12.0  # grey level below which noise is taken to be that of this level
STEP_END = (1.0, 2.5)  # distance from an outline at which the step is over: [px] and in blurs
N_SMOOTH = 3  # of the polynomial that describes a side of a block: constant to quadratic
MIN_PIXELS = 8  # pixels on a side of a block
MIN_NOISE = 0.3  # of rounded grey levels: their standard deviation
MAX_NOISE_RATIO = 8.0  # of the noise on both sides
MIN_BLOCKS = 3  # blocks of an outline that give its noise


def reduce(grey: Grey, factor: int) -> Grey:
    """Return an image made smaller by a whole factor, each pixel the mean of a square."""
    if factor == 1:
        return grey
    height, width = (factor * (size // factor) for size in grey.shape)
    size = (width // factor, height // factor)
    small = cv2.resize(grey[:height, :width], size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.float32)


def to_light(grey: Samples, inside: BoolArray, gamma: float) -> tuple[Samples, Samples]:
    """Return light (n, m) in blocks of pixels, and the weights by noise of grey levels.

    Light changes as grey levels do at the mean of the block; weights are zero outside. Noise of
    grey levels is taken to be even in a block: shot noise grows like the root of light, so that it
    is even all over a picture where gamma is 2.
    """
    use = inside.astype(np.float32)
    if gamma == 1.0:
        return grey, use
    level = np.sum(grey * use, axis=1) / np.maximum(use.sum(axis=1), 1.0)
    level = np.maximum(level, DARK).astype(np.float32)[:, None]
    light = (level / np.float32(gamma)) * (np.maximum(grey, 0.0) / level) ** np.float32(gamma)
    weight = use * (np.maximum(grey, DARK) / level) ** np.float32(1.0 - gamma)
    return light.astype(np.float32), weight.astype(np.float32)


def evened_weights(
    d: Samples, light: Samples, weight: Samples, bounds: IntArray, kept: BoolArray, blur: float
) -> Samples:
    """Return weights (n_blocks, m) with which all pixels beside an outline are equally noisy.

    Distances d inside the outlines and the blur are in px, ``bounds`` are the first blocks of
    outlines, ``kept`` the blocks that lie on them. Either side of an outline keeps the noise that
    its median block shows there; across the blurred step the variance changes as light does.
    """
    beyond = max(STEP_END[0], STEP_END[1] * blur)
    outer, inner = (
        _of_edges(_variance(side, light, weight * (side > beyond)), kept, bounds)
        for side in (-d, d)
    )
    least = MIN_NOISE**2
    outer, inner = np.maximum(outer, least), np.maximum(inner, least)
    ratio = np.where(np.isfinite(outer) & np.isfinite(inner), inner / outer, 1.0)
    ratio = np.clip(ratio, MAX_NOISE_RATIO**-2, MAX_NOISE_RATIO**2)
    of_block = np.repeat(ratio, np.diff(bounds)).astype(np.float32)[:, None]
    rise = ndtr(d / np.float32(blur)).astype(np.float32)
    # In units of the noise in the middle of the step, which keeps the mean noise about the same.
    return np.asarray(weight * np.sqrt(0.5 * (1.0 + of_block) / (1.0 + (of_block - 1.0) * rise)))


def _variance(distance: Samples, light: Samples, weight: Samples) -> Array:
    """Return the variance (n,) of pixels on one side of each block about a parabola, or NaN."""
    n = np.count_nonzero(weight, axis=1)
    x = (distance - np.float32(2.0)).astype(np.float64)
    functions = np.stack([np.ones_like(x), x, x * x], axis=1) * weight[:, None, :]
    level = np.sum(light * weight, axis=1) / np.maximum(weight.sum(axis=1), 1e-3)
    y = ((light - level[:, None]) * weight).astype(np.float64)
    normal = functions @ functions.swapaxes(1, 2) + 1e-6 * np.eye(N_SMOOTH)
    right = functions @ y[..., None]
    explained = np.sum(right * np.linalg.solve(normal, right), axis=(1, 2))
    free = np.maximum(n - N_SMOOTH, 1)
    return np.where(
        n >= MIN_PIXELS, np.maximum(np.sum(y * y, axis=1) - explained, 0.0) / free, np.nan
    )


def _of_edges(variance: Array, kept: BoolArray, bounds: IntArray) -> Array:
    """Return the median variance of the kept blocks of each edge, NaN where too few have it."""
    of_edge = np.full(len(bounds) - 1, np.nan)
    for i, (first, last) in enumerate(pairwise(bounds.tolist())):
        known = variance[first:last][kept[first:last] & np.isfinite(variance[first:last])]
        if len(known) >= MIN_BLOCKS:
            of_edge[i] = np.median(known)
    return of_edge
