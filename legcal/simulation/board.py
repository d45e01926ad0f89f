"""A calibration board beside a simulated machine: its print, its plate, its visible corners."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from legcal.files.motions import motion_to_xyz_quat
from legcal.geometry.types import Array, BoolArray
from legcal.machine.leg import Link
from legcal.simulation.observe import BORDER_PX, NEAREST
from legcal.simulation.solids import Box, Material, PlacedSolid, PosedMachine, Solid, triangles
from legcal.vision.board import (
    APRIL_TAGS,
    Board,
    BoardKind,
    FixedBoard,
    board_document,
    charuco_board,
    dictionary,
    read_board_file,
)
from legcal.vision.camera import Camera
from legcal.vision.visibility import in_picture

INK = 0.06  # reflectance of black, in units of white
TAG_BORDER = 2  # modules of the black frame of a tag, as Kalibr prints it

_THICKNESS = 0.02  # of the plate, in units of its longer side
_RIM = 0.06  # white margin around the print, in units of the longer side
_MIN_COSINE = 0.42  # minimum cosine between normal and line of sight for visible corners
_BESIDE = 0.3  # fraction of a square around a corner that must be visible with it
_IN_FRONT = 0.2  # minimum distance in front of a corner, in thicknesses, of a hit that hides it
_MIN_SHARE = 0.5  # minimum share of the corners in an image that counts
_MIN_CORNERS = 8

KINDS: tuple[BoardKind, ...] = ("chessboard", "charuco", "aprilgrid")
_WIDTH, _PLATFORM_WIDTH = 0.42, 0.3  # of boards on base and platform, in sizes of the machine
_MARKERS: dict[Link, str] = {"base": "DICT_4X4_50", "platform": "DICT_5X5_50"}
_DIGITS = 3  # decimals of a side in metres: whole millimetres


@dataclass(frozen=True, eq=False)
class BoardPrint:
    """A print: tiles of one size, each with black and white modules."""

    face: int  # the face of the plate that is printed, as the renderer counts them
    middle: Array  # (2,) the middle of the plate in the board frame [m]
    origin: Array  # (2,) where the first tile starts, in the board frame [m]
    pitch: float  # from tile to tile [m]
    # first, size: start of the modules in a tile, and their total length [m]
    first: float
    size: float
    # (rows, columns, n, n) black modules of each tile, by rows along y and columns along x
    modules: NDArray[np.bool_]
    # 0 or 1: tiles of this parity are black outside their modules; -1 for tags, with black squares
    # at the crossings of the gaps
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
        """Return the reflectance at points of the plate, in units of white."""
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
        points = np.flatnonzero(inside & (k >= 0) & (k < n) & (m >= 0) & (m < n))
        black[points] |= self.modules[j[points], i[points], m[points], k[points]]
        return np.where(black, np.float32(INK), np.float32(1.0))


def _modules(board: Board) -> NDArray[np.bool_]:
    """Return the black modules of every tile, (rows, columns, n, n)."""
    shape = board.rows, board.columns
    if board.kind == "chessboard":
        return np.zeros((*shape, 1, 1), dtype=np.bool_)
    if board.kind == "aprilgrid":
        tags = [
            # Kalibr's tags are upright where OpenCV's are upside down; rows go up.
            np.rot90(_marker(board.dictionary, k, TAG_BORDER), 2)[::-1]
            for k in range(board.columns * board.rows)
        ]
        return np.array(tags).reshape(*shape, *tags[0].shape)
    printed = charuco_board(board)
    modules = np.zeros((*shape, *_marker(board.dictionary, 0, 1).shape), dtype=np.bool_)
    for number, corners in zip(np.ravel(printed.getIds()), printed.getObjPoints(), strict=True):
        i, j = np.floor(np.mean(corners, axis=0)[:2] / board.side).astype(int)
        modules[j, i] = _marker(board.dictionary, int(number), 1)
    return modules


@lru_cache(maxsize=1024)
def _marker(name: str, number: int, border: int) -> NDArray[np.bool_]:
    """Return the black modules of a marker, (n, n), from its top left."""
    markers = dictionary(name)
    n = markers.markerSize + 2 * border
    picture = cv2.aruco.generateImageMarker(markers, number, n, borderBits=border)
    return np.asarray(np.asarray(picture) == 0, dtype=np.bool_)


@dataclass(frozen=True, eq=False)
class PlacedBoard:
    """A board in its place."""

    board: Board
    T_base_board: RigidTransform  # its pose in the base link
    first: int = 0  # the number of its first corner

    @cached_property
    def plate_size(self) -> tuple[float, float, float]:
        """Width, height and thickness of the plate [m]."""
        sides = self.board.extent.max(axis=0) - self.board.extent.min(axis=0)
        longer = float(sides.max())
        width, height, _ = (sides + 2.0 * _RIM * longer).tolist()
        return width, height, _THICKNESS * longer

    @cached_property
    def plate(self) -> PlacedSolid:
        """The plate that the board is printed on."""
        low, high = self.board.extent.min(axis=0), self.board.extent.max(axis=0)
        below = 0.5 * self.board.towards_viewer * self.plate_size[2]
        middle = 0.5 * (low + high) - [0.0, 0.0, below]
        T_board_plate = RigidTransform.from_translation(middle)
        face = 5 if self.board.towards_viewer > 0.0 else 2
        sheet = BoardPrint.of(self.board, face, middle[:2])
        material = Material(albedo=0.8, specular=0.0, shininess=10.0, limb=0.0, sheet=sheet)
        T = self.T_base_board * T_board_plate
        solid = Solid(None, Box(self.plate_size), T, material)
        return PlacedSolid(solid, T)

    def beside(self, posed: PosedMachine) -> PosedMachine:
        """Return a machine in a pose together with the plate."""
        mesh = triangles(self.plate.solid.shape)
        return replace(
            posed,
            solids=(*posed.solids, self.plate),
            boards=(*posed.boards, self),
            vertices=np.concatenate([posed.vertices, self.plate.T_base_solid.apply(mesh.vertices)]),
            faces=np.concatenate([posed.faces, mesh.faces + len(posed.vertices)]),
        )

    def runs_through(self, posed: PosedMachine) -> bool:
        """Return whether the plate intersects the machine, or something touches its print."""
        half = 0.5 * np.array(self.plate_size)
        for corner in ([-1.0, -1.0], [1.0, -1.0]):  # rays from two corners to the sides across
            for height in (-0.5, 0.5, 2.0):  # in the plate, and above its print
                steps = np.linspace(-1.0, 1.0, 13)
                far = np.concatenate(
                    [
                        np.column_stack([steps, np.ones(13)]),
                        np.column_stack([np.full(13, -corner[0]), steps]),
                    ]
                )
                plane = np.vstack([corner, far]) * half[:2]
                z = self.board.towards_viewer * height * half[2]
                points = self.plate.T_base_solid.apply(
                    np.column_stack([plane, np.full(len(plane), z)])
                )
                if posed.hidden(points[0], points[1:], np.zeros(len(far))).any():
                    return True
        return False

    def is_covered(self, posed: PosedMachine) -> bool:
        """Return whether a part of the machine is above the print, seen along its normal."""
        x, y, _ = self.board.extent.mean(axis=0).tolist()
        above = self.board.towards_viewer * 3.0 * max(self.plate_size)
        eye = self.T_base_board.apply([x, y, above])
        points = self.T_base_board.apply(self.board.points)
        return bool(posed.hidden(eye, points, np.zeros(len(points))).any())

    def seen(self, posed: PosedMachine, camera: Camera, T_base_camera: RigidTransform) -> BoolArray:
        """Return a mask (n_corners,) of the corners that are visible in an image."""
        points = self._watched
        base = self.T_base_board.apply(points.reshape(-1, 3))
        centre = T_base_camera.translation
        eye = self.T_base_board.inv().apply(centre)
        sight = eye - points
        cosine = self.board.towards_viewer * sight[..., 2] / np.linalg.norm(sight, axis=-1)
        inside = in_picture(camera, T_base_camera.inv().apply(base), NEAREST, BORDER_PX)
        free = (inside & (cosine.ravel() > _MIN_COSINE)).copy()
        margin = np.full(int(free.sum()), _IN_FRONT * self.plate_size[2])
        if free.any():
            free[free] = ~posed.hidden(centre, base[free], margin)
        is_seen = np.all(free.reshape(points.shape[:2]), axis=1)
        if self.board.kind == "chessboard" and not is_seen.all():
            is_seen[:] = False  # the numbers of a part are not certain
        return np.asarray(is_seen)

    def is_enough(self, is_seen: BoolArray) -> bool:
        """Return whether the corners of a mask of :meth:`seen` suffice to place a camera."""
        return int(is_seen.sum()) >= max(_MIN_SHARE * len(is_seen), min(_MIN_CORNERS, len(is_seen)))

    @cached_property
    def _watched(self) -> Array:
        """Points (n_corners, 5, 3) in the board frame that must be seen: corners and around."""
        step = _BESIDE * self.board.side
        aside = step * np.array([[0, 0, 0], [1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]])
        return np.asarray(self.board.points[:, None] + aside)


def placed_at(fixed: FixedBoard, T_base_platform: RigidTransform) -> PlacedBoard:
    """Return a board on a link in its place at a pose of the platform."""
    T = RigidTransform.identity() if fixed.T_link_board is None else fixed.T_link_board
    T_base_board = T if fixed.link == "base" else T_base_platform * T
    return PlacedBoard(fixed.board, T_base_board, fixed.first)


def documents(boards: Sequence[FixedBoard], *, poses: bool) -> Any:
    """Return the block of ``dataset.yaml`` with boards; None without boards."""
    blocks = [
        board_document(fixed.board)
        | ({} if fixed.link == "base" else {"on": fixed.link})
        | (
            {f"T_{fixed.link}_board": motion_to_xyz_quat(fixed.T_link_board)}
            if poses and fixed.T_link_board is not None
            else {}
        )
        for fixed in boards
    ]
    return blocks[0] if len(blocks) == 1 else blocks or None


def chosen_board(
    choice: Board | str | Path | None, posed_machines: Sequence[PosedMachine], link: Link = "base"
) -> Board | None:
    """Return the board on a link according to settings; boards of two links look different."""
    if choice is None or isinstance(choice, Board):
        return choice
    if choice not in KINDS:
        return read_board_file(Path(choice))
    joints = np.concatenate([part for m in posed_machines for part in (m.A, m.B)])
    on_base = link == "base"
    part = _WIDTH if on_base else _PLATFORM_WIDTH
    width = part * float(np.linalg.norm(np.ptp(joints, axis=0)))
    if choice == "aprilgrid":
        side = max(round(width / 5.3, _DIGITS), 0.001)
        return Board(choice, 4, 3, side, spacing=0.3, dictionary=APRIL_TAGS)
    if choice == "charuco":
        side = max(round(width / 7.0, _DIGITS), 0.002)
        marker = round(0.72 * side, _DIGITS)
        return Board("charuco", 7, 5, side, marker=marker, dictionary=_MARKERS[link])
    counts = (9, 6) if on_base else (8, 5)
    return Board("chessboard", *counts, max(round(width / counts[0], _DIGITS), 0.001))
