"""A board in a word: ``chessboard:9x6:25mm``, or the file that describes it."""

from __future__ import annotations

import os
import re
from pathlib import Path

from legcal.dataset.board_entry import MOST, SIDES, described_board
from legcal.errors import DatasetError, UsageError
from legcal.files.quantity import LENGTH, parse_quantity
from legcal.files.schema import describe, parse_yaml, read_text
from legcal.vision.board import Board

FORMS = {
    "chessboard": "chessboard:9x6:25mm (squares, side)",
    "charuco": "charuco:7x5:40mm:29mm:DICT_4X4_50 (squares, side, marker, dictionary)",
    "aprilgrid": "aprilgrid:6x6:88mm:0.3 (tags, side, gap as a part of it)",
}
_LEAST_SQUARES = 4  # along a side of a chessboard
_COUNTS = re.compile(r"(\d{1,4})[xX](\d{1,4})", re.ASCII)
_OPTION = "--board"


def board_of(spec: str | Path | Board) -> Board:
    """Return the board that a word or a file describes.

    Parameters
    ----------
    spec : str, Path or Board
        ``KIND:NxM:SIZE...`` as in ``FORMS``, or a YAML file with the block ``board`` of a dataset.
        The sides count as drawn: for a camera only their ratios matter. A chessboard may look the
        same after half a turn here.

    Raises
    ------
    UsageError, DatasetError
        If it is none of these, or no such board can be printed.
    """
    if isinstance(spec, Board):
        return spec
    kind, *words = str(spec).split(":")
    if kind not in FORMS:
        return _from_file(Path(spec))
    counts = _COUNTS.fullmatch(words[0]) if words else None
    expected = {"chessboard": (1, 2), "charuco": (4, 5), "aprilgrid": (3,)}[kind]
    if counts is None or len(words) not in expected:
        raise _refused(str(spec), describe(str(spec)), FORMS[kind])
    x, y = int(counts[1]), int(counts[2])
    if kind == "chessboard":
        return _chessboard(str(spec), x, y, words[1:])
    side = parse_quantity(words[1], LENGTH, _OPTION)
    if kind == "aprilgrid":
        try:
            spacing = float(words[2])
        except ValueError as error:
            raise _refused(str(spec), describe(words[2]), "the gap as a number, 0.3") from error
        found = {"tags_x": x, "tags_y": y, "tag_size": side, "tag_spacing": spacing}
    else:
        marker = parse_quantity(words[2], LENGTH, _OPTION)
        found = {"squares_x": x, "squares_y": y, "square": side, "marker": marker}
        found["dictionary"] = words[3]  # type: ignore[assignment]
        if words[4:]:
            if words[4] != "legacy":
                raise _refused(str(spec), describe(words[4]), "legacy, or nothing, at the end")
            found["legacy_pattern"] = True
    try:
        return described_board({"kind": kind, **found}, Path(_OPTION))[0]
    except DatasetError as error:
        raise UsageError(error.problems) from error


def _chessboard(spec: str, x: int, y: int, words: list[str]) -> Board:
    """Return a chessboard; which of its sides is up does not matter to a camera."""
    side = parse_quantity(words[0], LENGTH, _OPTION) if words else 0.025
    if not _LEAST_SQUARES <= min(x, y) <= max(x, y) <= MOST:
        needed = f"{_LEAST_SQUARES} to {MOST} squares each way, black and white ones counted"
        raise _refused(spec, f"{x} x {y} squares", needed)
    if not SIDES[0] <= side <= SIDES[1]:
        needed = f"a side of {1e3 * SIDES[0]:g} to {1e3 * SIDES[1]:g} mm"
        raise _refused(spec, f"squares of {1e3 * side:g} mm", needed)
    return Board("chessboard", x, y, side)


def _from_file(path: Path) -> Board:
    """Return the board of a YAML file."""
    if not os.path.isfile(path):
        kinds = "; ".join(FORMS.values())
        raise _refused(str(path), describe(str(path)), f"a YAML file or one of: {kinds}")
    found = parse_yaml(read_text(path, "board file"), path, "board file").get("board")
    if not isinstance(found, dict):
        raise DatasetError(
            f"{path}: the board could not be read: found no block board, needed one as in "
            "dataset.yaml; add it."
        )
    return described_board(found, path)[0]


def _refused(spec: str, found: str, needed: str) -> UsageError:
    return UsageError(
        f"The board {describe(spec)} could not be used: found {found}, needed {needed}; correct "
        f"{_OPTION}."
    )
