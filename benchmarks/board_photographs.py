"""Photographs of calibration boards, as print, light and camera really make them.

    python benchmarks/board_photographs.py FOLDER [--kind phone] [--images 15] [--warp 2]
        [--scale 1.002 1] [--sharpen 1.5] [--jpeg 60] [--gamma 2.2] [--seed 0]

writes photographs of a chessboard of 10 x 7 squares of 25 mm into FOLDER; ``legcal camera FOLDER
--board chessboard:10x7:25mm -o camera.yaml`` calibrates the camera from them. Other benchmarks
import :func:`photograph_boards`. The board may be bent (a paraboloid), printed in another scale
along x and y; the camera is one of those that machines are photographed with, its sharpening and
the quality of its JPEG files can be changed. Each pixel that an edge may cross averages 55 rays.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array
from legcal.simulation.board import BoardPrint
from legcal.simulation.cameras import mild_lens
from legcal.simulation.rendering.appearance import CAMERAS, Appearance, CameraPipeline
from legcal.vision.board import Board
from legcal.vision.camera import Camera

CHESSBOARD = Board("chessboard", 10, 7, 0.025)
N_RAYS, _STEP = 55, 34  # of a pixel that an edge may cross: a Fibonacci lattice
PAPER, BEHIND = 0.75, 0.12  # radiance of white paper and of what is behind it; 1 is full scale
_FALL = 0.15  # part of the light that is lost from one end of the board to the other
_RIM = 0.06  # of the longer side that stays white around the print
_MARGIN = 6.0  # [px] of corners from the border of the image
_TILTS = np.radians([12.0, 40.0])
_BENDS = 6  # steps from where a ray meets the plane to where it meets the bent board


@dataclass(frozen=True)
class PrintedBoard:
    """A board as it really is.

    Attributes
    ----------
    board : Board
        What it is meant to be.
    warp : float
        How far its corners stand out towards the camera before its middle: a paraboloid [m].
    scale : tuple of float
        How much larger it is printed along x and y.
    """

    board: Board = CHESSBOARD
    warp: float = 0.0
    scale: tuple[float, float] = (1.0, 1.0)

    @property
    def facing(self) -> Rotation:
        """Orientation in the board frame of a camera that looks straight at the print."""
        return Rotation.from_euler("x", np.pi if self.board.kind == "aprilgrid" else 0.0)

    @property
    def middle(self) -> Array:
        """The middle of the print in the board frame, (3,) [m]."""
        middle = 0.5 * (self.board.extent[0] + self.board.extent[2])
        return np.asarray(middle * np.array([*self.scale, 1.0]))

    @property
    def half(self) -> Array:
        """Half of the width and the height of the print, (2,) [m]."""
        return np.asarray(0.5 * np.ptp(self.board.extent[:, :2], axis=0) * self.scale)

    def height(self, x: Array, y: Array) -> Array:
        """Return z in the board frame of points of the bent board [m]."""
        outwards = -self.facing.as_matrix()[2, 2]
        r2 = (x - self.middle[0]) ** 2 + (y - self.middle[1]) ** 2
        return np.asarray(outwards * self.warp * r2 / float(self.half @ self.half))

    def corners(self) -> Array:
        """Return where the corners really are, (n_corners, 3) in the board frame [m]."""
        points: Array = self.board.points * np.array([*self.scale, 1.0])
        points[:, 2] = self.height(points[:, 0], points[:, 1])
        return points

    def radiance(self, eye: Array, rays: Array) -> Array:
        """Return the light of rays (n, 3) from a point, both in the board frame."""
        far = (self.middle[2] - eye[2]) / rays[:, 2]
        for _ in range(_BENDS if self.warp else 0):
            x, y = (eye[k] + far * rays[:, k] for k in range(2))
            far = (self.height(x, y) - eye[2]) / rays[:, 2]
        x, y = (eye[k] + far * rays[:, k] for k in range(2))
        ink = BoardPrint.of(self.board, 2, np.zeros(2)).reflectance(
            x / self.scale[0], y / self.scale[1]
        )
        across, down = (x - self.middle[0]) / self.half[0], (y - self.middle[1]) / self.half[1]
        rim = 1.0 + 2.0 * _RIM * self.half.max() / self.half
        on_board = (np.abs(across) < rim[0]) & (np.abs(down) < rim[1]) & (far > 0.0)
        light = PAPER * (1.0 - 0.25 * _FALL * (2.0 + across + down))
        return np.asarray(np.where(on_board, ink * light, BEHIND))


def photograph_board(
    printed: PrintedBoard,
    camera: Camera,
    T_board_camera: RigidTransform,
    appearance: Appearance,
    rng: np.random.Generator,
    pipeline: CameraPipeline | None = None,
) -> bytes:
    """Return the file of a photograph of a board.

    Exposure, blur, gamma and noise are those of the appearance, and so is the camera unless another
    pipeline is given.
    """
    pipeline = appearance.pipeline if pipeline is None else pipeline
    xy, by_row, by_column = _directions(camera)
    eye, turn = T_board_camera.translation, T_board_camera.rotation

    def light_of(directions: Array) -> Array:
        rays = turn.apply(np.column_stack([directions, np.ones(len(directions))]))
        return printed.radiance(eye, rays)

    light = light_of(xy.reshape(-1, 2)).reshape(xy.shape[:2]).astype(np.float32)
    cross = cv2.getStructuringElement(cv2.MORPH_RECT, (3, 3))
    edge = np.flatnonzero(cv2.dilate(light, cross) - cv2.erode(light, cross) > 0.05)
    total = np.zeros(len(edge))
    centre, along, down = (part.reshape(-1, 2)[edge] for part in (xy, by_column, by_row))
    for k in range(N_RAYS):
        u, v = (k + 0.5) / N_RAYS - 0.5, (k * _STEP % N_RAYS + 0.5) / N_RAYS - 0.5
        total += light_of(centre + u * along + v * down)
    light.flat[edge] = total / N_RAYS
    if pipeline.colour:
        light = np.repeat(light[..., None], 3, axis=-1)
    light = pipeline.through_lens(light * np.float32(appearance.exposure), appearance.blur)
    counts = pipeline.counted(light, appearance.electrons, appearance.read_noise, rng)
    level = pipeline.processed(counts, appearance.gamma)
    return pipeline.file(np.rint(255.0 * level).astype(np.uint8))


@lru_cache(maxsize=1)
def _directions(camera: Camera) -> tuple[Array, Array, Array]:
    """Return the undistorted points of all pixels, and how they change by row and by column."""
    grid = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.stack(grid, axis=-1).astype(np.float64)
    xy = camera.undistort(pixels.reshape(-1, 2)).reshape(pixels.shape)
    by_row, by_column = np.gradient(xy, axis=(0, 1))
    return xy, by_row, by_column


def board_poses(
    printed: PrintedBoard, camera: Camera, n: int, rng: np.random.Generator
) -> list[RigidTransform]:
    """Return T_board_camera of n tilted views that show all corners, in all parts of the image."""
    corners, poses = printed.corners(), []
    frame = np.array([camera.width, camera.height], dtype=np.float64)
    for k in range(n):
        azimuth = 2.0 * np.pi * (k * 0.618 + 0.1 * rng.random())
        tilt = rng.uniform(*_TILTS)
        axis = tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        turn = (
            printed.facing
            * Rotation.from_rotvec(axis)
            * Rotation.from_euler("z", rng.normal(0.0, 0.2))
        )
        place = rng.uniform(0.2, 0.8, 2)  # of the middle of the board in the image
        distance = float(
            2.0 * np.hypot(*printed.half) * camera.K[0, 0] / frame[1] / rng.uniform(0.8, 1.2)
        )
        while True:
            sight = np.append(camera.undistort((place * frame)[None])[0], 1.0)
            eye = printed.middle - turn.apply(distance * sight)
            T = RigidTransform.from_components(eye, turn)
            seen = camera.project(T.inv().apply(corners))
            if np.all((seen > _MARGIN) & (seen < frame - 1.0 - _MARGIN)):
                break
            place, distance = 0.5 + 0.95 * (place - 0.5), 1.02 * distance
        poses.append(T)
    return poses


def photograph_boards(
    folder: Path,
    printed: PrintedBoard,
    camera: Camera,
    appearance: Appearance,
    n: int,
    seed: int,
    pipeline: CameraPipeline | None = None,
) -> Sequence[Path]:
    """Write n photographs of a board into a folder, and return their paths."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    pipeline = appearance.pipeline if pipeline is None else pipeline
    paths = []
    for k, T in enumerate(board_poses(printed, camera, n, rng)):
        paths.append(folder / f"board{k + 1:02d}{pipeline.suffix}")
        content = photograph_board(printed, camera, T, appearance, rng, pipeline)
        paths[-1].write_bytes(content)
    return paths


def main() -> None:
    """Write photographs of a board."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kind", choices=CAMERAS, default="industrial")
    parser.add_argument("--images", type=int, default=15, help="15")
    parser.add_argument("--warp", type=float, default=0.0, help="height of the corners [mm]; 0")
    parser.add_argument("--scale", type=float, nargs=2, default=(1.0, 1.0), help="of x and y; 1 1")
    parser.add_argument("--sharpen", type=float, help="strength; that of the camera")
    parser.add_argument("--jpeg", type=int, help="quality, 0 for PNG; that of the camera")
    parser.add_argument("--gamma", type=float, default=2.2, help="2.2")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    changes = {name: getattr(options, name) for name in ("sharpen", "jpeg")}
    pipeline = replace(
        CAMERAS[options.kind], **{name: x for name, x in changes.items() if x is not None}
    )
    look = Appearance(camera=options.kind, colour=pipeline.colour, gamma=options.gamma)
    printed = PrintedBoard(CHESSBOARD, 1e-3 * options.warp, tuple(options.scale))
    photograph_boards(
        options.folder, printed, mild_lens(), look, options.images, options.seed, pipeline
    )


if __name__ == "__main__":
    main()
