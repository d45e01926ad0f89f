"""Bars of mirrored images, and whether they explain a view better than its images as they are.

A camera pose is found for mirrored images of many machines as well, with fewer legs on their bars:
a leg or two on the wrong ones. So a pose at which many legs are missing is held against the best
one of the images with left and right exchanged.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from legcal.geometry.types import Array
from legcal.recognition.agreement import Picture
from legcal.recognition.bars import Bars
from legcal.recognition.placed import Placed

LEFT_RIGHT = np.array([-1.0, 1.0])
UP_DOWN = np.array([1.0, -1.0])
UPSIDE_DOWN = np.array([-1.0, -1.0])
PLAIN = 0.45  # share of the expected legs that mirrored images do not reach
LEAD, LEAD_PART = 0.3, 0.06  # of the mirrored pictures over the own ones: legs of all images, part


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


def may_be_mirrored(own: Placed) -> bool:
    """Say whether a placed view needs to be held against its mirror image."""
    return not own.is_convincing or own.share < PLAIN


def is_mirrored(own: Placed, other: Placed) -> bool:
    """Say whether mirrored pictures explain a view better than its own ones do.

    Those of a machine with a plane of symmetry, as all planar ones, explain it about as well.

    Parameters
    ----------
    own : Placed
        By the pictures as they are.
    other : Placed
        By :func:`mirrored` ones.
    """
    if not own.is_convincing:
        return other.is_clear
    lead = float(other.score[0] - own.score[0])
    return other.is_convincing and lead >= max(LEAD, LEAD_PART * float(other.score[0]))
