"""Corners of a calibration board, as arrays that the residual of a corner takes.

Camera and board stand still over the images of a view, which therefore show each corner at one
place: what enters the fit is its mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.observations.corners import Corners
from legcal.observations.measurements import Measurements
from legcal.vision.board import Board
from legcal.vision.camera import Camera


@dataclass(frozen=True, eq=False)
class ObservedBoard:
    """The corners of a board that enter the fit, n of them.

    Attributes
    ----------
    view : (n,) array of int
        Index of the view.
    corner : (n,) array of int
        Number of the corner.
    point : (n, 3) array
        The corners in the frame of the board [m].
    feet : (n, 2) array
        Where they were measured, on the sensor plane.
    pixels : (n, 2) array
        The same in the image [px].
    constants : (n, 4) array
        What the residual needs besides: the derivative of pixels at these points [px], column by
        column.
    sigma : (n,) array
        Standard deviation of both coordinates [px].
    """

    view: IntArray
    corner: IntArray
    point: Array
    feet: Array
    pixels: Array
    constants: Array
    sigma: Array

    @property
    def pixels_per_unit(self) -> Array:
        """Derivative of pixels by the sensor plane at the measured corners, (n, 2, 2) [px]."""
        return np.swapaxes(self.constants.reshape(-1, 2, 2), -1, -2)

    def __len__(self) -> int:
        return len(self.view)

    def chosen(self, which: BoolArray) -> ObservedBoard:
        """Return some of the corners."""
        return ObservedBoard(
            self.view[which],
            self.corner[which],
            self.point[which],
            self.feet[which],
            self.pixels[which],
            self.constants[which],
            self.sigma[which],
        )

    def with_scale(self, factor: float) -> ObservedBoard:
        """Return the same corners with standard deviations that are larger by a factor."""
        return replace(self, sigma=factor * self.sigma)


@dataclass(frozen=True, eq=False)
class SeenBoard:
    """A calibration board that stands still on the base, and what images show of it.

    Attributes
    ----------
    board : Board
        Where its corners are, in its own frame.
    corners : Corners
        Where images show them; only the used ones count.
    """

    board: Board
    corners: Corners


def no_board() -> ObservedBoard:
    """Return what is seen where there is no board."""
    none, index = np.zeros(0), np.zeros(0, dtype=np.intp)
    pair = none.reshape(0, 2)
    return ObservedBoard(index, index, none.reshape(0, 3), pair, pair, none.reshape(0, 4), none)


def observed_board(
    seen: SeenBoard | None, measurements: Measurements, cameras: Sequence[Camera]
) -> ObservedBoard:
    """Return the used corners in the form that the residual takes.

    Parameters
    ----------
    seen : SeenBoard or None
        The board.
    measurements : Measurements
        The images.
    cameras : sequence of Camera
        The camera of each view.
    """
    if seen is None or not seen.corners.used.any():
        return no_board()
    corners = seen.corners
    used = np.flatnonzero(corners.used)
    key = np.stack([measurements.view[corners.row[used]], corners.corner[used]], axis=1)
    distinct, which = np.unique(key, axis=0, return_inverse=True)
    which = which.ravel()
    weight = corners.sigma_px[used] ** -2.0
    total = np.bincount(which, weights=weight)
    pixels = np.stack(
        [np.bincount(which, weights=weight * corners.px[used, i]) / total for i in range(2)], axis=1
    )
    view, corner = distinct.T
    found = ObservedBoard(
        view=view,
        corner=corner,
        point=seen.board.points[corner],
        feet=np.zeros((len(view), 2)),
        pixels=pixels,
        constants=np.zeros((len(view), 4)),
        sigma=1.0 / np.sqrt(total),
    )
    return board_seen_by(found, cameras)


def board_seen_by(board: ObservedBoard, cameras: Sequence[Camera]) -> ObservedBoard:
    """Return the same corners in the image, on the sensor planes of other cameras."""
    feet, constants = board.feet.copy(), board.constants.copy()
    for v in np.unique(board.view).tolist():
        of_view = board.view == v
        feet[of_view] = cameras[v].undistort(board.pixels[of_view])
        lens = cameras[v].pixels_per_unit(feet[of_view])
        constants[of_view] = np.swapaxes(lens, -1, -2).reshape(-1, 4)
    return replace(board, feet=feet, constants=constants)
