"""Which lens model the images demand: residuals over the field, and residuals of images left out.

The simplest model stays unless residuals lean outwards or inwards somewhere over the field. Then
richer models are fitted too, and one of them is taken if it predicts images better that it has not
seen (cross-validation), or if far more images agree on it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import stdtr

from legcal.calibration.camera_calibration.adjustment import RobustFit, robust_fit
from legcal.calibration.camera_calibration.starts import again, part_of
from legcal.geometry.types import Array
from legcal.perception.board_adjustment import BoardImages, adjust_board
from legcal.vision.camera import intrinsic_names
from legcal.vision.distortion import DistortionModel
from legcal.vision.image_file import ImageSize

SIMPLEST: DistortionModel = "plumb_bob"
_RICHER: tuple[DistortionModel, ...] = ("equidistant", "rational_polynomial")
_FOLDS = 5
_RINGS = 6  # about the principal point, of equal numbers of corners
_OF_RING = 3  # corners of an image in a ring
_SIGNIFICANCE = 1e-3  # of a lean
_LEAN_OF_SCATTER = 0.3  # of the scatter of corners, from which a lean is warned of
_LEAD = 3.0  # standard errors by which a richer model must predict better
_MORE_IMAGES = 1.25  # times as many images that agree are a lead of their own,
_MUCH_WORSE = 1.5  # unless those of both agree on it with so many times larger residuals


@dataclass(frozen=True, eq=False)
class ChosenLens:
    """A fit of the lens model that the images demand."""

    fit: RobustFit
    why: str  # the model, and why it is taken
    warnings: tuple[str, ...] = ()

    @cached_property
    def validated(self) -> Array | None:
        """Residuals (n, 2) of corners in images left out [px]; None where there are too few."""
        return validated_residuals(self.fit)

    @property
    def validated_px(self) -> float | None:
        """Root mean square of these residuals, both coordinates together [px]."""
        if self.validated is None:
            return None
        return float(np.sqrt(np.mean(np.sum(self.validated**2, axis=1))))


def validated_residuals(fit: RobustFit) -> Array | None:
    """Return residuals (n, 2) of corners, the camera being that of other images [px].

    Images are left out in folds; camera and sheet come from the others, the pose from the image
    itself. None where too few images are left, or no adjustment succeeds.
    """
    n = len(fit.images)
    folds = min(_FOLDS, n)
    if n < 4:
        return None
    residual = np.zeros_like(fit.seen.px)
    fold = np.random.default_rng(0).permutation(n) % folds
    poses, names = fit.adjusted.T_camera_board, intrinsic_names(fit.adjusted.camera)
    for k in range(folds):
        out = (fold == k)[fit.seen.image]
        others, numbers = part_of(fit.seen, ~out, n)
        fitted = again(fit.adjusted, [poses[i] for i in numbers], others)
        own, numbers = part_of(fit.seen, out, n)
        if fitted is None:
            return None
        start = fitted.camera, [poses[i] for i in numbers], own, names, fitted.sheet
        predicted = adjust_board(*start, held=True)
        if predicted is None:
            return None
        residual[out] = predicted.residual
    return residual


def lean(fit: RobustFit) -> float:
    """Return how far residuals lean outwards or inwards in a ring of the field [px].

    Zero where that may be chance, by how far images agree on it.
    """
    seen, n = fit.seen, len(fit.images)
    from_centre = seen.px - fit.adjusted.camera.K[:2, 2]
    radius = np.linalg.norm(from_centre, axis=1)
    outwards = np.sum(fit.adjusted.residual * from_centre, axis=1) / np.maximum(radius, 1e-9)
    bounds = np.quantile(radius, np.linspace(0.0, 1.0, _RINGS + 1)[1:-1])
    ring = np.searchsorted(bounds, radius)
    largest = 0.0
    for k in range(_RINGS):
        count = np.bincount(seen.image[ring == k], minlength=n)
        total = np.bincount(seen.image[ring == k], outwards[ring == k], n)
        mean = total[count >= _OF_RING] / count[count >= _OF_RING]
        if len(mean) < 4:
            continue
        t = abs(mean.mean()) / max(mean.std(ddof=1) / np.sqrt(len(mean)), 1e-9)
        if 2.0 * stdtr(len(mean) - 1, -t) < _SIGNIFICANCE / _RINGS:
            largest = max(largest, float(abs(mean.mean())))
    return largest


def given_lens(seen: BoardImages, size: ImageSize, model: DistortionModel) -> ChosenLens | None:
    """Return the fit of a lens model that was asked for, warned of where the images object."""
    fit = robust_fit(seen, size, model)
    if fit is None:
        return None
    leaning, said = lean(fit), []
    if leaning > _LEAN_OF_SCATTER * float(fit.adjusted.residual.std()):
        said.append(
            f"The lens model {model} does not fit: residuals lean by {leaning:.3f} px over the "
            "field; leave out --model, and the images choose."
        )
    return ChosenLens(fit, f"{model}: as given", tuple(said))


def chosen_lens(seen: BoardImages, size: ImageSize) -> ChosenLens | None:
    """Return the fit of the simplest lens model that the images do not object to."""
    plain, best = robust_fit(seen, size, SIMPLEST), None
    if plain is not None:
        if not lean(plain) and not plain.left_out:
            return ChosenLens(plain, f"{SIMPLEST}: its residuals do not lean anywhere in the field")
        best = ChosenLens(plain, f"{SIMPLEST}: no richer model predicts images better")
    for model in _RICHER:
        fit = robust_fit(seen, size, model)
        if fit is None:
            continue
        rich = ChosenLens(fit, f"{model}: no simpler model fits")
        why = _lead(best, rich) if best is not None else rich.why
        if why:
            best = replace(rich, why=why)
            if not lean(fit) and not fit.left_out:
                break
    return best


def _lead(simple: ChosenLens, rich: ChosenLens) -> str:
    """Return why a richer model is taken; "" if it is not."""
    model, other = rich.fit.adjusted.camera.model, simple.fit.adjusted.camera.model
    n, n_other = len(rich.fit.images), len(simple.fit.images)
    if n_other >= _MORE_IMAGES * n:
        return ""
    one, two = _squares(simple), _squares(rich)
    both = sorted(one.keys() & two.keys())
    difference = np.array([one[k] - two[k] for k in both])
    if n >= _MORE_IMAGES * n_other:
        # Nothing contradicts a model whose residuals are so large that all images fit in.
        worse = len(both) >= 4 and np.sum([two[k] for k in both]) > _MUCH_WORSE**2 * np.sum(
            [one[k] for k in both]
        )
        return "" if worse else f"{model}: {n} images agree on it, {n_other} on {other}"
    if len(both) < 4:
        return ""
    error = float(difference.std(ddof=1)) / np.sqrt(len(both))
    if difference.mean() <= _LEAD * error:
        return ""
    rms = [float(np.sqrt(np.mean([square[k] for k in both]))) for square in (two, one)]
    return (
        f"{model}: it predicts images that it has not seen to {rms[0]:.3f} px (rms), {other} to "
        f"{rms[1]:.3f} px"
    )


def _squares(lens: ChosenLens) -> dict[int, float]:
    """Return the mean squared residual of each image left out [px^2]."""
    if lens.validated is None:
        return {}
    square = np.sum(lens.validated**2, axis=1)
    mean = np.bincount(lens.fit.seen.image, square) / np.bincount(lens.fit.seen.image)
    return dict(zip(lens.fit.images, mean.tolist(), strict=True))
