"""Markers and tags in images: what they say of the corners of a ChArUco board or an AprilGrid."""

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from legcal.geometry.types import Array, IntArray
from legcal.vision.board import Board
from legcal.vision.board_dictionaries import APRIL_TAGS, dictionary
from legcal.vision.board_objects import charuco_board
from legcal.vision.enlarged import enlarged, reduced

_SMALLEST = 0.01  # perimeter of a marker, as a part of the longer side of the image
_BORDERS = (2, 1)  # modules of the black frame of a tag: Kalibr's, and the usual one
_SCALES = (1, 2)  # by which images are enlarged: modules may be only a few pixels wide
_FIRST_TAG = 0xD5D628584  # of the family 36h11, its modules row by row from the top left


def search_charuco(board: Board, grey: NDArray[np.uint8]) -> tuple[IntArray, Array]:
    """Return numbers (k,) and rough places (k, 2) [px] of the corners that are seen.

    Parameters
    ----------
    board : Board
        A ChArUco board.
    grey : (height, width) array of uint8
        The image.
    """
    charuco = cv2.aruco.CharucoParameters()
    charuco.minMarkers = 1  # places are refined later
    detector = cv2.aruco.CharucoDetector(charuco_board(board), charuco, _parameters(1))
    best = _flat(None, None)
    for scale in _SCALES:
        corners, numbers, _, _ = detector.detectBoard(enlarged(grey, scale))
        found = _flat(numbers, corners)
        if len(found[0]) > len(best[0]):
            best = found[0], reduced(found[1], scale)
        if len(best[0]) == board.n_corners:
            break
    return best


def search_aprilgrid(board: Board, grey: NDArray[np.uint8]) -> tuple[IntArray, Array]:
    """Return numbers (k,) and rough places (k, 2) [px] of the corners of the tags that are seen.

    Parameters
    ----------
    board : Board
        An AprilGrid.
    grey : (height, width) array of uint8
        The image.
    """
    tags, places = search_tags(board, grey)
    own = tags < board.columns * board.rows
    tags, places = tags[own], places[own]
    column, row = tags % board.columns, tags // board.columns
    numbers = np.stack(
        [
            (2 * row + up) * (2 * board.columns) + 2 * column + right
            for right, up in ((0, 0), (1, 0), (1, 1), (0, 1))
        ],
        axis=-1,
    )
    return numbers.ravel().astype(np.intp), places.reshape(-1, 2)


def search_tags(board: Board, grey: NDArray[np.uint8]) -> tuple[IntArray, Array]:
    """Return the tags or markers in an image, of whatever board of the same dictionary.

    Parameters
    ----------
    board : Board
        A ChArUco board or an AprilGrid.
    grey : (height, width) array of uint8
        The image.

    Returns
    -------
    numbers : (n,) array of int
        Their numbers.
    places : (n, 4, 2) array
        Their corners [px]: bottom left, bottom right, top right, top left.
    """
    borders = _BORDERS if board.kind == "aprilgrid" else (1,)
    ids, found = np.zeros(0, dtype=np.intp), np.zeros((0, 4, 2))
    for border, scale in ((border, scale) for border in borders for scale in _SCALES):
        detector = cv2.aruco.ArucoDetector(dictionary(board.dictionary), _parameters(border))
        corners, numbers, _ = detector.detectMarkers(enlarged(grey, scale))
        if numbers is not None and len(numbers) > len(ids):
            ids = np.asarray(numbers).ravel().astype(np.intp)
            found = reduced(np.asarray(corners, dtype=np.float64).reshape(-1, 4, 2), scale)
        if len(ids) and scale == _SCALES[-1]:
            break
    turn = quarter_turns() if board.dictionary == APRIL_TAGS else 0
    order = [(k + turn) % 4 for k in (3, 2, 1, 0)]
    return ids, found[:, order]


@lru_cache(maxsize=1)
def quarter_turns() -> int:
    """Return how far OpenCV's tags are turned against Kalibr's, in quarter turns clockwise.

    OpenCV lists the corners of a tag clockwise from the top left of its own picture of it.
    """
    picture = np.asarray(cv2.aruco.generateImageMarker(dictionary(APRIL_TAGS), 0, 8))[1:-1, 1:-1]
    bits = [(_FIRST_TAG >> (35 - k)) & 1 for k in range(36)]
    upright = np.array(bits).reshape(6, 6) == 1
    return next(k for k in range(4) if np.array_equal(np.rot90(picture > 0, k), upright))


def _parameters(border: int) -> cv2.aruco.DetectorParameters:
    """Return the settings of the detector."""
    found = cv2.aruco.DetectorParameters()
    found.markerBorderBits = border
    found.minMarkerPerimeterRate = _SMALLEST
    found.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    return found


def _flat(numbers: object, corners: object) -> tuple[IntArray, Array]:
    """Return what OpenCV found as arrays; nothing where it says None."""
    if numbers is None or corners is None:
        return np.zeros(0, dtype=np.intp), np.zeros((0, 2))
    places = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    return np.asarray(numbers).ravel().astype(np.intp), places
