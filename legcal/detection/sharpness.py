"""How much a place across a profile of the picture looks like an edge."""

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from legcal.geometry.types import IntArray

NOISE_LEVELS = 4.0  # an edge this many times as steep as the median counts half
BESIDE = 0.8  # what an edge counts in the columns beside it


def edge_sharpness(
    profiles: NDArray[np.float32], seen: NDArray[np.bool_], bounds: IntArray
) -> NDArray[np.float32]:
    """Return how much each column of profiles (n_blocks, n) looks like an edge, 0 to 1.

    The maxima of the smoothed gradient along each profile against the median of its patch, widened
    by one column to each side, where they count less. ``bounds`` are the first blocks of patches.
    """
    smooth = cv2.GaussianBlur(profiles, (5, 1), 0.8)
    gradient = np.zeros_like(profiles)
    gradient[:, 1:-1] = np.abs(smooth[:, 2:] - smooth[:, :-2]) * (seen[:, 2:] & seen[:, :-2])
    beside = np.ones((1, 3), dtype=np.uint8)
    wide = np.asarray(cv2.dilate(gradient, beside), dtype=np.float32)
    peak = np.where(gradient >= wide, gradient, np.float32(0.0))
    typical = [
        _median(gradient[first:last][seen[first:last]]) for first, last in pairwise(bounds.tolist())
    ]
    level = np.repeat((NOISE_LEVELS * np.array(typical)) ** 2 + 1e-3, np.diff(bounds))
    sharpness = np.asarray(peak**2 / (peak**2 + level[:, None]), dtype=np.float32)
    widened = np.asarray(cv2.dilate(sharpness, beside), dtype=np.float32)
    return np.asarray(np.maximum(sharpness, np.float32(BESIDE) * widened), dtype=np.float32)


def _median(values: NDArray[np.float32]) -> float:
    """Return the middle value, the upper one of two; 0 of none."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle]) if len(values) else 0.0
