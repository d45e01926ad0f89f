"""Adjustments of a camera and a board to corners: from scratch, and from a nearby adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.perception.board_adjustment import (
    AdjustedBoard,
    BoardImages,
    Sheet,
    adjust_board,
    plane_poses,
)
from legcal.vision.camera import DISTORTION_MODELS, Camera, intrinsic_names, splined
from legcal.vision.distortion import DistortionModel
from legcal.vision.image_file import ImageSize, quiet_opencv

_FOCAL_LENGTHS = (0.25, 4.0, 13)  # smallest and largest, relative to the longer side; number
_MAX_ANGLE = 1.45  # [rad] to the axis of a fisheye lens
_ROUGH, _ROUGH_ITERATIONS = ("fx", "fy", "k1"), 12  # estimated first


def from_scratch(
    corners: BoardImages, size: ImageSize, model: DistortionModel
) -> AdjustedBoard | None:
    """Return the adjustment without a start; None if no start or adjustment succeeds.

    A splined lens starts as an equidistant one with k1.
    """
    wanted, model = model, "equidistant" if model == "splined_radial" else model
    start = None if DISTORTION_MODELS[model].is_fisheye else _by_opencv(corners, size, model)
    start = start or _by_straight_lines(corners, size, model)
    if start is None:
        return None
    rough = adjust_board(*start, corners, _ROUGH, max_iterations=_ROUGH_ITERATIONS)
    if rough is None:
        return None
    camera = rough.camera if wanted == model else splined(rough.camera)
    return _all_adjusted(camera, rough.T_camera_board, Sheet.flat(corners.points), corners)


def _all_adjusted(
    camera: Camera, poses: Sequence[RigidTransform], sheet: Sheet, corners: BoardImages
) -> AdjustedBoard | None:
    return adjust_board(camera, poses, corners, intrinsic_names(camera), sheet)


def readjust(
    near: AdjustedBoard, poses: Sequence[RigidTransform], corners: BoardImages
) -> AdjustedBoard | None:
    """Return the adjustment to other corners from a nearby one."""
    sheet = near.sheet or Sheet.flat(corners.points)
    return _all_adjusted(near.camera, poses, sheet, corners)


def _by_straight_lines(
    corners: BoardImages, size: ImageSize, model: DistortionModel
) -> tuple[Camera, list[RigidTransform]] | None:
    """Return the distortion-free camera and poses with the flattest boards, by grid search."""
    no_distortion = np.zeros(len(DISTORTION_MODELS[model].coefficients))
    cameras = []
    for part in np.geomspace(*_FOCAL_LENGTHS).tolist():
        K = _matrix(part, size)
        cameras.append(Camera(K, size.width, size.height, no_distortion, model))
    best = min(cameras, key=lambda camera: _non_flatness(camera, corners))
    poses = []
    for a, b in pairwise(_bounds(corners)):
        candidates = plane_poses(best, corners.points[a:b], corners.px[a:b], np.ones(b - a))
        if not candidates:
            return None
        poses.append(candidates[0].T_camera_plane)
    return best, poses


def _matrix(part: float, size: ImageSize) -> Array:
    """Return a camera matrix (3, 3) with a focal length relative to the longer side."""
    f = part * max(size.width, size.height)
    u, v = 0.5 * (size.width - 1.0), 0.5 * (size.height - 1.0)
    return np.array([[f, 0.0, u], [0.0, f, v], [0.0, 0.0, 1.0]])


def _non_flatness(camera: Camera, corners: BoardImages) -> float:
    """Return the rms residual of the corners from the best homography of each board [px]."""
    angle = np.linalg.norm(corners.px - camera.K[:2, 2], axis=1) / camera.K[0, 0]
    if DISTORTION_MODELS[camera.model].is_fisheye and angle.max() > _MAX_ANGLE:
        return np.inf
    xy = camera.undistort(corners.px)
    residuals = []
    for a, b in pairwise(_bounds(corners)):
        board = corners.points[a:b, :2]
        H, _ = cv2.findHomography(board, xy[a:b])
        if H is None:
            return np.inf
        flat = np.column_stack([board, np.ones(b - a)]) @ np.asarray(H, dtype=np.float64).T
        residuals.append(camera.distort(flat[:, :2] / flat[:, 2:]) - corners.px[a:b])
    return float(np.sqrt(np.mean(np.concatenate(residuals) ** 2)))


def _bounds(corners: BoardImages) -> IntArray:
    """Return the index of the first corner of each image, and the number of corners."""
    return np.searchsorted(corners.image, np.arange(corners.image[-1] + 2))


def _by_opencv(
    corners: BoardImages, size: ImageSize, model: DistortionModel
) -> tuple[Camera, list[RigidTransform]] | None:
    """Return OpenCV's calibration with two coefficients of distortion.

    OpenCV's own start fails for boards with similar tilts, so a usual focal length is tried as
    well; the answer with the smaller residuals is taken.
    """
    pieces = list(pairwise(_bounds(corners)))
    points = [corners.points[a:b].astype(np.float32) for a, b in pieces]
    px = [corners.px[a:b].astype(np.float32) for a, b in pieces]
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    answers = []
    for guess in (0, cv2.CALIB_USE_INTRINSIC_GUESS):
        with suppress(cv2.error), quiet_opencv():
            answers.append(
                cv2.calibrateCamera(
                    points,
                    px,
                    (size.width, size.height),
                    _matrix(1.0, size),
                    np.zeros(5),
                    flags=flags | guess,
                )
            )
    answers = [answer for answer in answers if np.isfinite(answer[0])]
    if not answers:
        return None
    _, K, distortion, turns, shifts = min(answers, key=lambda answer: float(answer[0]))
    numbers = np.concatenate([np.ravel(K), np.ravel(distortion), np.ravel(turns), np.ravel(shifts)])
    if not np.all(np.isfinite(numbers)) or min(K[0, 0], K[1, 1]) < 1.0:
        return None
    coefficients = np.zeros(len(DISTORTION_MODELS[model].coefficients))
    coefficients[:2] = np.ravel(distortion)[:2]
    poses = [
        RigidTransform.from_components(np.ravel(t), Rotation.from_rotvec(np.ravel(w)))
        for w, t in zip(turns, shifts, strict=True)
    ]
    return Camera(np.asarray(K), size.width, size.height, coefficients, model), poses


def part_of(
    corners: BoardImages, is_kept: BoolArray, n_images: int
) -> tuple[BoardImages, tuple[int, ...]]:
    """Return a subset of the corners with renumbered images, and their original numbers."""
    images = sorted(set(corners.image[is_kept].tolist()))
    new = np.full(n_images, -1, dtype=np.intp)
    new[images] = np.arange(len(images))
    part = BoardImages(
        new[corners.image[is_kept]],
        corners.points[is_kept],
        corners.px[is_kept],
        corners.sigma_px[is_kept],
        corners.radius,
    )
    return part, tuple(images)
