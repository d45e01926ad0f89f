"""Chessboards in images: found as a whole, or not at all."""

import cv2
import numpy as np
from numpy.typing import NDArray

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.vision.board import Board
from legcal.vision.enlarged import enlarged, reduced
from legcal.vision.saddle import fit_saddle

_PLAIN = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
# Slow searches where quick ones fail; corners near each other are told apart in a larger image.
_TRIED = ((1, _PLAIN), (2, _PLAIN), (1, _PLAIN | cv2.CALIB_CB_EXHAUSTIVE))
_STRAIGHT = 0.45  # of a square from a corner
_UNEVEN = 1.6  # times as long as the one before it is no step to the next line
_MOSTLY = 0.9  # of the neighbours that must be black and white
_CROSSING = 0.08  # misfit of a corner; where squares meet a rim it is twice as large


def search_chessboard(board: Board, grey: NDArray[np.uint8]) -> tuple[IntArray, Array]:
    """Return numbers (k,) and rough places (k, 2) [px] of the corners: all of them, or none.

    A part of a larger chessboard is none: nobody can tell which part.

    Parameters
    ----------
    board : Board
        The chessboard.
    grey : (height, width) array of uint8
        The image.
    """
    grid = inner_corners(grey, board.grid)
    if grid is None or goes_on(grid, grey):
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
            lines = px.reshape(grid[1], grid[0], 2)
            if _is_regular(lines, grey):
                return lines
    return None


def _is_regular(grid: Array, grey: NDArray[np.uint8]) -> bool:
    """Say whether no line of a grid is left out and its squares are black and white in turn."""
    for lines in (grid, np.swapaxes(grid, 0, 1)):
        steps = np.linalg.norm(np.diff(lines, axis=0), axis=-1)
        if np.any(np.abs(np.log(steps[1:] / steps[:-1])) > np.log(_UNEVEN)):
            return False
    black, levels = _squares(grid, grey)
    signed = np.where(black, -1.0, 1.0) * levels
    beside = np.concatenate(
        [(signed[:, 1:] + signed[:, :-1]).ravel(), (signed[1:] + signed[:-1]).ravel()]
    )
    return bool(max(np.mean(beside > 0.0), np.mean(beside < 0.0)) > _MOSTLY)


def goes_on(grid: Array, grey: NDArray[np.uint8]) -> bool:
    """Say whether the squares go on beyond a grid of corners, (ny, nx, 2), on one of its sides."""
    levels = grey.astype(np.float32)
    size = np.array([grey.shape[1], grey.shape[0]])
    for side in (grid, grid[::-1], np.swapaxes(grid, 0, 1), np.swapaxes(grid, 0, 1)[::-1]):
        beyond = 3.0 * side[0] - 3.0 * side[1] + side[2]  # as the last three lines go on
        away = beyond - side[0]
        along = np.gradient(side[0], axis=0)
        inside = np.all((beyond > 0.0) & (beyond < size - 1), axis=1)
        fits = [
            fit_saddle(levels, p, np.column_stack([x, y]), _STRAIGHT, 1.0)
            for p, x, y in zip(beyond[inside], along[inside], away[inside], strict=True)
        ]
        crossings = [fit for fit in fits if fit is not None and fit.misfit < _CROSSING]
        if len(crossings) > 0.5 * len(side[0]):
            return True
    return False


def _oriented(grid: Array, grey: NDArray[np.uint8]) -> Array:
    """Return the grid with x, y, and the line of sight right-handed, and its first square black."""
    x = grid[:, -1].mean(axis=0) - grid[:, 0].mean(axis=0)
    y = grid[-1].mean(axis=0) - grid[0].mean(axis=0)
    if x[0] * y[1] - x[1] * y[0] < 0.0:
        grid = grid[:, ::-1]
    return grid if _blackness(grid, grey) > 0.0 else grid[::-1, ::-1]


def _blackness(grid: Array, grey: NDArray[np.uint8]) -> float:
    """Return how much darker the squares are that should be black than those beside them."""
    black, levels = _squares(grid, grey)
    return float(levels[~black].mean() - levels[black].mean())


def _squares(grid: Array, grey: NDArray[np.uint8]) -> tuple[BoolArray, Array]:
    """Return which squares between corners should be black, and the levels in their middles."""
    middles = 0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])
    column, row = np.rint(np.moveaxis(middles, -1, 0)).astype(np.intp)
    row = np.clip(row, 0, grey.shape[0] - 1)
    column = np.clip(column, 0, grey.shape[1] - 1)
    i, j = np.indices(row.shape)
    # The square after the first one along both axes is black like that.
    return (i + j) % 2 == 0, grey[row, column].astype(np.float64)
