"""Grey levels as light: they are light to the power 1 / gamma."""

import cv2
import numpy as np
from numpy.typing import NDArray

from legcal.vision.image_file import Grey

Samples = NDArray[np.float32]

DARK = 12.0  # grey level below which the noise is constant


def reduce(grey: Grey, factor: int) -> Grey:
    """Return an image made smaller by a whole factor, each pixel the mean of a square."""
    if factor == 1:
        return grey
    height, width = (factor * (size // factor) for size in grey.shape)
    size = (width // factor, height // factor)
    small = cv2.resize(grey[:height, :width], size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.float32)


def to_light(grey: Samples, window: Samples, gamma: float) -> tuple[Samples, Samples]:
    """Return light (n, m) in blocks of pixels, and the weights by noise of grey levels.

    Light changes as grey levels do at the mean of the block; pixels count by their window. Noise of
    grey levels is taken to be even in a block: shot noise grows like the root of light, so that it
    is even all over a picture where gamma is 2.
    """
    if gamma == 1.0:
        return grey, window
    level = np.sum(grey * window, axis=1) / np.maximum(window.sum(axis=1), 1.0)
    level = np.maximum(level, DARK).astype(np.float32)[:, None]
    light = (level / np.float32(gamma)) * (np.maximum(grey, 0.0) / level) ** np.float32(gamma)
    weight = window * (np.maximum(grey, DARK) / level) ** np.float32(1.0 - gamma)
    return light.astype(np.float32), weight.astype(np.float32)
