"""From photographs of a board to a camera: corners searched, all of them adjusted, judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np

from legcal.camera_calibration.adjustment import SeenCorners
from legcal.camera_calibration.board_spec import board_of
from legcal.camera_calibration.files import CAMERA_FILE, write_camera
from legcal.camera_calibration.image_files import common_size, listed_images
from legcal.camera_calibration.judgement import (
    FEWEST_IMAGES,
    coverage,
    refuse_undetermined,
    tilts,
    too_few_images,
    warnings,
)
from legcal.camera_calibration.result import CameraCalibration, ImageResult
from legcal.camera_calibration.rounds import FEWEST, Agreed, agreed
from legcal.errors import DidNotConverge, NotVisible, UsageError
from legcal.geometry.types import Array, IntArray
from legcal.progress import Report, no_progress
from legcal.vision.board import Board
from legcal.vision.camera import Camera, DistortionModel
from legcal.vision.corner_search import find_corners
from legcal.vision.image_file import ImageSize, read_image
from legcal.vision.other_boards import described
from legcal.workers import Run, worker_pool

STAGE = "Searching the board"
_ASKED = 2  # images that are asked what they show instead
_Corners = tuple[IntArray, Array, Array]


def calibrate_camera(
    images: str | Path | Sequence[str | Path],
    board: str | Path | Board,
    *,
    model: DistortionModel = "plumb_bob",
    output: str | Path | None = None,
    progress: Report = no_progress,
    workers: int = 1,
) -> CameraCalibration:
    """Calibrate a camera from photographs of a flat board.

    Parameters
    ----------
    images : str, Path or sequence of these
        Files, folders or patterns.
    board : str, Path or Board
        Such as ``chessboard:9x6:25mm`` (squares), or a YAML file with the block ``board`` of a
        dataset. Its size does not matter here, its proportions do.
    model : {"plumb_bob", "rational_polynomial", "equidistant"}
        How the lens distorts.
    output : path, optional
        Write a ROS camera_info file there, with the standard deviations of all numbers.
    progress : callable
        Called as ``progress(stage, done, total)``.
    workers : int
        Search the images in that many processes, as :func:`legcal.calibrate` does.

    Returns
    -------
    CameraCalibration
        Look at its ``warnings`` before you use it.

    Raises
    ------
    DatasetError
        If images cannot be read, or are not of one size.
    UsageError
        If the board, the model or the output cannot be meant.
    NotVisible
        If no image shows the board.
    NotIdentifiable
        If fewer than three images show it, or all from one side.
    DidNotConverge
        If no camera explains the corners.
    """
    if model not in get_args(DistortionModel):
        raise UsageError(
            f"The camera could not be calibrated: found the model {model!r}, needed "
            f"{', '.join(get_args(DistortionModel))}; correct it."
        )
    if output is not None:
        CAMERA_FILE.check_place(Path(output))
    wanted = board_of(board)
    paths = listed_images([images] if isinstance(images, str | Path) else images)
    size = common_size(paths)
    with worker_pool(workers) as run:
        found = _search(wanted, paths, size, run, progress)
    shown = [k for k, (numbers, _, _) in enumerate(found) if len(numbers) >= FEWEST]
    if not shown:
        raise _nowhere(wanted, paths, size)
    if len(shown) < FEWEST_IMAGES:
        raise too_few_images(len(shown), [paths[k].name for k in shown])
    progress("Adjusting the camera", 0, 1)
    fitted = agreed(_seen(wanted, [found[k] for k in shown]), size, model)
    progress("Adjusting the camera", 1, 1)
    if fitted is None:
        raise DidNotConverge(
            f"The camera could not be calibrated: found no {model} camera that explains the "
            "corners, needed one; check the board and the model of the lens."
        )
    left_out = [f"{paths[shown[k]].name}: {why}" for k, why in fitted.left_out.items()]
    refuse_undetermined(fitted, [paths[shown[k]].name for k in fitted.images], left_out)
    result = _result(wanted, paths, found, shown, fitted)
    if output is not None:
        write_camera(result, Path(output))
    return result


@dataclass(frozen=True, eq=False)
class _Search:
    """The search of an image, for any process."""

    board: Board
    paths: tuple[Path, ...]
    size: ImageSize

    def __call__(self, k: int) -> _Corners:
        return find_corners(self.board, _read(self.paths[k], self.size))


def _read(path: Path, size: ImageSize) -> Array:
    """Return the grey levels of an image whose size is known."""
    return np.asarray(read_image(path, Camera(np.eye(3), size.width, size.height)))


def _search(
    board: Board, paths: Sequence[Path], size: ImageSize, run: Run, progress: Report
) -> list[_Corners]:
    """Return the corners in every image."""
    progress(STAGE, 0, len(paths))
    found = []
    for corners in run(_Search(board, tuple(paths), size), range(len(paths))):
        found.append(corners)
        progress(STAGE, len(found), len(paths))
    return found


def _seen(board: Board, found: Sequence[_Corners]) -> SeenCorners:
    """Return the corners of some images in one table."""
    counts = [len(numbers) for numbers, _, _ in found]
    return SeenCorners(
        np.repeat(np.arange(len(found)), counts),
        np.concatenate([board.points[numbers] for numbers, _, _ in found]),
        np.concatenate([px for _, px, _ in found]),
        np.concatenate([sigma for _, _, sigma in found]),
    )


def _nowhere(board: Board, paths: Sequence[Path], size: ImageSize) -> NotVisible:
    """Return the refusal of images without the board, and say what they show instead."""
    what = next((w for p in paths[:_ASKED] if (w := described(board, _read(p, size)))), None)
    thing = "tags" if board.kind == "aprilgrid" else "squares"
    hint = ""
    if what is None and board.kind == "chessboard":
        hint = f" (squares are counted: {board.columns - 1} x {board.rows - 1} inner corners)"
    return NotVisible(
        f"The camera could not be calibrated: found {what or 'nothing like the board'} in its "
        f"{len(paths)} image{'s' * (len(paths) != 1)}, needed a {board.kind} of {board.columns} x "
        f"{board.rows} {thing}{hint}; correct --board, or take sharper images of the whole board."
    )


def _result(
    board: Board,
    paths: Sequence[Path],
    found: Sequence[_Corners],
    shown: Sequence[int],
    fitted: Agreed,
) -> CameraCalibration:
    """Return the camera with what it rests on."""
    adjusted, seen = fitted.adjusted, fitted.seen
    used = {shown[k]: i for i, k in enumerate(fitted.images)}
    left_out = {shown[k]: why for k, why in fitted.left_out.items()}
    square = np.sum(adjusted.residual**2, axis=1)
    tilt = tilts(fitted)
    images = []
    for k, path in enumerate(paths):
        i = used.get(k)
        n = len(found[k][0])
        why = left_out.get(k, "" if k in shown else "the board was not found")
        if i is None:
            images.append(ImageResult(path.name, n, 0, None, None, why))
            continue
        here = seen.image == i
        rms = float(np.sqrt(np.mean(square[here])))
        n_used = int(np.count_nonzero(here))
        images.append(ImageResult(path.name, n, n_used, rms, float(tilt[i]), ""))
    n_dof = max(2 * len(square) - len(adjusted.covariance) - 6 * len(fitted.images), 1)
    return CameraCalibration(
        camera=adjusted.camera,
        covariance=adjusted.covariance * fitted.scale,
        board=board,
        images=tuple(images),
        rms_px=float(np.sqrt(np.mean(square))),
        noise_px=float(np.sqrt(square.sum() / n_dof)),
        coverage=coverage(fitted),
        warnings=(*_lost(images), *warnings(fitted)),
    )


def _lost(images: Sequence[ImageResult]) -> list[str]:
    """Return a sentence for each reason for which images were left out."""
    by_reason: dict[str, list[str]] = {}
    for image in images:
        if image.reason:
            by_reason.setdefault(image.reason, []).append(image.name)
    return [f"{', '.join(names)} left out: {why}." for why, names in by_reason.items()]
