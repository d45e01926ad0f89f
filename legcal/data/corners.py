"""The table ``corners.csv``: corners of the calibration board, written and read back.

One row a corner: view and image, named as in ``observations.csv``; the number of the corner on the
board; where it is seen and the standard deviation of that [px]; verdict, reason and source.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from legcal.data.measurements import Measurements
from legcal.data.outlines import (
    SOURCES,
    VERDICTS,
    number_in,
    row_in_measurements,
    row_names,
    rows_by_name,
)
from legcal.errors import DatasetError
from legcal.files import describe, read_named_rows, write_atomically
from legcal.geometry import Array, BoolArray, IntArray
from legcal.vision import Board


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners of the board in images, one row a corner.

    Attributes
    ----------
    row : (n,) array of int
        Index into the rows of :class:`legcal.data.measurements.Measurements`.
    corner : (n,) array of int
        Number of the corner, the index into ``Board.points``.
    px : (n, 2) array
        Where it is seen [px]; (0, 0) is the centre of the top-left pixel.
    sigma_px : (n,) array
        Standard deviation of either coordinate [px].
    used : (n,) array of bool
        False for rejected corners.
    reason : tuple of str, length n
        Why a corner was rejected; "" for used ones.
    source : tuple of str, length n
        ``detected`` or ``edited``.
    """

    row: IntArray
    corner: IntArray
    px: Array
    sigma_px: Array
    used: BoolArray
    reason: tuple[str, ...]
    source: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.row)


def found_corners(row: IntArray, corner: IntArray, px: Array, sigma_px: Array) -> Corners:
    """Return corners that were detected, all of them used; arrays as in :class:`Corners`."""
    n = len(row)
    used = np.ones(n, dtype=np.bool_)
    return Corners(row, corner, px, sigma_px, used, ("",) * n, ("detected",) * n)


def choose_corners(corners: Corners, chosen: BoolArray | IntArray) -> Corners:
    """Return some of the corners, in the order of a mask or of indices."""
    index = np.arange(len(corners))[chosen]
    return Corners(
        corners.row[index],
        corners.corner[index],
        corners.px[index],
        corners.sigma_px[index],
        corners.used[index],
        tuple(corners.reason[i] for i in index.tolist()),
        tuple(corners.source[i] for i in index.tolist()),
    )


def join_corners(tables: Sequence[Corners]) -> Corners:
    """Return the corners of several tables, one after the other."""
    return Corners(
        np.concatenate([np.zeros(0, dtype=np.intp), *(t.row for t in tables)]),
        np.concatenate([np.zeros(0, dtype=np.intp), *(t.corner for t in tables)]),
        np.concatenate([np.zeros((0, 2)), *(t.px for t in tables)]),
        np.concatenate([np.zeros(0), *(t.sigma_px for t in tables)]),
        np.concatenate([np.zeros(0, dtype=np.bool_), *(t.used for t in tables)]),
        tuple(reason for t in tables for reason in t.reason),
        tuple(source for t in tables for source in t.source),
    )


def sort_corners(corners: Corners) -> Corners:
    """Return the corners sorted by image row and number."""
    return choose_corners(corners, np.lexsort([corners.corner, corners.row]))


NUMBERS = ("u", "v", "sigma")
COLUMNS = ("view", "image", "corner", *NUMBERS, "verdict", "reason", "source")
SIGMA_RANGE = (1e-6, 100.0)  # [px]: no corner is known better, and worse says nothing
_START = "the corner could not be used: found"


