"""Corners of boards in photographs as cameras make them: how many are found, how far off, how fast.

    python benchmarks/board_corners.py [--images 4] [--boards chessboard,...] [--cameras webcam,...]
        [--conditions plain,...] [--size 1280x800]

For each board, camera and condition a line: photographs whose board (a half of its visible corners)
is found, and found by OpenCV: the sector-based finder (the whole of a chessboard), or ArucoDetector
with its settings (a half of the corners of markers, at whole pixels); the share of the visible
corners; root mean square of their errors in a coordinate, of all and of all but the worst hundredth
[px]; that of the errors as parts of their standard deviations; that of OpenCV's sector-based
finder, and of ours in the boards that it finds [px]; milliseconds of the processor for an image,
those of OpenCV, and their ratio.
"""

import argparse
import time
from dataclasses import dataclass

import cv2
import numpy as np
from board_photographs import CHESSBOARD, PrintedBoard, board_poses, photograph_board
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.perception.board_corners import NumberedCorners, search_board
from legcal.simulation.rendering.appearance import Appearance
from legcal.vision.board import APRIL_TAGS, Board, dictionary
from legcal.vision.camera import Camera

BOARDS = {
    "chessboard": CHESSBOARD,
    "charuco": Board("charuco", 9, 6, 0.03, marker=0.022, dictionary="DICT_5X5_100"),
    "aprilgrid": Board("aprilgrid", 6, 5, 0.04, spacing=0.3, dictionary=APRIL_TAGS),
}
CONDITIONS = ("plain", "blurred", "dark", "hand", "border")
KINDS = ("industrial", "webcam", "phone", "action")
_HALF = 0.5  # of the visible corners that make a found board
_MARGIN = 6.0  # [px] from the border of the image within which corners do not count
_HAND = np.array([0.16, 0.07])  # half axes, of the diagonal of the board
_BESIDE = 0.25  # of a square or tag from a hand within which corners do not count


@dataclass(frozen=True)
class HeldBoard(PrintedBoard):
    """A board with a hand (an ellipse) before a part of it: its middle [m] and its angle [rad]."""

    hand: tuple[float, float] = (0.0, 0.0)
    angle: float = 0.0

    def behind(self, x: Array, y: Array, beside: float = 0.0) -> BoolArray:
        """Say which points of the board the hand hides, or are so near to it [m]."""
        size = _HAND * 2.0 * float(np.hypot(*self.half)) + beside
        c, s = np.cos(self.angle), np.sin(self.angle)
        a, b = x - self.hand[0], y - self.hand[1]
        out = ((c * a + s * b) / size[0]) ** 2 + ((c * b - s * a) / size[1]) ** 2
        return np.asarray(out < 1.0)

    def radiance(self, eye: Array, rays: Array) -> Array:
        """Return the light of rays (n, 3) from a point, both in the board frame."""
        far = (self.middle[2] - eye[2]) / rays[:, 2]
        hidden = self.behind(eye[0] + far * rays[:, 0], eye[1] + far * rays[:, 1])
        return np.where(hidden & (far > 0.0), 0.3, super().radiance(eye, rays))


@dataclass(frozen=True, eq=False)
class Shot:
    """A photograph and the truth."""

    grey: Array  # (height, width) grey levels
    px: Array  # (n_corners, 2) where the corners are
    visible: BoolArray  # (n_corners,) whether they are in the image, with nothing before them


def camera_of(width: int, height: int) -> Camera:
    """Return a camera whose lens distorts."""
    f = 0.85 * width
    K = np.array([[f, 0.0, 0.49 * width], [0.0, f, 0.51 * height], [0.0, 0.0, 1.0]])
    return Camera(K, width, height, np.array([-0.22, 0.08, 4e-4, -3e-4, 0.0]))


