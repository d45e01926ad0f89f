"""A camera and a board in every image, adjusted to corners, outliers left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry import Array, BoolArray, IntArray
from legcal.perception import (
    SHEET,
    AdjustedBoard,
    BoardImages,
    Sheet,
    adjust_board,
    plane_poses,
)
from legcal.vision import (
    DISTORTION_MODELS,
    Camera,
    DistortionModel,
    ImageSize,
    intrinsic_names,
    quiet_opencv,
)

_FOCAL_LENGTHS = (0.25, 4.0, 13)  # least to greatest, how many: parts of the longer side
_MAX_ANGLE = 1.45  # [rad] to the axis of a fisheye lens
_ROUGH, _ROUGH_ITERATIONS = ("fx", "fy", "k1"), 12  # estimated first
_MAX_ROUNDS = 6
OUTLIER_SIGMAS = 6.0  # standard deviations of a corner that is left out
_OUTLIER_IMAGE = 4.0  # times the scatter of the median image, from which an image is left out
_MIN_OUTLIER_PX = 0.5  # scatter of an image that may be left out [px]
MIN_CORNERS = 6  # corners of an image that is used
_MIN_NOISE_PX = 0.015  # of a corner: what neighbours share does not show in residuals
_TO_SIGMA = 1.4826  # a median of sizes to a standard deviation
_LEAST_SCATTER_PX = 1e-4  # of exact corners
_MIN_INLIERS = 0.6  # of the corners of an image that is used


def _from_scratch(
    seen: BoardImages, size: ImageSize, model: DistortionModel
) -> AdjustedBoard | None:
    """Return the adjustment from where a camera is roughly right, None if none succeeds."""
    start = None if DISTORTION_MODELS[model].is_fisheye else _by_opencv(seen, size, model)
    start = start or _by_straight_lines(seen, size, model)
    if start is None:
        return None
    rough = adjust_board(*start, seen, _ROUGH, max_iterations=_ROUGH_ITERATIONS)
    if rough is None:
        return None
    return _all_adjusted(rough.camera, rough.T_camera_board, Sheet.flat(seen.points), seen)


def _all_adjusted(
    camera: Camera, poses: Sequence[RigidTransform], sheet: Sheet, seen: BoardImages
) -> AdjustedBoard | None:
    """Return the adjustment of poses, all intrinsics and the sheet from a start."""
    return adjust_board(camera, poses, seen, intrinsic_names(camera), sheet)


def _again(
    near: AdjustedBoard, poses: Sequence[RigidTransform], seen: BoardImages
) -> AdjustedBoard | None:
    """Return the adjustment of other corners, from one nearby."""
    sheet = near.sheet or Sheet.flat(seen.points)
    return _all_adjusted(near.camera, poses, sheet, seen)


def _by_straight_lines(
    seen: BoardImages, size: ImageSize, model: DistortionModel
) -> tuple[Camera, list[RigidTransform]] | None:
    """Return the camera without distortion before which boards are flattest, of several."""
    centre = 0.5 * (size.width - 1.0), 0.5 * (size.height - 1.0)
    no_distortion = np.zeros(len(DISTORTION_MODELS[model].coefficients))
    cameras = []
    for part in np.geomspace(*_FOCAL_LENGTHS).tolist():
        f = part * max(size.width, size.height)
        K = np.array([[f, 0.0, centre[0]], [0.0, f, centre[1]], [0.0, 0.0, 1.0]])
        cameras.append(Camera(K, size.width, size.height, no_distortion, model))
    best = min(cameras, key=lambda camera: _non_flatness(camera, seen))
    poses = []
    for a, b in pairwise(_bounds(seen)):
        found = plane_poses(best, seen.points[a:b], seen.px[a:b], np.ones(b - a))
        if not found:
            return None
        poses.append(found[0].T_camera_plane)
    return best, poses


def _non_flatness(camera: Camera, seen: BoardImages) -> float:
    """Return how far the corners of boards are from any plane before a camera (rms) [px]."""
    angle = np.linalg.norm(seen.px - camera.K[:2, 2], axis=1) / camera.K[0, 0]
    if DISTORTION_MODELS[camera.model].is_fisheye and angle.max() > _MAX_ANGLE:
        return np.inf
    xy = camera.undistort(seen.px)
    off = []
    for a, b in pairwise(_bounds(seen)):
        board = seen.points[a:b, :2]
        H, _ = cv2.findHomography(board, xy[a:b])
        if H is None:
            return np.inf
        flat = np.column_stack([board, np.ones(b - a)]) @ np.asarray(H, dtype=np.float64).T
        off.append(camera.distort(flat[:, :2] / flat[:, 2:]) - seen.px[a:b])
    return float(np.sqrt(np.mean(np.concatenate(off) ** 2)))


def _bounds(seen: BoardImages) -> IntArray:
    """Return where the corners of each image begin, and where those of the last one end."""
    return np.searchsorted(seen.image, np.arange(seen.image[-1] + 2))


def _by_opencv(
    seen: BoardImages, size: ImageSize, model: DistortionModel
) -> tuple[Camera, list[RigidTransform]] | None:
    """Return the camera that OpenCV calibrates, with two coefficients of distortion."""
    pieces = list(pairwise(_bounds(seen)))
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    try:
        with quiet_opencv():
            _, K, distortion, turns, shifts = cv2.calibrateCamera(
                [seen.points[a:b].astype(np.float32) for a, b in pieces],
                [seen.px[a:b].astype(np.float32) for a, b in pieces],
                (size.width, size.height),
                np.eye(3),
                np.zeros(5),
                flags=flags,
            )
    except cv2.error:
        return None
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


@dataclass(frozen=True, eq=False)
class RobustFit:
    """A camera, and the corners that agree with it."""

    adjusted: AdjustedBoard  # by the corners that were kept
    seen: BoardImages  # those corners, their images numbered anew
    images: tuple[int, ...]  # the number that each of these images had
    left_out: dict[int, str]  # images that disagree, and how
    n_left_out: int  # single corners that were left out of the other images
    ratio: float  # of squared errors to claimed ones, by residuals and by how far images disagree
    all_covariance: Array  # (k + 4, k + 4) of the intrinsics, then of the sheet

    @property
    def covariance(self) -> Array:
        """Covariance (k, k) of the intrinsics."""
        k = len(intrinsic_names(self.adjusted.camera))
        return self.all_covariance[:k, :k]

    @property
    def sheet(self) -> Array:
        """Numbers of the sheet, (4,)."""
        return np.zeros(len(SHEET)) if self.adjusted.sheet is None else self.adjusted.sheet.numbers


def robust_fit(seen: BoardImages, size: ImageSize, model: DistortionModel) -> RobustFit | None:
    """Return the camera on which corners agree; None if no adjustment succeeds."""
    n_images = int(seen.image[-1]) + 1
    claimed = seen.sigma_px
    seen = replace(seen, sigma_px=np.hypot(claimed, float(np.median(claimed))))
    first = _from_scratch(seen, size, model)
    if first is None:
        return None
    poses = list(first.T_camera_board)
    kept = np.ones(len(seen.image), dtype=np.bool_)
    left_out: dict[int, str] = {}
    adjusted = first
    for _ in range(_MAX_ROUNDS):
        part, images = _part(seen, kept, n_images)
        found = _again(adjusted, [poses[k] for k in images], part)
        if found is None:
            break
        adjusted = found
        for k, T in zip(images, found.T_camera_board, strict=True):
            poses[k] = T
        sigma = _scattered(claimed, kept, found.residual)
        judged = kept.copy()
        judged[kept] = np.linalg.norm(found.residual, axis=1) < OUTLIER_SIGMAS * sigma[kept]
        left_out |= _outlier_images(found.residual, part, images)
        judged &= ~np.isin(seen.image, list(left_out))
        counts = np.bincount(seen.image, minlength=n_images)
        for k in set(images) - set(left_out):
            n_kept = int(np.count_nonzero(judged & (seen.image == k)))
            if n_kept < max(MIN_CORNERS, _MIN_INLIERS * counts[k]):
                left_out[k] = f"{counts[k] - n_kept} of its {counts[k]} corners disagree"
        judged &= ~np.isin(seen.image, list(left_out))
        converged = bool(np.array_equal(judged, kept)) and np.allclose(
            sigma, seen.sigma_px, rtol=0.02
        )
        if len(set(seen.image[judged].tolist())) == 0:
            break
        kept, seen = judged, replace(seen, sigma_px=sigma)
        if converged:
            break
    part, images = _part(seen, kept, n_images)
    adjusted = _again(adjusted, [poses[k] for k in images], part) or adjusted
    others = ~np.isin(seen.image, list(left_out))
    ratio = max(_scale(adjusted, part, len(images)), adjusted.clusters.ratio())
    return RobustFit(
        adjusted,
        part,
        images,
        left_out,
        int(np.count_nonzero(~kept & others)),
        ratio,
        adjusted.clusters.covariance(ratio),
    )


def _part(seen: BoardImages, kept: BoolArray, n_images: int) -> tuple[BoardImages, tuple[int, ...]]:
    """Return some of the corners, and the numbers that their images had."""
    images = sorted(set(seen.image[kept].tolist()))
    new = np.full(n_images, -1, dtype=np.intp)
    new[images] = np.arange(len(images))
    part = BoardImages(new[seen.image[kept]], seen.points[kept], seen.px[kept], seen.sigma_px[kept])
    return part, tuple(images)


def _scattered(claimed: Array, kept: BoolArray, residual: Array) -> Array:
    """Return standard deviations of corners (n,) that fit how they scatter, robustly [px].

    What they scatter beyond their claims is added to all; claims that are too large are scaled.
    """
    share = _TO_SIGMA * float(np.median(np.abs(residual) / claimed[kept, None]))
    if share < 1.0:
        return np.maximum(share * claimed, _LEAST_SCATTER_PX)
    seen, usual = _TO_SIGMA * np.median(np.abs(residual)), np.median(claimed[kept])
    return np.asarray(np.hypot(claimed, np.sqrt(max(seen**2 - usual**2, 0.0))))


def _outlier_images(residual: Array, seen: BoardImages, images: Sequence[int]) -> dict[int, str]:
    """Return the images whose corners scatter far more than those of the others."""
    scatter = [float(np.sqrt(np.mean(residual[seen.image == i] ** 2))) for i in range(len(images))]
    usual = float(np.median(scatter))
    return {
        k: f"its corners are {s:.2f} px off (rms), those of the others {usual:.2f} px"
        for k, s in zip(images, scatter, strict=True)
        if s > max(_OUTLIER_IMAGE * usual, _MIN_OUTLIER_PX)
    }


def _scale(adjusted: AdjustedBoard, seen: BoardImages, n_images: int) -> float:
    """Return chi^2 of the corners by its degrees of freedom, for no less than the least noise."""
    chi2 = float(np.sum((adjusted.residual / seen.sigma_px[:, None]) ** 2))
    unknowns = len(adjusted.covariance) + 6 * n_images
    dof = max(2 * len(seen.px) - unknowns, 1)
    noise = float(np.sqrt(np.sum(adjusted.residual**2) / dof))
    return chi2 / dof * max(1.0, _MIN_NOISE_PX / max(noise, 1e-9)) ** 2
