"""Which calibration board a simulated machine gets: one of a fitting size, or from a file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from legcal.dataset.board_entry import described_board
from legcal.errors import DatasetError
from legcal.files.schema import parse_yaml, read_text
from legcal.simulation.posed_machine import PosedMachine
from legcal.vision.board import Board, BoardKind
from legcal.vision.board_dictionaries import APRIL_TAGS

KINDS: tuple[BoardKind, ...] = ("chessboard", "charuco", "aprilgrid")
_WIDTH = 0.42  # of the size of the machine
_DIGITS = 3  # of a side in metres: whole millimetres


def chosen_board(
    choice: Board | str | Path | None, machines: Sequence[PosedMachine]
) -> Board | None:
    """Return the board that settings ask for.

    Parameters
    ----------
    choice : Board, str, Path or None
        A board; a kind, of a size that fits the machine; or a YAML file with the block ``board``
        of a dataset.
    machines : sequence of PosedMachine
        The machine in its poses.

    Raises
    ------
    DatasetError
        If the file is malformed.
    """
    if choice is None or isinstance(choice, Board):
        return choice
    if choice not in KINDS:
        return _from_file(Path(choice))
    joints = np.concatenate([part for m in machines for part in (m.A, m.B)])
    width = _WIDTH * float(np.linalg.norm(np.ptp(joints, axis=0)))
    if choice == "aprilgrid":
        side = max(round(width / 5.3, _DIGITS), 0.001)
        return Board(choice, 4, 3, side, spacing=0.3, dictionary=APRIL_TAGS)
    if choice == "charuco":
        side = max(round(width / 7.0, _DIGITS), 0.002)
        marker = round(0.72 * side, _DIGITS)
        return Board("charuco", 7, 5, side, marker=marker, dictionary="DICT_4X4_50")
    return Board("chessboard", 9, 6, max(round(width / 9.0, _DIGITS), 0.001))


def _from_file(path: Path) -> Board:
    """Return the board of a YAML file."""
    found = parse_yaml(read_text(path, "board file"), path, "board file")
    block = found.get("board")
    if not isinstance(block, dict):
        raise DatasetError(
            f"{path}: the board file could not be used: found no block board, needed one as in "
            "dataset.yaml; add it."
        )
    return described_board(block, path)[0]
