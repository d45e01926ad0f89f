"""The dictionaries of markers and tags that boards are printed with, by OpenCV's names."""

from functools import lru_cache

import cv2

DICTIONARIES = tuple(
    [f"DICT_{bits}X{bits}_{size}" for bits in (4, 5, 6, 7) for size in (50, 100, 250, 1000)]
    + ["DICT_ARUCO_ORIGINAL", "DICT_ARUCO_MIP_36h12"]
    + [f"DICT_APRILTAG_{name}" for name in ("16h5", "25h9", "36h10", "36h11")]
)
APRIL_TAGS = "DICT_APRILTAG_36h11"


@lru_cache(maxsize=8)
def dictionary(name: str) -> cv2.aruco.Dictionary:
    """Return a dictionary of OpenCV by its name."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def dictionary_size(name: str) -> int:
    """Return how many markers a dictionary has."""
    return len(dictionary(name).bytesList)