def write_corners(path: Path, corners: Corners, measurements: Measurements) -> None:
    """Write corners so that reading gives the same numbers, and the file complete or not at all.

    Parameters
    ----------
    path : Path
        ``corners.csv``.
    corners : Corners
        What to write.
    measurements : Measurements
        The rows they belong to, in the order of the file.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    write_atomically(path, format_corners(corners, measurements).encode())


def format_corners(corners: Corners, measurements: Measurements) -> str:
    """Return the text of ``corners.csv``; arguments as in :func:`write_corners`."""
    names = row_names(measurements)
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for i, row in enumerate(corners.row.tolist()):
        numbers = [*corners.px[i].tolist(), float(corners.sigma_px[i])]
        writer.writerow(
            [
                measurements.views[measurements.view[row]].name,
                names[row],
                int(corners.corner[i]),
                *("" if math.isnan(x) else repr(x) for x in numbers),
                VERDICTS[0 if corners.used[i] else 1],
                corners.reason[i],
                corners.source[i],
            ]
        )
    return text.getvalue()


def read_corners(path: Path, board: Board, measurements: Measurements) -> Corners:
    """Read ``corners.csv``.

    An edited row wins over the detected one of the same image and corner.

    Parameters
    ----------
    path : Path
        The table.
    board : Board
        The board, for the numbers of its corners.
    measurements : Measurements
        The rows that corners belong to, in the order of the file.

    Returns
    -------
    Corners
        In the order of the file.

    Raises
    ------
    DatasetError
        With one sentence for each thing that is wrong, naming row and column.
    """
    problems: list[str] = []
    needed = (
        "the corners of the board in the images; add them, or delete the file to have images "
        "searched"
    )
    rows = read_named_rows(
        path, "table of corners", COLUMNS, "correct the header", problems, needed=needed
    )
    places = rows_by_name(measurements)
    sizes = [(camera.width, camera.height) for camera in (v.camera for v in measurements.views)]
    found: dict[tuple[int, int, str], tuple[str, Mapping[str, str]]] = {}
    for where, cells in rows:
        row, wrong = row_in_measurements(where, cells, places, "corner")
        size = sizes[measurements.view[row]] if row >= 0 else (math.inf, math.inf)
        wrong += _problems(where, cells, board, size)
        problems += wrong
        if wrong:
            continue
        key = row, int(cells["corner"]), cells["source"]
        earlier, _ = found.setdefault(key, (where, cells))
        if earlier != where:
            problems.append(
                f"{where}: {_START} the same image and corner in "
                f"{earlier.rsplit(', ', 1)[-1]}, needed it once; remove one of them."
            )
    if problems:
        raise DatasetError(problems)
    return _corners(
        {
            key: cells
            for key, (_, cells) in found.items()
            if key[2] == SOURCES[1] or (*key[:2], SOURCES[1]) not in found
        }
    )


def _corners(found: Mapping[tuple[int, int, str], Mapping[str, str]]) -> Corners:
    """Return checked rows, by image row, corner and source, as arrays."""
    keys, cells = list(found), list(found.values())
    numbers = np.array([[number_in(c[name]) for name in NUMBERS] for c in cells])
    return Corners(
        row=np.array([row for row, _, _ in keys], dtype=np.intp),
        corner=np.array([corner for _, corner, _ in keys], dtype=np.intp),
        px=numbers[:, :2],
        sigma_px=numbers[:, 2],
        used=np.array([c["verdict"] == VERDICTS[0] for c in cells], dtype=np.bool_),
        reason=tuple(c["reason"] for c in cells),
        source=tuple(c["source"] for c in cells),
    )


def _problems(
    where: str, cells: Mapping[str, str], board: Board, size: Sequence[float]
) -> list[str]:
    """Return what is wrong with the cells of a row besides its place; ``size`` of the image."""
    problems = [
        f"{where}, column {name}: {_START} {describe(cells[name])}, needed "
        f"{' or '.join(allowed)}; correct it."
        for name, allowed in (("verdict", VERDICTS), ("source", SOURCES))
        if cells[name] not in allowed
    ]
    number = cells["corner"]
    if not (number.isascii() and number.isdecimal()) or int(number) >= board.n_corners:
        problems.append(
            f"{where}, column corner: {_START} {describe(number)}, needed a corner of the board, "
            f"0 to {board.n_corners - 1}; correct it, or the board in the dataset file."
        )
    used = cells["verdict"] == VERDICTS[0]
    values = {name: number_in(cells[name]) for name in NUMBERS}
    problems += [
        f"{where}, column {name}: {_START} "
        f"{describe(cells[name]) if cells[name] else 'an empty cell'}, needed a finite number; "
        "correct it or set the verdict to rejected with an empty cell."
        for name, x in values.items()
        if not math.isfinite(x) and (used or cells[name])
    ]
    problems += [
        f"{where}, column {name}: {_START} {values[name]:g} px, needed -0.5 to {length - 0.5:g} px,"
        " inside the image; correct it."
        for name, length in zip(NUMBERS[:2], size, strict=True)
        if math.isfinite(values[name]) and not -0.5 <= values[name] <= length - 0.5
    ]
    least, most = SIGMA_RANGE
    if math.isfinite(values["sigma"]) and not least <= values["sigma"] <= most:
        problems.append(
            f"{where}, column sigma: {_START} {values['sigma']:g}, needed a standard deviation "
            f"from {least:g} to {most:g} px; correct it."
        )
    return problems
