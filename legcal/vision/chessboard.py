"""Chessboards in images: found as a whole, or not at all."""

import cv2
import numpy as np
from numpy.typing import NDArray

from legcal.geometry.types import Array, IntArray
from legcal.vision.board import Board
from legcal.vision.enlarged import enlarged, reduced

_PLAIN = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
# Slow searches where quick ones fail; corners near each other are told apart in a larger image.
_TRIED = ((1, _PLAIN), (2, _PLAIN), (1, _PLAIN | cv2.CALIB_CB_EXHAUSTIVE))


def search_chessboard(board: Board, grey: NDArray[np.uint8]) -> tuple[IntArray, Array]:
    """Return numbers (k,) and rough places (k, 2) [px] of the corners: all of them, or none.

    Parameters
    ----------
    board : Board
        The chessboard.
    grey : (height, width) array of uint8
        The image.
    """
    grid = inner_corners(grey, board.grid)
    if grid is None:
        return np.zeros(0, dtype=np.intp), np.zeros((0, 2))
    return np.arange(board.n_corners), _oriented(grid, grey).reshape(-1, 2)


def inner_corners(
    grey: NDArray[np.uint8], grid: tuple[int, int], *, quick: bool = False
) -> Array | None:
    """Return a grid of so many corners along x and y, (ny, nx, 2) [px]; None if there is none."""
    for scale, flags in _TRIED[:1] if quick else _TRIED:
        found, corners = cv2.findChessboardCornersSB(enlarged(grey, scale), grid, flags=flags)
        if found and corners is not None:
            px = reduced(np.asarray(corners, dtype=np.float64), scale)
            return px.reshape(grid[1], grid[0], 2)
    return None


def _oriented(grid: Array, grey: NDArray[np.uint8]) -> Array:
    """Return the grid with x, y, and the line of sight right-handed, and its first square black."""
    x = grid[:, -1].mean(axis=0) - grid[:, 0].mean(axis=0)
    y = grid[-1].mean(axis=0) - grid[0].mean(axis=0)
    if x[0] * y[1] - x[1] * y[0] < 0.0:
        grid = grid[:, ::-1]
    return grid if _blackness(grid, grey) > 0.0 else grid[::-1, ::-1]


def _blackness(grid: Array, grey: NDArray[np.uint8]) -> float:
    """Return how much darker the squares are that should be black than those beside them."""
    middles = 0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])
    column, row = np.rint(np.moveaxis(middles, -1, 0)).astype(np.intp)
    row = np.clip(row, 0, grey.shape[0] - 1)
    column = np.clip(column, 0, grey.shape[1] - 1)
    i, j = np.indices(row.shape)
    black = (i + j) % 2 == 0  # the square after the first one along both axes is black as well
    levels = grey[row, column].astype(np.float64)
    return float(levels[~black].mean() - levels[black].mean())
