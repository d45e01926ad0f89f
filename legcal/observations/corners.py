"""The corner table: every corner of the calibration board in every image, with its sigma."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array, BoolArray, IntArray


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners of the board in images, one row a corner.

    Attributes
    ----------
    row : (n,) array of int
        Index into the rows of :class:`legcal.observations.measurements.Measurements`.
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
