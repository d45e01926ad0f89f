"""What is printed on a calibration board, as a function of the place on it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from legcal.geometry.types import Array
from legcal.vision.board import Board
from legcal.vision.board_dictionaries import dictionary
from legcal.vision.board_objects import charuco_board

INK = 0.06  # how much of the light that white returns black does
TAG_BORDER = 2  # modules of the black frame of a tag, as Kalibr prints it


@dataclass(frozen=True, eq=False)
class BoardPrint:
    """A print: tiles of one size, each with black and white modules.

    Attributes
    ----------
    face : int
        The face of the plate that is printed, as the renderer counts them.
    middle : (2,) array
        The middle of the plate in the board frame [m].
    origin : (2,) array
        Where the first tile starts, in the board frame [m].
    pitch : float
        From tile to tile [m].
    first, size : float
        Where the modules start in a tile, and how long they are together [m].
    modules : (rows, columns, n, n) array of bool
        Black modules of each tile, by rows along y and columns along x.
    checked : int
        0 or 1: tiles of that parity are black outside their modules; -1 for tags, where the
        crossings of the gaps are black.
    """

    face: int
    middle: Array
    origin: Array
    pitch: float
    first: float
    size: float
    modules: NDArray[np.bool_]
    checked: int

    @classmethod
    def of(cls, board: Board, face: int, middle: Array) -> BoardPrint:
        """Return the print of a board on a face of a plate; the middle is the plate's."""
        modules = _modules(board)
        if board.kind == "aprilgrid":
            pitch = (1.0 + board.spacing) * board.side
            return cls(face, middle, np.zeros(2), pitch, 0.0, board.side, modules, -1)
        origin = board.points[0, :2] - board.side
        black = 1 if board.legacy and board.rows % 2 == 0 else 0
        marker = board.marker or board.side
        gap = 0.5 * (board.side - marker)
        return cls(face, middle, origin, board.side, gap, marker, modules, black)

    def reflectance(self, x: Array, y: Array) -> Array:
        """Return how much of the light that white returns comes back from points of the plate.

        Parameters
        ----------
        x, y : (n,) array
            Points in the frame of the plate [m].
        """
        u = (x + (self.middle[0] - self.origin[0])) / self.pitch
        v = (y + (self.middle[1] - self.origin[1])) / self.pitch
        i, j = np.floor(u).astype(np.intp), np.floor(v).astype(np.intp)
        a, b = (u - i) * self.pitch, (v - j) * self.pitch
        rows, columns, n, _ = self.modules.shape
        inside = (i >= 0) & (i < columns) & (j >= 0) & (j < rows)
        if self.checked < 0:
            reach = (i >= -1) & (i < columns) & (j >= -1) & (j < rows)
            black = reach & (a >= self.size) & (b >= self.size)
        else:
            black = inside & ((i + j) % 2 == self.checked)
        k = np.floor((a - self.first) * (n / self.size)).astype(np.intp)
        m = np.floor((b - self.first) * (n / self.size)).astype(np.intp)
        at = np.flatnonzero(inside & (k >= 0) & (k < n) & (m >= 0) & (m < n))
        black[at] |= self.modules[j[at], i[at], m[at], k[at]]
        return np.where(black, np.float32(INK), np.float32(1.0))


def _modules(board: Board) -> NDArray[np.bool_]:
    """Return the black modules of every tile, (rows, columns, n, n)."""
    shape = board.rows, board.columns
    if board.kind == "chessboard":
        return np.zeros((*shape, 1, 1), dtype=np.bool_)
    if board.kind == "aprilgrid":
        tags = [
            # Kalibr's tags are upright where OpenCV's stand on their heads; rows go up.
            np.rot90(_marker(board.dictionary, k, TAG_BORDER), 2)[::-1]
            for k in range(board.columns * board.rows)
        ]
        return np.array(tags).reshape(*shape, *tags[0].shape)
    printed = charuco_board(board)
    found = np.zeros((*shape, *_marker(board.dictionary, 0, 1).shape), dtype=np.bool_)
    for number, corners in zip(np.ravel(printed.getIds()), printed.getObjPoints(), strict=True):
        i, j = np.floor(np.mean(corners, axis=0)[:2] / board.side).astype(int)
        found[j, i] = _marker(board.dictionary, int(number), 1)
    return found


@lru_cache(maxsize=1024)
def _marker(name: str, number: int, border: int) -> NDArray[np.bool_]:
    """Return the black modules of a marker, (n, n), from its top left."""
    markers = dictionary(name)
    n = markers.markerSize + 2 * border
    picture = cv2.aruco.generateImageMarker(markers, number, n, borderBits=border)
    return np.asarray(np.asarray(picture) == 0, dtype=np.bool_)
