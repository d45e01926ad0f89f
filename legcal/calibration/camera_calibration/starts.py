"""Adjustments of a camera and a board to corners: from scratch, and from a nearby adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.perception.board_adjustment import (
    AdjustedBoard,
    BoardImages,
    Sheet,
    adjust_board,
)
from legcal.vision.camera import DISTORTION_MODELS, Camera, intrinsic_names, splined
from legcal.vision.distortion import DistortionModel
from legcal.vision.image_file import ImageSize
from legcal.vision.point_pose import closed_form_poses

_FOCAL_LENGTHS = (0.25, 4.0, 13)  # smallest and largest, relative to the longer side; number
_MAX_ANGLE = 1.45  # [rad] to the axis of a fisheye lens
_SMALL_PX = 1e-3  # errors of a start that do not matter
_FAR_BETTER = 0.5  # residual of a pose, over that of the pose whose place it takes
_ROUGH, _ROUGH_ITERATIONS = ("fx", "fy", "k1", "k2"), 12  # estimated first


def from_scratch(
    corners: BoardImages, size: ImageSize, model: DistortionModel
) -> AdjustedBoard | None:
    """Return the adjustment without a start; None if no start or adjustment succeeds.

    A splined lens starts as an equidistant one. Of the two poses that show a plane almost alike
    the better one is chosen again when the distortion is known better.
    """
    wanted, model = model, "equidistant" if model == "splined_radial" else model
    start = _by_poses(corners, size, model)
    if start is None:
        return None
    rough = adjust_board(*start, corners, _ROUGH, max_iterations=_ROUGH_ITERATIONS)
    if rough is None:
        return None
    camera = rough.camera if wanted == model else splined(rough.camera)
    poses = _chosen_again(rough, corners)
    found = _all_adjusted(camera, poses, Sheet.flat(corners.points), corners)
    if found is None:
        return None
    poses = _chosen_again(found, corners)
    is_other = any(T is not before for T, before in zip(poses, found.T_camera_board, strict=True))
    again = readjust(found, poses, corners) if is_other else None
    return found if again is None else again


def _chosen_again(adjusted: AdjustedBoard, corners: BoardImages) -> list[RigidTransform]:
    """Return the poses of an adjustment, another one where that explains a board far better."""
    off = np.linalg.norm(adjusted.residual, axis=1)
    poses = []
    for (a, b), T in zip(pairwise(_bounds(corners)), adjusted.T_camera_board, strict=True):
        other_off, other = _pose(adjusted.camera, corners, a, b)
        if other is None or other_off > _FAR_BETTER * float(np.median(off[a:b])):
            other = T
        poses.append(other)
    return poses


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


def _by_poses(
    corners: BoardImages, size: ImageSize, model: DistortionModel
) -> tuple[Camera, list[RigidTransform]] | None:
    """Return the camera without distortion, and its poses, that explain the boards best.

    Focal lengths are tried one after the other; those of boards with similar tilts are found too.
    """
    none = np.zeros(len(DISTORTION_MODELS[model].coefficients))
    best: tuple[Camera, list[RigidTransform]] | None = None
    least = np.inf
    for part in np.geomspace(*_FOCAL_LENGTHS).tolist():
        camera = Camera(_matrix(part, size), size.width, size.height, none, model)
        angle = np.linalg.norm(corners.px - camera.K[:2, 2], axis=1) / camera.K[0, 0]
        if DISTORTION_MODELS[model].is_fisheye and angle.max() > _MAX_ANGLE:
            continue
        nearest = [_pose(camera, corners, a, b) for a, b in pairwise(_bounds(corners))]
        off = float(np.sum([np.log(off + _SMALL_PX) for off, _ in nearest]))
        if off < least:
            best, least = (camera, [T for _, T in nearest if T is not None]), off
    return best


def _pose(
    camera: Camera, corners: BoardImages, a: int, b: int
) -> tuple[float, RigidTransform | None]:
    """Return the pose of the board by corners a to b, and how far half of these are off [px]."""
    points, px = corners.points[a:b], corners.px[a:b]
    best: tuple[float, RigidTransform | None] = np.inf, None
    for T in closed_form_poses(points, camera.undistort(px), cv2.SOLVEPNP_IPPE):
        P = T.apply(points)
        off = np.inf
        if P[:, 2].min() > 0.0:
            off = float(np.median(np.linalg.norm(camera.project(P) - px, axis=1)))
        if off < best[0]:
            best = off, T
    return best


def _matrix(part: float, size: ImageSize) -> Array:
    """Return a camera matrix (3, 3) with a focal length relative to the longer side."""
    f = part * max(size.width, size.height)
    u, v = 0.5 * (size.width - 1.0), 0.5 * (size.height - 1.0)
    return np.array([[f, 0.0, u], [0.0, f, v], [0.0, 0.0, 1.0]])


def _bounds(corners: BoardImages) -> IntArray:
    """Return the index of the first corner of each image, and the number of corners."""
    return np.searchsorted(corners.image, np.arange(corners.image[-1] + 2))


def part_of(
    corners: BoardImages, is_kept: BoolArray, n_images: int
) -> tuple[BoardImages, tuple[int, ...]]:
    """Return a subset of the corners with renumbered images, and their original numbers."""
    images = sorted(set(corners.image[is_kept].tolist()))
    new = np.full(n_images, -1, dtype=np.intp)
    new[images] = np.arange(len(images))
    part = corners.choose(is_kept)
    return replace(part, image=new[part.image]), tuple(images)
