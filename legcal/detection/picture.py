"""Photographs as arrays: to grey, reduced, and sampled along bands."""

import cv2
import numpy as np
from numpy.typing import NDArray

from legcal.geometry.types import Image
from legcal.vision.camera import Camera

Grey = NDArray[np.float32]


def to_grey(image: Image) -> Grey:
    """Return an image as float32 grey levels, 0 to 255 whatever the depth of the file.

    Parameters
    ----------
    image : (height, width) or (height, width, 1, 3 or 4) array
        8 or 16 bit integers, or floats that already have that scale; colour in OpenCV's
        order blue, green, red.
    """
    values = image.astype(np.float32, copy=False)
    if image.dtype == np.uint16:
        values = values / np.float32(257.0)
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    elif values.ndim == 3:
        values = np.asarray(cv2.cvtColor(values[..., :3], cv2.COLOR_BGR2GRAY), dtype=np.float32)
    return np.ascontiguousarray(values)


def reduce(grey: Grey, factor: int) -> Grey:
    """Return an image made smaller by a whole factor, each pixel the mean of a square."""
    if factor == 1:
        return grey
    height, width = (factor * (size // factor) for size in grey.shape)
    size = (width // factor, height // factor)
    small = cv2.resize(grey[:height, :width], size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.float32)


def sample(grey: Grey, camera: Camera, x: Grey, y: Grey) -> tuple[Grey, NDArray[np.bool_]]:
    """Sample an image bilinearly.

    Parameters
    ----------
    grey : Grey
        The image.
    camera : Camera
        Its camera.
    x, y : (n, m) array
        Where it is sampled [px].

    Returns
    -------
    values : (n, m) array
        Grey levels.
    inside : (n, m) array of bool
        False for points outside the image, whose values repeat the border.
    """
    inside = (x >= 0.5) & (x <= camera.width - 1.5) & (y >= 0.5) & (y <= camera.height - 1.5)
    values = cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, dtype=np.float32), inside
