"""The board searched in the images of a dataset, and what stands there instead of it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np

from legcal.detection.picture import to_grey
from legcal.errors import NotVisible
from legcal.geometry.types import Array, Image, IntArray
from legcal.observations.corners import Corners, found_corners, join_corners
from legcal.observations.measurements import Measurements
from legcal.progress import Report
from legcal.vision.board import Board
from legcal.vision.corner_search import find_corners
from legcal.vision.other_boards import described
from legcal.workers import Run

STAGE = "Searching the board"
_ASKED = 2  # images of a view that are asked what they show instead


def detect_corners(
    board: Board,
    load: Callable[[int], Image],
    rows: Sequence[int],
    run: Run,
    report: Report,
) -> Corners:
    """Return the corners of the board in images; an image without the board has none.

    Parameters
    ----------
    board : Board
        The board.
    load : callable
        Returns the image of a row; it can travel to another process.
    rows : sequence of int
        The rows to search.
    run : callable
        How images are searched: in turn or by several processes.
    report : callable
        Called as ``report(stage, done, total)``.
    """
    report(STAGE, 0, len(rows))
    found = []
    search = _Search(board, load)
    for k, (row, (corner, px, sigma)) in enumerate(zip(rows, run(search, rows), strict=True)):
        found.append(found_corners(np.full(len(corner), row, dtype=np.intp), corner, px, sigma))
        report(STAGE, k + 1, len(rows))
    return join_corners(found)


def require_board(
    board: Board,
    corners: Corners,
    load: Callable[[int], Image],
    measurements: Measurements,
    views: Collection[str],
) -> None:
    """Refuse views whose images do not show the board, and say what they show instead.

    Parameters
    ----------
    board : Board
        The board.
    corners : Corners
        What :func:`detect_corners` found.
    load : callable
        Returns the image of a row.
    measurements : Measurements
        The rows.
    views : collection of str
        The views that need the board.

    Raises
    ------
    NotVisible
        With one sentence for each of them.
    """
    shown = set(measurements.view[corners.row].tolist())
    problems = []
    for v, view in enumerate(measurements.views):
        rows = [row for row in np.flatnonzero(measurements.view == v).tolist()
                if measurements.image[row]]  # fmt: skip
        if view.name not in views or v in shown or not rows:
            continue
        found = next((what for row in rows[:_ASKED] if (what := _shown(board, load, row))), None)
        problems.append(
            f"view {view.name}: the board could not be found in any of its {len(rows)} "
            f"image{'s' * (len(rows) != 1)}: found {found or 'nothing like it'}, needed "
            f"{_words(board)}; correct the block board of the dataset file, or turn the camera."
        )
    if problems:
        raise NotVisible(problems)


def _shown(board: Board, load: Callable[[int], Image], row: int) -> str | None:
    """Return what an image shows instead of a board, in words; None if there is nothing."""
    return described(board, to_grey(load(row)))


def _words(board: Board) -> str:
    """Return a board in words."""
    what = "tags" if board.kind == "aprilgrid" else "squares"
    whole = ", the whole of it" if board.kind == "chessboard" else ""
    name = {"chessboard": "a chessboard", "charuco": "a ChArUco board", "aprilgrid": "an AprilGrid"}
    return f"{name[board.kind]} of {board.columns} x {board.rows} {what}{whole}"


@dataclass(frozen=True, eq=False)
class _Search:
    """The search of an image, for any process."""

    board: Board
    load: Callable[[int], Image]

    def __call__(self, row: int) -> tuple[IntArray, Array, Array]:
        """Return what :func:`find_corners` does for the image of a row."""
        return find_corners(self.board, to_grey(self.load(row)))
