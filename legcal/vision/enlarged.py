"""Images made larger, for searches that do not see what is only a few pixels wide."""

import cv2
import numpy as np
from numpy.typing import NDArray

from legcal.geometry.types import Array

MOST_PIXELS = 6_000_000  # of an image that is made larger


def enlarged(grey: NDArray[np.uint8], scale: int) -> NDArray[np.uint8]:
    """Return an image made larger by a whole factor; a large one as it is."""
    if scale == 1 or grey.size > MOST_PIXELS:
        return grey
    size = (scale * grey.shape[1], scale * grey.shape[0])
    larger = cv2.resize(grey, size, interpolation=cv2.INTER_CUBIC)
    return np.asarray(larger, dtype=np.uint8)


def reduced(px: Array, scale: int) -> Array:
    """Return pixels of an enlarged image as those of the image; middles of pixels are whole."""
    return np.asarray((px + 0.5) / scale - 0.5)
