"""Corners of a calibration board in an image: searched by OpenCV, measured by a local model."""

import numpy as np
from numpy.typing import NDArray

from legcal.geometry.types import Array, IntArray
from legcal.vision.board import Board
from legcal.vision.chessboard import search_chessboard
from legcal.vision.saddle import Saddle, fit_saddle
from legcal.vision.tag_search import search_aprilgrid, search_charuco

FEWEST = 4  # corners that place a camera
_NEAR = 1.5  # squares within which corners tell how the board lies in the image around one
_STRAIGHT = 0.9  # of what is straight around a corner that is used
_FRAME = 0.2  # of the side of a tag that its black frame is wide, as Kalibr prints it
_MOST_BLURRED, _MOST_MISFIT = 1.5, 2.5  # times what is usual in the image
_GOOD_FIT = 0.03  # of the contrast left over: never a reason for doubt
_SEARCH = {
    "chessboard": search_chessboard,
    "charuco": search_charuco,
    "aprilgrid": search_aprilgrid,
}


def find_corners(board: Board, image: NDArray[np.generic]) -> tuple[IntArray, Array, Array]:
    """Return the corners of a board that an image shows.

    Corners whose surroundings are not those of a board, or partly hidden, are left out. A
    chessboard is found as a whole, or not at all.

    Parameters
    ----------
    board : Board
        The board.
    image : (height, width) array
        Grey levels, 0 to 255.

    Returns
    -------
    numbers : (k,) array of int
        The corners, rising.
    px : (k, 2) array
        Where they are; (0, 0) is the centre of the top-left pixel.
    sigma_px : (k,) array
        Standard deviation of either coordinate [px].
    """
    grey = np.ascontiguousarray(image, dtype=np.float32)
    eight_bits = np.clip(np.rint(grey), 0.0, 255.0).astype(np.uint8)
    numbers, rough = _SEARCH[board.kind](board, eight_bits)
    numbers, first = np.unique(numbers, return_index=True)
    rough = rough[first]
    axes = _axes(board, numbers, rough) if len(numbers) >= FEWEST else np.zeros((0, 2, 2))
    clearance = _clearance(board)
    fitted = [fit_saddle(grey, *at, *clearance) for at in zip(rough, axes, strict=False)]
    found = _alike([(n, s) for n, s in zip(numbers.tolist(), fitted, strict=False) if s])
    return (
        np.array([number for number, _ in found], dtype=np.intp),
        np.array([saddle.px for _, saddle in found]).reshape(-1, 2),
        np.array([saddle.sigma_px for _, saddle in found], dtype=np.float64),
    )


def _alike(found: list[tuple[int, Saddle]]) -> list[tuple[int, Saddle]]:
    """Return the corners that look like most of them; none if these are too few.

    What stands before a corner, or a shadow through it, makes its edges look wider or other.
    """
    if not found:
        return []
    blur = np.array([saddle.blur_px for _, saddle in found])
    misfit = np.array([saddle.misfit for _, saddle in found])
    usual = np.median(blur), np.median(misfit)
    kept = np.abs(np.log(blur / usual[0])) < np.log(_MOST_BLURRED)
    kept &= misfit < max(_MOST_MISFIT * usual[1], _GOOD_FIT)
    left = [both for both, is_kept in zip(found, kept, strict=True) if is_kept]
    return left if len(left) >= FEWEST else []


def _clearance(board: Board) -> tuple[float, float]:
    """Return how far edges through a corner are straight, and free of other print beside [m]."""
    if board.kind == "aprilgrid":
        gap = board.spacing * board.side
        return _STRAIGHT * gap, min(_FRAME * board.side, gap)
    gap = 0.5 * (board.side - board.marker)
    band = gap if board.kind == "charuco" else board.side
    return 0.5 * _STRAIGHT * board.side, band


def _axes(board: Board, numbers: IntArray, px: Array) -> Array:
    """Return the steps in the image for a metre along x and y of the board, (k, 2, 2) [px / m]."""
    xy = board.points[numbers, :2]
    pitch = board.side * (1.0 + board.spacing)
    found = []
    for here in xy:
        away = (xy - here) / pitch
        weight = np.exp(-0.5 * np.sum(away**2, axis=1) / _NEAR**2) + 1e-3
        A = weight[:, None] * np.column_stack([away, np.ones(len(away))])
        found.append(np.linalg.lstsq(A, weight[:, None] * px, rcond=None)[0][:2].T / pitch)
    return np.array(found)
