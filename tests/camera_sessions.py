"""A board before cameras of all models: its corners with noise, and photographs of it."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from boards import before
from rendering import photograph
from scipy.spatial import KDTree
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array
from legcal.perception.board_adjustment import BoardImages, Sheet
from legcal.simulation.board import PlacedBoard
from legcal.simulation.rendering.appearance import Appearance
from legcal.vision.board import Board
from legcal.vision.camera import Camera
from legcal.vision.image_file import ImageSize

SIZE = ImageSize(640, 480)
BOARD = Board("chessboard", 9, 6, 0.03)
NOISE_PX = 0.03
_K = np.array([[560.0, 0.0, 312.4], [0.0, 563.0, 244.9], [0.0, 0.0, 1.0]])
_WIDE = np.array([[260.0, 0.0, 318.0], [0.0, 261.0, 237.5], [0.0, 0.0, 1.0]])
PINHOLE = Camera(np.diag([0.7, 0.7, 1.0]) @ _K, 448, 336, np.zeros(5))
CAMERAS = {
    "plumb_bob": Camera(_K, 640, 480, np.array([-0.25, 0.1, 1e-3, -5e-4, -0.02])),
    "rational_polynomial": Camera(
        _K,
        640,
        480,
        np.array([0.4, -0.2, 1e-3, -5e-4, 0.05, 0.6, -0.1, 0.02]),
        "rational_polynomial",
    ),
    "equidistant": Camera(_WIDE, 640, 480, np.array([0.03, -0.01, 0.004, -0.001]), "equidistant"),
}


def with_noise(
    image: list[Array],
    points: list[Array],
    px: list[Array],
    noise: float,
    rng: np.random.Generator,
) -> BoardImages:
    """Return the corners of images, each list one entry an image, with noise [px]."""
    exact = np.concatenate(px)
    return BoardImages(
        np.concatenate(image).astype(np.intp),
        np.concatenate(points),
        exact + noise * rng.standard_normal(exact.shape),
        np.full(len(exact), noise),
    )


def seen_corners(
    camera: Camera,
    n_images: int,
    seed: int,
    *,
    tilt: float = 0.6,
    lean: float = 0.0,
    roll: float = 0.6,
    noise: float = NOISE_PX,
    sheet: Array | None = None,
    smooth: float = 0.0,
) -> BoardImages:
    """Return the corners of a board in random places, all over the image.

    All boards lean alike by an angle about x [rad], apart from their own tilt and roll.

    The board is bent and printed as the numbers of a sheet say; errors that neighbouring corners of
    an image share have a standard deviation *smooth* [px].
    """
    rng = np.random.default_rng(seed)
    middle = RigidTransform.from_translation(-BOARD.points.mean(axis=0))
    real = BOARD.points
    if sheet is not None:
        real = replace(Sheet.flat(real), numbers=sheet).placed(real)[0]
    apart = np.linalg.norm(BOARD.points[:, None] - BOARD.points, axis=-1)
    shared = np.exp(-0.5 * (apart / 0.05) ** 2) + 1e-9 * np.eye(len(apart))
    root = smooth * np.linalg.cholesky(shared)
    size = np.array([camera.width, camera.height])
    near, far = (0.10, 0.22) if camera.model == "equidistant" else (0.22, 0.5)
    image: list[Array] = []
    points, px = [], []
    while len(image) < n_images:
        xy = camera.undistort(rng.uniform(0.15 * size, 0.85 * size))
        turn = Rotation.from_euler("xyz", [*rng.uniform(-tilt, tilt, 2), rng.uniform(-roll, roll)])
        turn = Rotation.from_euler("x", lean) * turn
        T = RigidTransform.from_components(rng.uniform(near, far) * np.array([*xy, 1.0]), turn)
        P = (T * middle).apply(real)
        if P[:, 2].min() < 0.03:
            continue
        at = camera.project(P)
        inside = np.all((at > 4.0) & (at < size - 5.0), axis=1)
        if np.count_nonzero(inside) < 24:
            continue
        image.append(np.full(np.count_nonzero(inside), len(image)))
        points.append(BOARD.points[inside])
        error = root @ rng.standard_normal(at.shape) if smooth else np.zeros(at.shape)
        px.append((at + error)[inside])
    return with_noise(image, points, px, noise, rng)


def drawings(
    folder: Path, camera: Camera, n_images: int, board: Board = BOARD, distance: float = 0.42
) -> list[Path]:
    """Write pictures of a chessboard or circles, drawn without a scene; return their paths.

    Circles are on a bright sheet on a dark table. Quick for a camera without distortion.
    """
    rng = np.random.default_rng(4)
    n = 3  # samples of a pixel, each way
    v, u = np.mgrid[0 : camera.height * n, 0 : camera.width * n]
    xy = camera.undistort((np.stack([u, v], axis=-1) + 0.5) / n - 0.5)
    rays = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=-1).astype(np.float32)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for k in range(n_images):
        turn = np.array([0.5 * np.cos(2.4 * k), 0.5 * np.sin(2.4 * k), rng.uniform(-0.3, 0.3)])
        T = before(board, distance, turn)
        normal = T.rotation.as_matrix()[2]
        direction = rays @ T.rotation.as_matrix().T.astype(np.float32)
        hit = T.translation - direction * (T.translation[2] / (rays @ normal))[..., None]
        if board.has_circles:
            xy, margin = board.points[:, :2], board.marker
            on_sheet = (hit[..., :2] > xy.min(0) - margin) & (hit[..., :2] < xy.max(0) + margin)
            black = (KDTree(xy).query(hit[..., :2])[0] < 0.5 * margin) | ~on_sheet.all(-1)
        else:
            i, j = (np.floor(hit[..., a] / board.side).astype(np.intp) for a in (0, 1))
            on_board = (i >= -1) & (i < board.columns - 1) & (j >= -1) & (j < board.rows - 1)
            black = on_board & ((i + j) % 2 == 0)
        levels = np.where(black, 30.0, 190.0).astype(np.float32)
        fine = np.asarray(cv2.GaussianBlur(levels, (0, 0), 0.6 * n))
        image = fine.reshape(camera.height, n, camera.width, n).mean(axis=(1, 3))
        image += rng.normal(0.0, 1.5, image.shape)
        paths.append(folder / f"b{k:02d}.png")
        assert cv2.imwrite(str(paths[-1]), np.clip(np.rint(image), 0, 255).astype(np.uint8))
    return paths


def photographs(
    folder: Path, camera: Camera, n_images: int, *, board: Board = BOARD, seed: int = 0
) -> list[Path]:
    """Write photographs of a board from all sides; return their paths."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    plate = PlacedBoard(board, RigidTransform.identity()).plate
    looks = Appearance.clean(
        blur=0.6, gamma=1.0, electrons=15_000.0, read_noise=8.0, bits=8, samples=21
    )
    paths = []
    for k in range(n_images):
        turn = np.array([0.5 * np.cos(2.4 * k), 0.5 * np.sin(2.4 * k), rng.uniform(-0.3, 0.3)])
        distance = rng.uniform(0.36, 0.44) * (0.55 if camera.model == "equidistant" else 1.0)
        aside = RigidTransform.from_translation([*rng.uniform(-0.03, 0.03, 2), 0.0])
        image = photograph([plate], camera, before(board, distance, turn) * aside, looks, rng)
        paths.append(folder / f"b{k:02d}.png")
        assert cv2.imwrite(str(paths[-1]), np.asarray(image))
    return paths


def together(*sets: BoardImages) -> BoardImages:
    """Return the images of several sets as one."""
    first = np.cumsum([0, *(int(part.image[-1]) + 1 for part in sets)])
    image = [part.image + start for part, start in zip(sets, first, strict=False)]
    points, px, sigma_px = (
        np.concatenate([getattr(part, name) for part in sets])
        for name in ("points", "px", "sigma_px")
    )
    return BoardImages(np.concatenate(image), points, px, sigma_px)
