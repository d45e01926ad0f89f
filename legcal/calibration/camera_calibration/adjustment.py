"""A camera and a board in every image, adjusted to corners, outliers left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from legcal.calibration.camera_calibration.consensus import agreeing_images
from legcal.calibration.camera_calibration.starts import part_of, readjust
from legcal.geometry.types import Array, BoolArray
from legcal.perception.board_adjustment import SHEET, AdjustedBoard, BoardImages
from legcal.vision.camera import intrinsic_names
from legcal.vision.distortion import DistortionModel
from legcal.vision.image_file import ImageSize

_MAX_ROUNDS = 6
OUTLIER_SIGMAS = 6.0  # smallest residual of an outlier corner, in standard deviations
_OUTLIER_IMAGE = 4.0  # smallest scatter of an outlier image, relative to the median image
_MIN_OUTLIER_PX = 0.5  # smallest scatter of an outlier image [px]
MIN_CORNERS = 6  # smallest number of corners of a used image
# smallest noise of a corner [px]: errors that neighbours share do not show in residuals
_MIN_NOISE_PX = 0.015
_TO_SIGMA = 1.4826  # standard deviation over median absolute deviation of a normal distribution
_LEAST_SCATTER_PX = 1e-4  # standard deviation of exact corners
_MIN_INLIERS = 0.6  # smallest share of inlier corners in a used image


@dataclass(frozen=True, eq=False)
class RobustFit:
    """A camera fitted to the corners that agree with it."""

    adjusted: AdjustedBoard  # fit to the inlier corners
    corners: BoardImages  # inlier corners, with their images renumbered
    images: tuple[int, ...]  # original numbers of these images
    left_out: dict[int, str]  # outlier images and their disagreement
    rival: tuple[int, ...]  # outlier images that agree among themselves
    n_left_out: int  # number of outlier corners in the other images
    # squared errors over their claims, the larger one of residuals and disagreement of images
    ratio: float
    all_covariance: Array  # (k + 4, k + 4): covariance of the intrinsics, then of the sheet

    @property
    def covariance(self) -> Array:
        """Covariance (k, k) of the intrinsics."""
        k = len(intrinsic_names(self.adjusted.camera))
        return self.all_covariance[:k, :k]

    @property
    def sheet(self) -> Array:
        """Numbers of the sheet, (4,)."""
        return np.zeros(len(SHEET)) if self.adjusted.sheet is None else self.adjusted.sheet.numbers


def robust_fit(
    corners: BoardImages,
    size: ImageSize,
    model: DistortionModel,
    first: AdjustedBoard | None = None,  # adjustment to all images, if there is one
) -> RobustFit | None:
    """Return the fit of the camera without outliers; None if no adjustment succeeds."""
    n_images = int(corners.image[-1]) + 1
    claimed, corners = corners.sigma_px, evened(corners)
    agreed = agreeing_images(corners, size, model, first)
    if agreed is None:
        return None
    adjusted, left_out = agreed.adjusted, dict(agreed.left_out)
    poses = list(adjusted.T_camera_board)
    is_kept = ~np.isin(corners.image, list(left_out))
    for _ in range(_MAX_ROUNDS):
        part, images = part_of(corners, is_kept, n_images)
        readjusted = readjust(adjusted, [poses[k] for k in images], part)
        if readjusted is None:
            break
        adjusted = readjusted
        for k, T in zip(images, readjusted.T_camera_board, strict=True):
            poses[k] = T
        sigma = _scattered(claimed, is_kept, readjusted.residual)
        judged = is_kept.copy()
        judged[is_kept] = (
            np.linalg.norm(readjusted.residual, axis=1) < OUTLIER_SIGMAS * sigma[is_kept]
        )
        left_out |= _outlier_images(readjusted.residual, part, images)
        judged &= ~np.isin(corners.image, list(left_out))
        counts = np.bincount(corners.image, minlength=n_images)
        for k in set(images) - set(left_out):
            n_kept = int(np.count_nonzero(judged & (corners.image == k)))
            if n_kept < max(MIN_CORNERS, _MIN_INLIERS * counts[k]):
                left_out[k] = f"{counts[k] - n_kept} of its {counts[k]} corners disagree"
        judged &= ~np.isin(corners.image, list(left_out))
        converged = bool(np.array_equal(judged, is_kept)) and np.allclose(
            sigma, corners.sigma_px, rtol=0.02
        )
        if len(set(corners.image[judged].tolist())) == 0:
            break
        is_kept, corners = judged, replace(corners, sigma_px=sigma)
        if converged:
            break
    part, images = part_of(corners, is_kept, n_images)
    adjusted = readjust(adjusted, [poses[k] for k in images], part) or adjusted
    others = ~np.isin(corners.image, list(left_out))
    ratio = max(_scale(adjusted, part, len(images)), adjusted.clusters.ratio())
    return RobustFit(
        adjusted,
        part,
        images,
        left_out,
        agreed.rival,
        int(np.count_nonzero(~is_kept & others)),
        ratio,
        adjusted.clusters.covariance(ratio),
    )


def evened(corners: BoardImages) -> BoardImages:
    """Return corners of which none claims to be far better than the others."""
    claimed = corners.sigma_px
    return replace(corners, sigma_px=np.hypot(claimed, float(np.median(claimed))))


def _scattered(claimed: Array, is_kept: BoolArray, residual: Array) -> Array:
    """Return standard deviations of corners (n,), updated by the robust scatter of residuals [px].

    Excess scatter is added to all in quadrature; claims that are too large are scaled.
    """
    share = _TO_SIGMA * float(np.median(np.abs(residual) / claimed[is_kept, None]))
    if share < 1.0:
        return np.maximum(share * claimed, _LEAST_SCATTER_PX)
    scatter, usual = _TO_SIGMA * np.median(np.abs(residual)), np.median(claimed[is_kept])
    return np.asarray(np.hypot(claimed, np.sqrt(max(scatter**2 - usual**2, 0.0))))


def _outlier_images(residual: Array, corners: BoardImages, images: Sequence[int]) -> dict[int, str]:
    """Return the images with far more scatter than the median image, and a description of it."""
    scatter = [
        float(np.sqrt(np.mean(residual[corners.image == i] ** 2))) for i in range(len(images))
    ]
    usual = float(np.median(scatter))
    return {
        k: f"its corners are {s:.2f} px off (rms), those of the others {usual:.2f} px"
        for k, s in zip(images, scatter, strict=True)
        if s > max(_OUTLIER_IMAGE * usual, _MIN_OUTLIER_PX)
    }


def _scale(adjusted: AdjustedBoard, corners: BoardImages, n_images: int) -> float:
    """Return chi^2 of the corners over its degrees of freedom, with at least the minimum noise."""
    chi2 = float(np.sum((adjusted.residual / corners.sigma_px[:, None]) ** 2))
    unknowns = len(adjusted.covariance) + 6 * n_images
    dof = max(2 * len(corners.px) - unknowns, 1)
    noise = float(np.sqrt(np.sum(adjusted.residual**2) / dof))
    return chi2 / dof * max(1.0, _MIN_NOISE_PX / max(noise, 1e-9)) ** 2
