"""Place of a calibration board on the base, and the images that show it.

The board lies flat at the level of the base joints, at their centre or beside them, facing the
platform: there most camera places see it. An image shows it if all corners are in the picture, from
a moderate angle, large enough to be detected, and not behind a leg, an arm or the platform plate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array, BoolArray
from legcal.machine.model import Machine
from legcal.vision.board import Board, dictionary, facing_board
from legcal.vision.camera import Camera
from legcal.vision.sight import Bodies, behind_plate
from legcal.vision.visibility import in_picture, rays_past_axes

_SIDES = 4  # directions beside the machine
_DISTANCE = 1.05  # of a board beside the base joints, in half diagonals
_MIN_COSINE = 0.45  # between the normal of the print and the line of sight
_MODULE_PX = 2.0  # least apparent width of a module of a marker
_MODULES = 6.0  # modules equivalent to a square without a marker
_FRAME = {"charuco": 2, "aprilgrid": 4}  # modules of the black frame of a marker, both sides


@dataclass(frozen=True, eq=False)
class LaidBoard:
    """A calibration board at its place on the base."""

    board: Board
    T_base_board: RigidTransform

    @property
    def normal(self) -> Array:
        """Normal of the print in the base link, (3,)."""
        z = self.T_base_board.rotation.as_matrix()[:, 2]
        return np.asarray(z * self.board.towards_viewer)

    @property
    def corners(self) -> Array:
        """The outer corners of the print in the base link, (4, 3) [m]."""
        return np.asarray(self.T_base_board.apply(self.board.extent))

    @property
    def middle(self) -> Array:
        """The middle of the print in the base link, (3,) [m]."""
        return np.asarray(self.corners.mean(axis=0))

    def is_shown(
        self,
        camera: Camera,
        T_base_camera: RigidTransform,
        bodies: Bodies,
        margin_px: float = 0.0,
        *,
        is_read: bool = True,  # require the size for detection
    ) -> BoolArray:
        """Return a mask of the images of one camera that show the board, (n_images,)."""
        n = len(bodies.B)
        outer, eye = self.corners, T_base_camera.translation
        P = T_base_camera.inv().apply(outer)
        sight = eye - outer
        cosine = sight @ self.normal / np.linalg.norm(sight, axis=1)
        is_in_picture = in_picture(camera, P, bodies.nearest, margin_px).all()
        if cosine.min() < _MIN_COSINE or not is_in_picture:
            return np.zeros(n, dtype=np.bool_)
        if is_read and self._narrowest(camera.project(P)) < _MODULE_PX:
            return np.zeros(n, dtype=np.bool_)
        points = np.concatenate([outer, self.T_base_board.apply(self.board.points)])
        T = T_base_camera.inv()
        P = np.broadcast_to(T.apply(points), (n, len(points), 3))
        bodies = bodies.before(T_base_camera)
        distance, depth, square = rays_past_axes(P, bodies.A, *bodies.axes)
        aside = bodies.radius + self.board.side * depth / distance[..., None]
        hidden = (square < aside**2) & (depth > 0.0) & (depth < distance[..., None])
        B = bodies.B[:, : bodies.n_legs]
        hidden = hidden.any(axis=-1) | behind_plate(P[:, None], B, 0.0, surely=False)[:, 0]
        nobody, beside = np.full(len(points), -1), np.full(len(points), self.board.side)
        for k, placed in enumerate(bodies.occluders):
            hidden[k] |= placed.hide(P[k], nobody, beside, np.zeros(len(points))) >= 0
        return ~np.asarray(hidden.any(axis=1))

    def _narrowest(self, px: Array) -> float:
        """Least apparent width of a module, from outer corners (4, 2) [px]."""
        board = self.board
        x, y = (px[1] - px[0]) / board.columns, (px[3] - px[0]) / board.rows  # of a tile
        tile = abs(x[0] * y[1] - x[1] * y[0]) / max(np.linalg.norm(x), np.linalg.norm(y))
        if board.kind == "chessboard":
            return float(tile / _MODULES)
        n = dictionary(board.dictionary).markerSize + _FRAME[board.kind]
        of_tile = board.marker / board.side if board.marker else 1.0 / (1.0 + board.spacing)
        return float(tile * of_tile / n)


def feet(board: Board, A: Array, up: Array) -> list[tuple[Array, Array]]:
    """Return candidate positions relative to the centre of base joints, and x axes, (3,) [m].

    At the centre, and beyond all joints in a few directions normal to *up*.
    """
    flat = A - A.mean(axis=0)
    flat = flat - (flat @ up)[:, None] * up
    reach = float(np.linalg.norm(flat, axis=1).max())
    half = 0.5 * float(np.linalg.norm(np.ptp(board.extent, axis=0)))
    x, y = normal_basis(up)
    around = [np.cos(t) * x + np.sin(t) * y for t in 2.0 * np.pi * np.arange(_SIDES) / _SIDES]
    return [(np.zeros(3), x), *(((reach + _DISTANCE * half) * side, side) for side in around)]


def lying(board: Board, machine: Machine) -> list[LaidBoard]:
    """Return the candidate places of a board on the base."""
    up, middle = machine.upward, machine.A_base.mean(axis=0)
    return [
        LaidBoard(board, facing_board(board, middle + foot, up, side))
        for foot, side in feet(board, machine.A_base, up)
    ]
