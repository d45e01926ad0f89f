"""Corners of the board that a dataset gives in place of a search, and rows that lack them."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from legcal.errors import DatasetError
from legcal.observations.corners import Corners
from legcal.observations.corners_file import read_corners
from legcal.observations.measurements import Measurements
from legcal.vision.board import Board

CORNERS_NAME = "corners.csv"
LEAST_CORNERS = 4  # in an image that must place its camera


def read_given_corners(
    path: Path, board: Board | None, measurements: Measurements
) -> Corners | None:
    """Return the corners beside a dataset, if there are any.

    Parameters
    ----------
    path : Path
        The table; None is returned if there is none.
    board : Board or None
        The board that the dataset describes.
    measurements : Measurements
        The rows that corners belong to.

    Raises
    ------
    DatasetError
        With one sentence for each thing that is wrong.
    """
    if not os.path.exists(path):
        return None
    if board is None:
        raise DatasetError(
            f"{path}: the corners could not be used: found no board in the dataset file, needed "
            "the one that they belong to; describe it in the block board, or remove the table."
        )
    return read_corners(path, board, measurements)


def rows_without_board(
    table_path: Path, measurements: Measurements, corners: Corners, hand_held: Sequence[int]
) -> list[str]:
    """Return one sentence for each row of a hand-held view in which the board has no pose.

    Parameters
    ----------
    table_path : Path
        ``measurements.csv``, for messages.
    measurements : Measurements
        The rows.
    corners : Corners
        The given corners.
    hand_held : sequence of int
        The rows of hand-held views.
    """
    counts = np.bincount(corners.row[corners.used], minlength=measurements.n_rows)
    return [
        f"{table_path}, row {row + 1}: its camera could not be placed: found "
        f"{counts[row] or 'no'} corners of the board in {CORNERS_NAME}, needed {LEAST_CORNERS} in "
        "every image of a camera that is held in the hand; add them or remove the row."
        for row in hand_held
        if counts[row] < LEAST_CORNERS
    ]
