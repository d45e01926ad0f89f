"""The calibration board: a plane with corners whose places on it are known.

The board frame lies in the plane of the corners. Chessboards and ChArUco boards have the frame
that OpenCV gives them, x to the right and y down as one looks at the board, z away from the viewer,
into the board; an AprilGrid has that of Kalibr, x to the right and y up, z towards the viewer.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from legcal.geometry.types import Array

BoardKind = Literal["chessboard", "charuco", "aprilgrid"]


@dataclass(frozen=True, eq=False)
class Board:
    """A flat calibration board.

    Attributes
    ----------
    kind : {"chessboard", "charuco", "aprilgrid"}
        What is printed on it.
    columns, rows : int
        Squares along x and along y, black and white ones (chessboard, ChArUco); tags along x
        and along y (AprilGrid).
    side : float
        Side of a square, or of the black frame of a tag (AprilGrid) [m].
    marker : float
        Side of a marker of a ChArUco board [m]; zero for other kinds.
    spacing : float
        Gap between the tags of an AprilGrid as a part of their side; zero for other kinds.
    dictionary : str
        What markers and tags are taken from, as OpenCV names it; "" for a chessboard.
    legacy : bool
        Whether a ChArUco board is of the pattern that OpenCV made before version 4.6.
    """

    kind: BoardKind
    columns: int
    rows: int
    side: float
    marker: float = 0.0
    spacing: float = 0.0
    dictionary: str = ""
    legacy: bool = False

    @property
    def grid(self) -> tuple[int, int]:
        """Number of corners along x and along y."""
        if self.kind == "aprilgrid":
            return 2 * self.columns, 2 * self.rows
        return self.columns - 1, self.rows - 1

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
        """The four outer corners of what is printed, around it, (4, 3) in the board frame [m]."""
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
