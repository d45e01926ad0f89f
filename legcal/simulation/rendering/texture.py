"""Smooth random patterns: mottled surfaces and backgrounds out of focus."""

from functools import lru_cache

import cv2
import numpy as np

from legcal.simulation.rendering.rays import Single

_SIZE = 512  # points of the tile along a side
_PERIOD = 0.25  # [m] after which a surface's pattern repeats


@lru_cache(maxsize=1)
def tile() -> Single:
    """Return a pattern that repeats, mean 0 and standard deviation 1."""
    rng = np.random.default_rng(7)
    pattern = np.zeros((_SIZE, _SIZE), dtype=np.float32)
    for octave in range(3, 8):
        coarse = rng.standard_normal((2**octave, 2**octave)).astype(np.float32)
        wrapped = np.pad(coarse, 4, mode="wrap")
        k = _SIZE // 2**octave
        fine = cv2.resize(wrapped, None, fx=k, fy=k, interpolation=cv2.INTER_CUBIC)
        pattern += fine[4 * k : -4 * k, 4 * k : -4 * k] * np.float32(0.9**octave)
    return np.asarray((pattern - pattern.mean()) / pattern.std(), dtype=np.float32)


def mottled(local: Single) -> Single:
    """Return the pattern at points (3, n) of a solid's own frame [m], (n,)."""
    k = np.float32(_SIZE / _PERIOD)
    a, b, c = local * k
    i = (a + np.float32(0.31) * c).astype(np.int32) & (_SIZE - 1)
    j = (b + np.float32(0.73) * c).astype(np.int32) & (_SIZE - 1)
    return np.asarray(tile()[i, j])


def background(width: int, height: int, contrast: float, rng: np.random.Generator) -> Single:
    """Return a smooth picture (height, width) of mean 1 that varies by the contrast, never dark."""
    picture = np.zeros((height, width), dtype=np.float32)
    for octave in range(2, 7):
        cells = 2**octave
        shape = max(3 * cells // 4, 2), cells
        coarse = rng.standard_normal(shape).astype(np.float32)
        fine = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
        picture += fine * np.float32(0.6**octave)
    picture /= max(float(picture.std()), 1e-6)
    picture = np.exp(np.float32(contrast) * np.clip(picture, -2.5, 2.5))
    return np.asarray(picture / picture.mean(), dtype=np.float32)
