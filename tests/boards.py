"""Calibration boards, and small pictures of them, for tests."""

from functools import cache

import numpy as np
from rendering import photograph
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array, Image
from legcal.simulation.board import PlacedBoard
from legcal.simulation.rendering.appearance import Appearance
from legcal.simulation.solids import Box, Material, PlacedSolid, Solid
from legcal.vision.board import APRIL_TAGS, Board
from legcal.vision.camera import Camera

CHESSBOARD = Board("chessboard", 7, 6, 0.03)
CHARUCO = Board("charuco", 6, 4, 0.04, marker=0.029, dictionary="DICT_4X4_50")
APRILGRID = Board("aprilgrid", 3, 2, 0.06, spacing=0.3, dictionary=APRIL_TAGS)
BOARDS = (CHESSBOARD, CHARUCO, APRILGRID)
K = np.array([[620.0, 0.0, 231.3], [0.0, 615.0, 177.9], [0.0, 0.0, 1.0]])
LENS = Camera(K, 460, 350, np.array([-0.12, 0.05, 3e-4, -2e-4, 0.0]))


def before(board: Board, distance: float = 0.5, turn: Array | None = None) -> RigidTransform:
    """Return T_board_camera of a camera that looks at the middle of a board from its face."""
    middle = 0.5 * (board.extent[0] + board.extent[2])
    facing = Rotation.from_euler("x", np.pi if board.kind == "aprilgrid" else 0.0)
    slant = Rotation.from_rotvec(np.array([0.5, -0.35, 0.3]) if turn is None else turn)
    away = RigidTransform.from_components([0.0, 0.0, -distance], Rotation.identity())
    return RigidTransform.from_components(middle, facing * slant) * away


def picture(
    board: Board, T_board_camera: RigidTransform, *, hidden: Array | None = None, **looks: object
) -> Image:
    """Return a photograph of a board alone; a small dark box hides a point (3,) of it."""
    placed = [PlacedBoard(board, RigidTransform.identity()).plate]
    if hidden is not None:
        T = RigidTransform.from_translation(hidden)
        box = Solid(None, Box((0.02, 0.02, 0.02)), T, Material(albedo=0.2))
        placed.append(PlacedSolid(box, T))
    how = {
        "blur": 0.5,
        "gamma": 2.2,
        "electrons": 12_000.0,
        "read_noise": 12.0,
        "bits": 8,
        "samples": 34,
    }
    appearance = Appearance.clean(**{**how, **looks})
    image = photograph(placed, LENS, T_board_camera, appearance, np.random.default_rng(1))
    return np.asarray(image, dtype=np.float32) / (257.0 if image.dtype == np.uint16 else 1.0)


@cache
def plain_picture(kind: str) -> tuple[Board, RigidTransform, Image]:
    """Return a board, T_board_camera and its picture, drawn once."""
    board = next(b for b in BOARDS if b.kind == kind)
    T = before(board)
    return board, T, picture(board, T)


def seen_at(board: Board, T_board_camera: RigidTransform, camera: Camera = LENS) -> Array:
    """Return where the corners of a board are seen, (n_corners, 2) [px]."""
    return camera.project(T_board_camera.inv().apply(board.points))
