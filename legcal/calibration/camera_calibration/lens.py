"""The choice of the lens model by residuals over the field and by cross-validation.

The simplest model is taken unless its residuals have a radial trend (mean radial residual of a ring
of the field). Then richer models are fitted too, and one of them is taken if it predicts held-out
images better, or if far more images agree on it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import stdtr

from legcal.calibration.camera_calibration.adjustment import RobustFit, robust_fit
from legcal.calibration.camera_calibration.starts import part_of, readjust
from legcal.geometry.types import Array
from legcal.perception.board_adjustment import BoardImages, adjust_board
from legcal.vision.camera import intrinsic_names
from legcal.vision.distortion import DistortionModel
from legcal.vision.image_file import ImageSize

SIMPLEST: DistortionModel = "plumb_bob"
_RICHER: tuple[DistortionModel, ...] = ("equidistant", "rational_polynomial")
_FOLDS = 5
_RINGS = 6  # rings about the principal point with equal numbers of corners
_OF_RING = 3  # smallest number of corners of an image in a ring
_SIGNIFICANCE = 1e-3  # significance level of a radial trend
_TREND_OF_SCATTER = 0.3  # radial trend worth a warning, relative to the scatter of corners
_LEAD = 3.0  # smallest improvement of the prediction by a richer model, in standard errors
_MORE_IMAGES = 1.25  # ratio of agreeing images that decides for a model,
_MUCH_WORSE = 1.5  # unless residuals of common images grow by this factor


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
    plain, best = robust_fit(corners, size, SIMPLEST), None
    if plain is not None:
        if not radial_trend(plain) and not plain.left_out:
            return ChosenLens(plain, f"{SIMPLEST}: its residuals do not lean anywhere in the field")
        best = ChosenLens(plain, f"{SIMPLEST}: no richer model predicts images better")
    for model in _RICHER:
        fit = robust_fit(corners, size, model)
        if fit is None:
            continue
        rich = ChosenLens(fit, f"{model}: no simpler model fits")
        reason = _lead(best, rich) if best is not None else rich.reason
        if reason:
            best = replace(rich, reason=reason)
            if not radial_trend(fit) and not fit.left_out:
                break
    return best


def _lead(simple: ChosenLens, rich: ChosenLens) -> str:
    """Return the reason for a richer model; "" without one."""
    model, other = rich.fit.adjusted.camera.model, simple.fit.adjusted.camera.model
    n, n_other = len(rich.fit.images), len(simple.fit.images)
    if n_other >= _MORE_IMAGES * n:
        return ""
    simple_squares, rich_squares = _squares(simple), _squares(rich)
    common = sorted(simple_squares.keys() & rich_squares.keys())
    difference = np.array([simple_squares[k] - rich_squares[k] for k in common])
    if n >= _MORE_IMAGES * n_other:
        # With large enough residuals all images agree with any model.
        worse = len(common) >= 4 and np.sum(
            [rich_squares[k] for k in common]
        ) > _MUCH_WORSE**2 * np.sum([simple_squares[k] for k in common])
        return "" if worse else f"{model}: {n} images agree on it, {n_other} on {other}"
    if len(common) < 4:
        return ""
    error = float(difference.std(ddof=1)) / np.sqrt(len(common))
    if difference.mean() <= _LEAD * error:
        return ""
    rms = [
        float(np.sqrt(np.mean([square[k] for k in common])))
        for square in (rich_squares, simple_squares)
    ]
    return (
        f"{model}: it predicts images that it has not seen to {rms[0]:.3f} px (rms), {other} to "
        f"{rms[1]:.3f} px"
    )


def _squares(lens: ChosenLens) -> dict[int, float]:
    """Return the mean squared residual of each held-out image [px^2]."""
    if lens.validated is None:
        return {}
    square = np.sum(lens.validated**2, axis=1)
    mean = np.bincount(lens.fit.corners.image, square) / np.bincount(lens.fit.corners.image)
    return dict(zip(lens.fit.images, mean.tolist(), strict=True))
