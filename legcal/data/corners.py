"""The table ``corners.csv``: corners of the calibration board, written and read back.

One row a corner: view and image, named as in ``observations.csv``; the number of the corner on the
board (with two boards, the corners of the platform's are numbered after those of the base's); its
pixel and the standard deviation of that [px]; verdict, reason and source.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from legcal.brief import brief
from legcal.data.image_tables import ImageTable
from legcal.data.measurements import Measurements, find_rows, places, refuse_outside
from legcal.data.outlines import DETAIL_COLUMN, SOURCES, UNLESS_REJECTED, VERDICT_COLUMNS, VERDICTS
from legcal.data.reasons import USED, Rejection, read_rejection
from legcal.errors import DatasetError
from legcal.files.folder import write_atomically
from legcal.files.table import Column, format_table, read_table
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.vision.board import FixedBoard

NUMBERS = ("u", "v", "sigma")
SIGMA_RANGE = (1e-6, 100.0)  # [px] plausible standard deviations of a corner
_REMEDY = "correct it, or the board in the dataset file"


def _columns(n_corners: int) -> tuple[Column, ...]:
    least, most = SIGMA_RANGE
    needed = f"a corner of the board, 0 to {n_corners - 1}"
    of_sigma = f"a standard deviation from {least:g} to {most:g} px"
    return (
        Column("view", "text"),
        Column("image", "text"),
        Column("corner", "whole", least=0, most=n_corners - 1, needed=needed, remedy=_REMEDY),
        *(Column(name, blank=True, remedy=UNLESS_REJECTED) for name in NUMBERS[:2]),
        Column(
            "sigma", least=least, most=most, needed=of_sigma, blank=True, remedy=UNLESS_REJECTED
        ),
        *VERDICT_COLUMNS,
        DETAIL_COLUMN,
    )


COLUMNS = tuple(column.name for column in _columns(0))


@brief
@dataclass(frozen=True, eq=False)
class Corners(ImageTable):
    """Corners of the board in images, one row a corner."""

    keys = "row", "corner"
    corner: IntArray  # (n,) index into Board.points, counted on from FixedBoard.first
    px: Array  # (n, 2) where it is seen [px]; (0, 0) is the centre of the top-left pixel
    sigma_px: Array  # (n,) of either coordinate
    used: BoolArray
    reason: tuple[Rejection, ...]  # reasons of rejections; false for used corners
    source: tuple[str, ...]  # detected or edited


def found_corners(row: IntArray, corner: IntArray, px: Array, sigma_px: Array) -> Corners:
    """Return corners that were detected, all of them used."""
    n = len(row)
    used = np.ones(n, dtype=np.bool_)
    return Corners(row, corner, px, sigma_px, used, (USED,) * n, ("detected",) * n)


def join_corners(tables: Sequence[Corners]) -> Corners:
    """Concatenate tables of corners."""
    none = np.zeros(0, dtype=np.intp)
    nothing = found_corners(none, none, np.zeros((0, 2)), np.zeros(0))
    return Corners.joined([nothing, *tables])


def write_corners(path: Path, corners: Corners, measurements: Measurements) -> None:
    """Write corners so that reading gives the same numbers, and the file complete or not at all.

    Raises OSError if it cannot be written.
    """
    names = places(measurements)
    rows = (
        [
            *names[row],
            int(corners.corner[i]),
            *corners.px[i].tolist(),
            float(corners.sigma_px[i]),
            VERDICTS[0 if corners.used[i] else 1],
            corners.reason[i].reason,
            corners.source[i],
            str(corners.reason[i].detail),
        ]
        for i, row in enumerate(corners.row.tolist())
    )
    write_atomically(path, format_table(COLUMNS, rows).encode())


def read_corners(path: Path, boards: Sequence[FixedBoard], measurements: Measurements) -> Corners:
    """Return the table ``corners.csv`` of boards in the order of the file.

    An edited row replaces the detected row of the same image and corner. Raises DatasetError with
    one sentence for each problem.
    """
    n_corners = sum(fixed_board.board.n_corners for fixed_board in boards)
    table = read_table(
        path,
        "table of corners",
        "corner",
        _columns(n_corners),
        needed="the corners of the board in the images; add them, or delete the file to have "
        "images searched",
    )
    numbers_of_corners = [int(text) for text in table.text("corner") if text.isdigit()]
    beyond = {k for k in numbers_of_corners if k >= n_corners}
    if len(beyond) > 1:  # no slip of a pen
        described = " and ".join(f"{b.board.n_corners} on the {b.link}" for b in boards)
        raise DatasetError(
            f"{path}: the corners could not be used: found corners up to {max(beyond)}, and in the "
            f"dataset file boards with {n_corners} ({described}), needed the boards on which these "
            "were found, whose corners are counted one board after the other; describe the other "
            "board in the dataset file again, or delete the table to have images searched."
        )
    row = find_rows(table, measurements)
    used = np.array([verdict == "used" for verdict in table.text("verdict")], dtype=np.bool_)
    table.need(NUMBERS, used)
    numbers = table.numbers(NUMBERS)
    refuse_outside(table, row, NUMBERS[:2], measurements)
    corner, source = table.text("corner"), table.text("source")
    keys = list(zip(row.tolist(), corner, source, strict=True))
    table.once([None if key[0] < 0 else key for key in keys], "the same image and corner")
    table.check()
    edited = {key for key in keys if key[2] == SOURCES[1]}
    corners = Corners(
        row,
        np.array(corner, dtype=np.intp),
        numbers[:, :2],
        numbers[:, 2],
        used,
        tuple(map(read_rejection, table.text("reason"), table.text("detail"))),
        source,
    )
    wins = [key in edited or (*key[:2], SOURCES[1]) not in edited for key in keys]
    return corners.choose(np.array(wins, dtype=np.bool_))
