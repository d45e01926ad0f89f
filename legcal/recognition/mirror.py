"""Bars of mirrored images."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from legcal.geometry.types import Array
from legcal.recognition.agreement import Picture
from legcal.recognition.bars import Bars

LEFT_RIGHT = np.array([-1.0, 1.0])
UP_DOWN = np.array([1.0, -1.0])
UPSIDE_DOWN = np.array([-1.0, -1.0])


def flipped(bars: Bars, corners: Array, flip: Array) -> Bars:
    """Return the bars of the image with its pixels in the opposite order along some axes.

    Parameters
    ----------
    bars : Bars
        Of the image as it is.
    corners : (2, 2) array
        Least and greatest x and y of the sensor plane that it shows.
    flip : (2,) array
        -1 along the axes that are turned around.
    """
    middle = corners.mean(axis=0)
    return replace(bars, middle=middle + flip * (bars.middle - middle), along=flip * bars.along)


def mirrored(pictures: Sequence[Picture]) -> list[Picture]:
    """Return the pictures with left and right exchanged."""
    return [replace(p, bars=flipped(p.bars, p.corners, LEFT_RIGHT)) for p in pictures]