def shots(
    board: Board, camera: Camera, kind: str, condition: str, n: int, rng: np.random.Generator
) -> list[Shot]:
    """Photograph a board n times."""
    looks = Appearance(
        camera=kind,
        blur=2.2 if condition == "blurred" else 0.6,
        exposure=0.15 if condition == "dark" else 1.0,
        electrons=3_000.0 if condition == "dark" else 9_000.0,
        colour=kind != "industrial",
    )
    frame = np.array([camera.width, camera.height])
    found = []
    for T in board_poses(PrintedBoard(board), camera, n, rng):
        printed = PrintedBoard(board)
        pose, points = T, printed.corners()
        free = np.ones(len(points), dtype=np.bool_)
        if condition == "hand":
            x, y = points[rng.integers(len(points)), :2].tolist()
            held = HeldBoard(board, hand=(x, y), angle=float(rng.uniform(0.0, np.pi)))
            free = ~held.behind(points[:, 0], points[:, 1], _BESIDE * board.side)
            printed = held
        elif condition == "border":
            aside = rng.uniform(0.3, 0.5) * printed.half * rng.choice([-1.0, 1.0], 2)
            pose = RigidTransform.from_translation([*(1.4 * aside), 0.0]) * pose
        px = camera.project(pose.inv().apply(points))
        free &= np.all((px > _MARGIN) & (px < frame - 1.0 - _MARGIN), axis=1)
        file = photograph_board(printed, camera, pose, looks, rng)
        grey = cv2.imdecode(np.frombuffer(file, dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
        found.append(Shot(np.asarray(grey, dtype=np.float64), px, free))
    return found


def _line(board: Board, taken: list[Shot]) -> str:
    """Return the figures of one board, camera and condition."""
    n_found = n_theirs = n_seen = 0
    errors, pulls = list[Array](), list[Array]()
    both: tuple[list[Array], list[Array]] = [], []
    ours = theirs = 0.0
    how = cv2.aruco.DetectorParameters()
    how.markerBorderBits = 2 if board.kind == "aprilgrid" else 1
    if board.kind != "chessboard":
        detector = cv2.aruco.ArucoDetector(dictionary(board.dictionary), how)
    for shot in taken:
        start = time.process_time()
        seen = search_board(board, shot.grey).numbered(board)
        ours += time.process_time() - start
        numbers = _true_numbers(seen, shot)
        n_seen += int(shot.visible[numbers].sum())
        n_found += int(len(numbers) >= max(_HALF * shot.visible.sum(), 4))
        errors.append(seen.px - shot.px[numbers])
        pulls.append(errors[-1] / seen.sigma_px[:, None])
        start = time.process_time()
        image = np.asarray(shot.grey, dtype=np.uint8)
        if board.kind == "chessboard":
            flags = cv2.CALIB_CB_NORMALIZE_IMAGE
            is_there, px = cv2.findChessboardCornersSB(image, board.grid, flags=flags)
        else:
            tags = detector.detectMarkers(image)[0]
            is_there = 4 * len(tags) >= max(_HALF * shot.visible.sum(), 4)
        theirs += time.process_time() - start
        n_theirs += int(is_there)
        if is_there and board.kind == "chessboard":
            both[0].append(_from_nearest(np.asarray(px, dtype=np.float64)[:, 0], shot))
            both[1].append(errors[-1])
    n_visible = sum(int(shot.visible.sum()) for shot in taken)
    error, pull = np.concatenate(errors), np.concatenate(pulls)
    text = f"{n_found:5d} {n_theirs:5d} {n_seen / max(n_visible, 1):6.3f}"
    if len(error):
        square = np.sort(np.mean(error**2, axis=1))
        most = square[: max(int(0.99 * len(square)), 1)]
        text += f" {np.sqrt(square.mean()):6.3f} {np.sqrt(most.mean()):6.3f}"
        text += f" {np.sqrt(np.mean(pull**2)):5.2f}"
    for found in both:
        text += f" {np.sqrt(np.mean(np.concatenate(found) ** 2)):6.3f}" if found else "      -"
    text += f" {1e3 * ours / len(taken):5.0f} {1e3 * theirs / len(taken):5.0f}"
    return text + f" {ours / max(theirs, 1e-9):5.2f}"


def _from_nearest(px: Array, shot: Shot) -> Array:
    """Return how far corners (n, 2) are from the nearest true ones [px]."""
    apart = px[:, None] - shot.px
    nearest = np.argmin(np.linalg.norm(apart, axis=2), axis=1)
    return np.asarray(apart[np.arange(len(px)), nearest])


def _true_numbers(seen: NumberedCorners, shot: Shot) -> IntArray:
    """Return numbers as the truth has them: a part of a chessboard may lie anywhere on it."""
    if seen.certain or not len(seen.number):
        return seen.number
    gap = np.linalg.norm(seen.px[:, None] - shot.px[None], axis=2)
    return np.asarray(np.argmin(gap, axis=1), dtype=np.intp)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--images", type=int, default=4)
    parser.add_argument("--boards", default=",".join(BOARDS))
    parser.add_argument("--cameras", default=",".join(KINDS))
    parser.add_argument("--conditions", default=",".join(CONDITIONS))
    parser.add_argument("--size", default="1280x800")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    width, height = (int(side) for side in options.size.split("x"))
    camera = camera_of(width, height)
    columns = "found    CV  share    rms   99 %  pull SB rms   ours    ms CV ms ratio"
    print(f"board      camera     condition {columns}")
    for name in options.boards.split(","):
        for kind in options.cameras.split(","):
            for condition in options.conditions.split(","):
                rng = np.random.default_rng([KINDS.index(kind), CONDITIONS.index(condition)])
                taken = shots(BOARDS[name], camera, kind, condition, options.images, rng)
                line = _line(BOARDS[name], taken)
                print(f"{name:10} {kind:10} {condition:9}{line}", flush=True)


if __name__ == "__main__":
    main()
