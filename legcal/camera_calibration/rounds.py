"""Rounds of adjustment that leave out corners and images which disagree with all others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from legcal.camera_calibration.adjustment import Adjusted, SeenCorners, adjust
from legcal.camera_calibration.starts import adjusted_anyhow
from legcal.geometry.types import Array, BoolArray
from legcal.vision.camera import DistortionModel
from legcal.vision.image_file import ImageSize

N_ROUNDS = 6
OUTLYING = 6.0  # standard deviations of a corner that is left out
ODD_IMAGE = 4.0  # times the scatter of the median image, from which an image is left out
LEAST_ODD_PX = 0.5  # scatter of an image that may be left out [px]
FEWEST = 6  # corners of an image that is used
LEAST_NOISE_PX = 0.015  # of a corner: what neighbours share does not show in residuals
LEAST_KEPT = 0.6  # of the corners of an image that is used


@dataclass(frozen=True, eq=False)
class Agreed:
    """A camera, and the corners that agree with it.

    Attributes
    ----------
    adjusted : Adjusted
        By the corners that were kept.
    seen : SeenCorners
        Those corners, their images numbered anew.
    images : tuple of int
        The number that each of these images had.
    left_out : dict of int to str
        Images that disagree, and how.
    n_left_out : int
        Single corners that were left out of the other images.
    extra_px : float
        Scatter of the corners beyond what they claim, one standard deviation [px].
    scale : float
        Factor on the covariance, by the residuals.
    """

    adjusted: Adjusted
    seen: SeenCorners
    images: tuple[int, ...]
    left_out: dict[int, str]
    n_left_out: int
    extra_px: float
    scale: float


def agreed(seen: SeenCorners, size: ImageSize, model: DistortionModel) -> Agreed | None:
    """Return the camera on which corners agree; None if no adjustment succeeds.

    Parameters
    ----------
    seen : SeenCorners
        All corners of all images.
    size : ImageSize
        Of the images [px].
    model : {"plumb_bob", "rational_polynomial", "equidistant"}
        How the lens distorts.
    """
    n_images = int(seen.image[-1]) + 1
    claimed = seen.sigma_px
    seen = replace(seen, sigma_px=np.hypot(claimed, float(np.median(claimed))))
    first = adjusted_anyhow(seen, size, model)
    if first is None:
        return None
    camera, poses = first.camera, list(first.T_camera_board)
    kept = np.ones(len(seen.image), dtype=np.bool_)
    left_out: dict[int, str] = {}
    adjusted, extra = first, 0.0
    for _ in range(N_ROUNDS):
        part, images = _part(seen, kept, n_images)
        found = adjust(camera, [poses[k] for k in images], part)
        if found is None:
            break
        adjusted, camera = found, found.camera
        for k, T in zip(images, found.T_camera_board, strict=True):
            poses[k] = T
        extra = _extra(found.residual, claimed[kept])
        sigma = np.hypot(claimed, extra)
        judged = kept.copy()
        judged[kept] = np.linalg.norm(found.residual, axis=1) < OUTLYING * sigma[kept]
        left_out |= _odd_images(found.residual, part, images)
        judged &= ~np.isin(seen.image, list(left_out))
        counts = np.bincount(seen.image, minlength=n_images)
        for k in set(images) - set(left_out):
            n_kept = int(np.count_nonzero(judged & (seen.image == k)))
            if n_kept < max(FEWEST, LEAST_KEPT * counts[k]):
                left_out[k] = f"{counts[k] - n_kept} of its {counts[k]} corners disagree"
        judged &= ~np.isin(seen.image, list(left_out))
        settled = bool(np.array_equal(judged, kept)) and np.allclose(
            sigma, seen.sigma_px, rtol=0.02
        )
        if len(set(seen.image[judged].tolist())) == 0:
            break
        kept, seen = judged, replace(seen, sigma_px=sigma)
        if settled:
            break
    part, images = _part(seen, kept, n_images)
    last = adjust(camera, [poses[k] for k in images], part)
    adjusted = last if last is not None else adjusted
    others = ~np.isin(seen.image, list(left_out))
    return Agreed(
        adjusted,
        part,
        images,
        left_out,
        int(np.count_nonzero(~kept & others)),
        extra,
        _scale(adjusted, part, len(images)),
    )


def _part(seen: SeenCorners, kept: BoolArray, n_images: int) -> tuple[SeenCorners, tuple[int, ...]]:
    """Return some of the corners, and the numbers that their images had."""
    images = sorted(set(seen.image[kept].tolist()))
    new = np.full(n_images, -1, dtype=np.intp)
    new[images] = np.arange(len(images))
    part = SeenCorners(new[seen.image[kept]], seen.points[kept], seen.px[kept], seen.sigma_px[kept])
    return part, tuple(images)


def _extra(residual: Array, claimed: Array) -> float:
    """Return how far corners scatter beyond what they claim, robustly [px]."""
    seen = 1.4826 * float(np.median(np.abs(residual)))
    return float(np.sqrt(max(seen**2 - float(np.median(claimed)) ** 2, 0.0)))


def _odd_images(residual: Array, seen: SeenCorners, images: Sequence[int]) -> dict[int, str]:
    """Return the images whose corners scatter far more than those of the others."""
    scatter = [float(np.sqrt(np.mean(residual[seen.image == i] ** 2))) for i in range(len(images))]
    usual = float(np.median(scatter))
    return {
        k: f"its corners are {s:.2f} px off (rms), those of the others {usual:.2f} px"
        for k, s in zip(images, scatter, strict=True)
        if s > max(ODD_IMAGE * usual, LEAST_ODD_PX)
    }


def _scale(adjusted: Adjusted, seen: SeenCorners, n_images: int) -> float:
    """Return chi^2 of the corners by its degrees of freedom, for no less than the least noise."""
    chi2 = float(np.sum((adjusted.residual / seen.sigma_px[:, None]) ** 2))
    unknowns = len(adjusted.covariance) + 6 * n_images
    dof = max(2 * len(seen.px) - unknowns, 1)
    noise = float(np.sqrt(np.sum(adjusted.residual**2) / dof))
    return chi2 / dof * max(1.0, LEAST_NOISE_PX / max(noise, 1e-9)) ** 2
