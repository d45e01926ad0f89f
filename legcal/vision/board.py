"""Calibration boards: their print, and their corners in the board frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.lines import cross, normal_basis
from legcal.geometry.types import Array, BoolArray, IntArray

BoardKind = Literal["chessboard", "charuco", "aprilgrid"]


@dataclass(frozen=True, eq=False)
class Board:
    """A flat calibration board."""

    kind: BoardKind
    columns: int  # along x: squares, black and white (chessboard, ChArUco), or tags
    rows: int  # along y, the same
    side: float  # side of a square, or of the black frame of a tag (AprilGrid) [m]
    marker: float = 0.0  # side of a marker of a ChArUco board [m]; zero for other kinds
    spacing: float = 0.0  # gap between the tags of an AprilGrid as a part of their side
    dictionary: str = ""  # of markers and tags, as OpenCV names it
    legacy: bool = False  # ChArUco as OpenCV printed it before version 4.6

    @property
    def grid(self) -> tuple[int, int]:
        """Number of corners along x and along y."""
        if self.kind == "aprilgrid":
            return 2 * self.columns, 2 * self.rows
        return self.columns - 1, self.rows - 1

    @property
    def towards_viewer(self) -> float:
        """1 where the z axis of the board comes out of its print, else -1."""
        return 1.0 if self.kind == "aprilgrid" else -1.0

    @property
    def n_corners(self) -> int:
        """Number of corners; they are numbered from 0, along x first."""
        return self.grid[0] * self.grid[1]

    @cached_property
    def points(self) -> Array:
        """The corners in the board frame, (n_corners, 3) [m]; the index is the number.

        Corner 0 is the origin of a chessboard; the inner corner at (side, side) of a ChArUco board,
        whose origin is the outer corner of its first square; the first corner of tag 0, the
        origin, of an AprilGrid.
        """
        x, y = (self._along(n) for n in self.grid)
        grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        return np.column_stack([grid, np.zeros(len(grid))])

    @cached_property
    def extent(self) -> Array:
        """The four outer corners of the print, in cyclic order, (4, 3) in the board frame [m]."""
        if self.kind == "aprilgrid":
            gap = self.spacing * self.side
            low, high = np.array([-gap, -gap]), self.points[-1, :2] + gap
        else:
            first = self.points[0, :2]
            low = first - self.side
            high = low + self.side * np.array([self.columns, self.rows])
        x, y = zip(low.tolist(), high.tolist(), strict=True)
        around = [(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])]
        return np.array([[*corner, 0.0] for corner in around])

    def _along(self, n: int) -> Array:
        """Return the coordinates of n corners along an axis [m]."""
        k = np.arange(n)
        if self.kind == "aprilgrid":
            return np.asarray(self.side * ((1.0 + self.spacing) * (k // 2) + k % 2))
        return np.asarray(self.side * (k + (self.kind == "charuco")))


def facing_board(board: Board, place: Array, normal: Array, side: Array) -> RigidTransform:
    """Return T_base_board with the middle of the print at a place and its face along a normal.

    The y axis of the board is along *side*, as far as that is across the normal.
    """
    z = board.towards_viewer * normal
    y = side - (side @ z) * z
    if np.linalg.norm(y) < 1e-6:
        y = normal_basis(z)[0]
    y = y / np.linalg.norm(y)
    turn = Rotation.from_matrix(np.column_stack([cross(y, z), y, z]))
    return RigidTransform.from_components(place - turn.apply(board.extent.mean(axis=0)), turn)


Link = Literal["base", "platform"]
LINKS: tuple[Link, ...] = ("base", "platform")


@dataclass(frozen=True, eq=False)
class FixedBoard:
    """A board that is fixed to a link of a machine.

    Corners are numbered across boards: the corners of the platform's board come after the corners
    of the base's.
    """

    board: Board
    link: Link
    T_link_board: RigidTransform | None = None  # None if not known
    first: int = 0  # the number of its first corner

    @property
    def name(self) -> str:
        """Its name in parameters and messages."""
        return board_name(self.link)

    def has(self, corner: IntArray) -> BoolArray:
        """Return a mask (n,) of the corner indices that belong to this board."""
        return (corner >= self.first) & (corner < self.first + self.board.n_corners)


def board_name(link: Link) -> str:
    """Return the name of the board on a link."""
    return "board" if link == "base" else f"{link}_board"


DICTIONARIES = tuple(
    [f"DICT_{bits}X{bits}_{size}" for bits in (4, 5, 6, 7) for size in (50, 100, 250, 1000)]
    + ["DICT_ARUCO_ORIGINAL", "DICT_ARUCO_MIP_36h12"]
    + [f"DICT_APRILTAG_{name}" for name in ("16h5", "25h9", "36h10", "36h11")]
)
APRIL_TAGS = "DICT_APRILTAG_36h11"


def dictionary(name: str) -> cv2.aruco.Dictionary:
    """Return a dictionary of OpenCV by its name."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def dictionary_size(name: str) -> int:
    """Return the number of markers in a dictionary."""
    return len(dictionary(name).bytesList)


def charuco_board(board: Board) -> cv2.aruco.CharucoBoard:
    """Return a ChArUco board as an object of OpenCV, lengths in metres."""
    board_object = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.side, board.marker, dictionary(board.dictionary)
    )
    board_object.setLegacyPattern(board.legacy)
    return board_object
