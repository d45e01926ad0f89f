"""What a calibration board on the base is worth: what fails without it, and what it mends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array
from legcal.identify.conditions import Condition
from legcal.identify.ranks import Analysis, scattered
from legcal.identify.weak import undetermined, weak_directions

_MENDED = 1e-6  # part of a direction outside of what stays open


@dataclass(frozen=True)
class BoardRanks:
    """The ranks of all parameters, with a board in every image or with none.

    Attributes
    ----------
    staged_rank, full_rank : int
        Step by step, and everything at once.
    identifiable : bool
        Whether everything at once determines all directions that move the platform.
    """

    staged_rank: int
    full_rank: int
    identifiable: bool


@dataclass(frozen=True)
class BoardReport:
    """What a calibration board does for a session.

    Attributes
    ----------
    present : bool
        Whether the session has one, in every view.
    needed_for : tuple of str
        What fails without a board and holds with it: ``eq12``, ``two_directions``, ``staged``
        (the four steps determine all that moves the platform), ``full`` (everything at once does).
    without, with_board : BoardRanks
        The ranks without and with a board in every image.
    mends : tuple of str
        The directions that only a board lets step by step or at once determine, in words.
    """

    present: bool
    needed_for: tuple[str, ...]
    without: BoardRanks
    with_board: BoardRanks
    mends: tuple[str, ...]


def judge_board(
    analysis: Analysis, without: Sequence[Condition], with_board: Sequence[Condition]
) -> BoardReport:
    """Return what a board does for a session, whether it has one or not.

    Parameters
    ----------
    analysis : Analysis
        The session, as it is.
    without, with_board : sequence of Condition
        The paper's conditions without a board and with one in every view.
    """
    shown = analysis.session.board
    none = analysis.with_board(board=False) if shown.any() else analysis
    every = analysis if shown.all() else analysis.with_board()
    needed = [
        before.name
        for before, after in zip(without, with_board, strict=True)
        if before.fails and not after.fails
    ]
    if every.staged.complete and not none.staged.complete:
        needed.append("staged")
    if every.full.complete and not none.full.complete:
        needed.append("full")
    return BoardReport(
        bool(shown.all()), tuple(needed), _ranks(none), _ranks(every), _mended(none, every)
    )


def _ranks(analysis: Analysis) -> BoardRanks:
    """Return the ranks of an analysis."""
    return BoardRanks(analysis.staged.rank, analysis.full.rank, analysis.full.complete)


def _mended(none: Analysis, every: Analysis) -> tuple[str, ...]:
    """Return the directions that move the platform and that only a board determines, in words."""
    n_p = len(none.session.unit)
    pairs = [
        (scattered(a, n_p), scattered(b, n_p))
        for a, b in zip(none.default_steps, every.default_steps, strict=True)
    ]
    found: list[str] = []
    for before, after in [*pairs, (none.information, every.information)]:
        open_before, open_after = (undetermined(none.session, rows) for rows in (before, after))
        mended = _outside(open_before, open_after)
        directions = weak_directions(none.session, none.motion, mended)
        found += [d.direction for d in directions if not d.harmless]
    return tuple(dict.fromkeys(found))


def _outside(space: Array, part: Array) -> Array:
    """Return an orthonormal basis of what a space (w, p) has outside of a part of it (k, p)."""
    _, singular, basis = np.linalg.svd(space - space @ part.T @ part, full_matrices=False)
    return np.asarray(basis[singular > _MENDED])
