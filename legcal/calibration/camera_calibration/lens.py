"""The choice of the lens model: images that agree on it, then cross-validation image by image.

Every model is fitted to all images before any is left out. A richer model is taken where it
explains images that contradict the simpler one, and others no worse, where it predicts held-out
images better by a signed-rank test over images, or where all images together make it likelier; a
splined one, which other programs do not read, for the last reason only beyond doubt. One whose
radius turns back inside the image is not taken.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import chdtri, ndtr, stdtr

from legcal.calibration.camera_calibration.consensus import RobustFit, evened, robust_fit
from legcal.calibration.camera_calibration.starts import from_scratch, part_of, readjust
from legcal.geometry.types import Array
from legcal.perception.board_adjustment import AdjustedBoard, BoardImages, adjust_board
from legcal.vision.camera import intrinsic_names
from legcal.vision.distortion import DistortionModel
from legcal.vision.image_file import ImageSize

SIMPLEST: DistortionModel = "plumb_bob"
_SPLINED: DistortionModel = "splined_radial"
_RICHER: tuple[DistortionModel, ...] = (
    "equidistant",
    "rational_polynomial",
    "thin_prism",
    _SPLINED,
)
_FOLDS = 5
_RINGS = 6  # rings about the principal point with equal numbers of corners
_OF_RING = 3  # smallest number of corners of an image in a ring
_SIGNIFICANCE = 1e-3  # significance level of a radial trend
_TREND_OF_SCATTER = 0.3  # radial trend worth a warning, relative to the scatter of corners
_BETTER = 0.01  # significance level of a better prediction, and of a likelihood ratio
_BEYOND_DOUBT = 1e-6  # significance level of the likelihood ratio of a splined model
_MORE_IMAGES = 1.25  # ratio of agreeing images from which predictions of others do not count
_MIN_RANKED = 4  # smallest number of images that decide
_LARGE_GAIN = np.log(2.0)  # ratio of mean squares that decides if every image has it


@dataclass(frozen=True, eq=False)
class ChosenLens:
    """A fit with the chosen lens model."""

    fit: RobustFit
    reason: str  # the model, and the reason for it
    warnings: tuple[str, ...] = ()

    @cached_property
    def validated(self) -> Array | None:
        """Residuals (n, 2) of corners in held-out images [px]; None if there are too few."""
        return validated_residuals(self.fit)

    @property
    def validated_px(self) -> float | None:
        """Root mean square of the validated residuals, both coordinates together [px]."""
        if self.validated is None:
            return None
        return float(np.sqrt(np.mean(np.sum(self.validated**2, axis=1))))


def validated_residuals(fit: RobustFit) -> Array | None:
    """Return cross-validated residuals (n, 2) of corners [px].

    Images are held out in folds; camera and sheet come from the others, the pose from the image
    itself. None if too few images are left, or no adjustment succeeds.
    """
    n = len(fit.images)
    folds = min(_FOLDS, n)
    if n < 4:
        return None
    residual = np.zeros_like(fit.corners.px)
    fold = np.random.default_rng(0).permutation(n) % folds
    poses, names = fit.adjusted.T_camera_board, intrinsic_names(fit.adjusted.camera)
    for k in range(folds):
        is_held_out = (fold == k)[fit.corners.image]
        others, numbers = part_of(fit.corners, ~is_held_out, n)
        fitted = readjust(fit.adjusted, [poses[i] for i in numbers], others)
        held_out, numbers = part_of(fit.corners, is_held_out, n)
        if fitted is None:
            return None
        start = fitted.camera, [poses[i] for i in numbers], held_out, names, fitted.sheet
        predicted = adjust_board(*start, held=True)
        if predicted is None:
            return None
        residual[is_held_out] = predicted.residual
    return residual


def radial_trend(fit: RobustFit) -> float:
    """Return the largest significant mean radial residual of a ring of the field [px].

    Zero without a significant one; significance comes from the scatter between images.
    """
    corners, n = fit.corners, len(fit.images)
    from_centre = corners.px - fit.adjusted.camera.K[:2, 2]
    radius = np.linalg.norm(from_centre, axis=1)
    outwards = np.sum(fit.adjusted.residual * from_centre, axis=1) / np.maximum(radius, 1e-9)
    bounds = np.quantile(radius, np.linspace(0.0, 1.0, _RINGS + 1)[1:-1])
    ring = np.searchsorted(bounds, radius)
    largest = 0.0
    for k in range(_RINGS):
        count = np.bincount(corners.image[ring == k], minlength=n)
        total = np.bincount(corners.image[ring == k], outwards[ring == k], n)
        mean = total[count >= _OF_RING] / count[count >= _OF_RING]
        if len(mean) < 4:
            continue
        t = abs(mean.mean()) / max(mean.std(ddof=1) / np.sqrt(len(mean)), 1e-9)
        if 2.0 * stdtr(len(mean) - 1, -t) < _SIGNIFICANCE / _RINGS:
            largest = max(largest, float(abs(mean.mean())))
    return largest


def given_lens(corners: BoardImages, size: ImageSize, model: DistortionModel) -> ChosenLens | None:
    """Return the fit of a given lens model, with a warning if its residuals have a trend."""
    fit = robust_fit(corners, size, model)
    if fit is None:
        return None
    trend, remarks = radial_trend(fit), []
    if trend > _TREND_OF_SCATTER * float(fit.adjusted.residual.std()):
        remarks.append(
            f"The lens model {model} does not fit: residuals have a radial trend of {trend:.3f} px "
            "over the field; leave out --model to choose the model by the images."
        )
    return ChosenLens(fit, f"{model}: as given", tuple(remarks))


def chosen_lens(corners: BoardImages, size: ImageSize) -> ChosenLens | None:
    """Return the fit of the simplest adequate lens model; None if no adjustment succeeds."""
    best: ChosenLens | None = None
    first_of_best: AdjustedBoard | None = None
    even = evened(corners)
    for model in (SIMPLEST, *_RICHER):
        first = from_scratch(even, size, model)
        if first is None:
            continue
        if best is not None and first_of_best is not None and not best.fit.left_out:
            gain = np.log(
                _mean_squares(first_of_best.residual, even) / _mean_squares(first.residual, even)
            )
            if not _is_positive(gain) and not _is_likelier(first, first_of_best, even):
                continue
        fit = robust_fit(corners, size, model, first)
        if fit is None or fit.adjusted.camera.turns_back is not None:
            continue
        if best is None or first_of_best is None:
            alone = "no richer model predicts images better"
            if model != SIMPLEST:
                alone = "no simpler model fits"
            best, first_of_best = ChosenLens(fit, f"{model}: {alone}"), first
            continue
        rich = ChosenLens(fit, "")
        reason = _lead(best, rich, is_likelier=_is_likelier(first, first_of_best, even))
        if reason:
            best, first_of_best = replace(rich, reason=reason), first
    return best


def _is_likelier(rich: AdjustedBoard, simple: AdjustedBoard, corners: BoardImages) -> bool:
    """Return whether a richer model is likelier with all images, by the likelihood ratio.

    Errors are scaled by the larger of their scatter and of the disagreement of images.
    """
    k, k_simple = (len(intrinsic_names(adjusted.camera)) for adjusted in (rich, simple))
    dof = max(2 * len(corners.px) - 6 * len(rich.T_camera_board) - k, 1)
    ratio = max(rich.clusters.ratio(), 2.0 * rich.cost / dof, 1e-30)
    gain = 2.0 * (simple.cost - rich.cost) / ratio
    level = _BEYOND_DOUBT if rich.camera.model == _SPLINED else _BETTER
    return bool(gain > chdtri(max(k - k_simple, 1), level))


def _lead(simple: ChosenLens, rich: ChosenLens, *, is_likelier: bool) -> str:
    """Return the reason for a richer model; "" without one."""
    model, other = rich.fit.adjusted.camera.model, simple.fit.adjusted.camera.model
    n, n_other = len(rich.fit.images), len(simple.fit.images)
    simple_squares, rich_squares = _squares(simple), _squares(rich)
    common = sorted(simple_squares.keys() & rich_squares.keys())
    simple_px2, rich_px2 = (
        np.array([squares[k] for k in common]) for squares in (simple_squares, rich_squares)
    )
    gain = np.log(simple_px2 / rich_px2)
    if _is_positive(-gain):
        return ""
    if n > n_other:
        return f"{model}: {n} images agree on it, {n_other} on {other}"
    if _is_positive(gain) and n_other <= _MORE_IMAGES * n:
        middle = [float(np.sqrt(np.median(px2))) for px2 in (rich_px2, simple_px2)]
        return (
            f"{model}: it predicts {np.count_nonzero(gain > 0.0)} of {len(gain)} images that it "
            f"has not seen better than {other}, to {middle[0]:.3f} instead of {middle[1]:.3f} px "
            "(median)"
        )
    if is_likelier and n == n_other and not simple.fit.left_out:
        return f"{model}: all {n} images together fit it better than {other}, beyond chance"
    return ""


def _is_positive(gain: Array) -> bool:
    """Return whether the log gains of images are positive: all large, or by signed ranks.

    The signed-rank sum is compared with its normal approximation.
    """
    n = len(gain)
    if n < _MIN_RANKED:
        return False
    rank_sum = float(np.sum(1.0 + np.flatnonzero(gain[np.argsort(np.abs(gain))] > 0.0)))
    sigma = np.sqrt(n * (n + 1.0) * (2.0 * n + 1.0) / 24.0)
    z = (rank_sum - 0.25 * n * (n + 1.0) - 0.5) / sigma
    return bool(gain.min() > _LARGE_GAIN or ndtr(-z) < _BETTER)


def _mean_squares(residual: Array, corners: BoardImages) -> Array:
    """Return the mean squared residual of each image, (n_images,) [px^2]."""
    square = np.bincount(corners.image, np.sum(residual**2, axis=1))
    return np.asarray(np.maximum(square / np.bincount(corners.image), 1e-12))


def _squares(lens: ChosenLens) -> dict[int, float]:
    """Return the mean squared residual of each held-out image [px^2]."""
    if lens.validated is None:
        return {}
    mean = _mean_squares(lens.validated, lens.fit.corners)
    return dict(zip(lens.fit.images, mean.tolist(), strict=True))
