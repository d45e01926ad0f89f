"""What an image shows where a board is not found: one of other dimensions, or a part of it."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from legcal.vision.board import Board
from legcal.vision.board_dictionaries import DICTIONARIES
from legcal.vision.chessboard import goes_on, inner_corners
from legcal.vision.tag_search import search_charuco, search_tags

_FEWEST_CORNERS = 3  # along a side of a chessboard, for OpenCV
_FEWEST_MARKERS = 3  # of another dictionary that are no chance


def described(board: Board, image: NDArray[np.generic]) -> str | None:
    """Return what an image shows instead of a board, in words that go after "found".

    Parameters
    ----------
    board : Board
        The board that was not found.
    image : (height, width) array
        Grey levels, 0 to 255.

    Returns
    -------
    str or None
        None if there is nothing like a board.
    """
    grey = np.clip(np.rint(image.astype(np.float32)), 0.0, 255.0).astype(np.uint8)
    if board.kind == "chessboard":
        return _other_squares(board, grey)
    return _other_markers(board, grey)


def _other_squares(board: Board, grey: NDArray[np.uint8]) -> str | None:
    """Return which grid of squares is seen."""
    nx, ny = board.grid
    steps = (0, 1, -1, 2, -2)
    tried = [(nx + a, ny + b) for a in steps for b in steps] + [(nx // 2 + 1, ny // 2 + 1)]
    part = None
    for x, y in dict.fromkeys(tried):
        if min(x, y) < _FEWEST_CORNERS:
            continue
        grid = inner_corners(grey, (x, y), quick=True)
        if grid is None:
            continue
        if not goes_on(grid, grey):
            seen = f"a chessboard of {x + 1} x {y + 1} squares"
            return seen + (" or that part of one" if x <= nx and y <= ny else "")
        part = part or "a part of a chessboard of more squares"
    return part


def _other_markers(board: Board, grey: NDArray[np.uint8]) -> str | None:
    """Return which markers or tags are seen."""
    thing = "tags" if board.kind == "aprilgrid" else "markers"
    count = board.columns * board.rows
    own = count if board.kind == "aprilgrid" else count // 2
    numbers, _ = search_tags(board, grey)
    beyond = np.unique(numbers[numbers >= own])
    if len(beyond):
        return (
            f"{thing} with numbers up to {int(beyond.max())}, and such a board has 0 to {own - 1}"
        )
    if len(numbers) and board.kind == "charuco":
        for turned, what in (
            (replace(board, columns=board.rows, rows=board.columns), "squares_x and squares_y"),
            (replace(board, legacy=not board.legacy), "legacy_pattern"),
        ):
            if len(search_charuco(turned, grey)[0]) > 3:
                return f"its {thing}, as of a board with another {what}"
    if len(numbers):
        return f"only {len(numbers)} of its {own} {thing}"
    for other in DICTIONARIES:
        seen = search_tags(replace(board, dictionary=other), grey)[0]
        if other != board.dictionary and len(seen) >= _FEWEST_MARKERS:
            return f"markers of {other}"
    return None
