"""Checks of a calibrated camera: refusals if the images do not determine it, else warnings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import cv2
import numpy as np
from scipy.spatial.distance import pdist, squareform

from legcal.calibration.camera_calibration.consensus import RobustFit
from legcal.calibration.camera_calibration.starts import part_of
from legcal.errors import NotIdentifiable
from legcal.files.schema import Document, few
from legcal.geometry.types import Array
from legcal.perception.board_adjustment import SHEET, BoardImages, adjust_board
from legcal.vision.camera import Camera, intrinsic_names

MIN_IMAGES, _FEW_IMAGES = 3, 10
_MAX_FOCAL_SIGMA, _WEAK_FOCAL_SIGMA = 0.05, 0.003  # relative to the focal length
_MIN_TILT, _MIN_SPREAD = np.radians(15.0), np.radians(20.0)
_MIN_COVERAGE = 0.5
_MAX_RIVAL = 2.0 / 3.0  # largest size of the second group of images, relative to the first
_LARGE_RESIDUAL_PX = 1.0
_MANY_LEFT_OUT = 0.05  # share of corners left out that is worth a warning
_MAX_RATIO = 25.0  # largest ratio of squared errors to the scatter of corners
_MAX_PIXEL_RATIO = 0.01  # pixels of sensors are square
_MAX_PRINT_RATIO, _MAX_BEND = 0.015, 0.02  # three and two standard deviations of the priors
_SIGNIFICANT = 4.0  # standard deviations
_SAME_PX = 1e-3  # smallest noise of corners in two photographs; copies have less
_BESIDE = 1.05  # of the smallest distance of corners on the board: next to each other
_OPEN_PRIOR = 0.5  # sigma of an undetermined print ratio, relative to its prior
_IMAGES_OF_PART = 2  # images with corners in a covered part of the image
_PARTS = (
    "the top left", "the top", "the top right", "the left", "the middle", "the right",
    "the bottom left", "the bottom", "the bottom right",
)  # fmt: skip


class Repeats(Document):
    """The noise of corners by pairs of images in which the board stands still."""

    pairs: int
    noise_px: float  # one standard deviation of either coordinate [px]
    length_px: float  # its correlation length in an image [px], 0 if none is seen


def tilts(fit: RobustFit) -> Array:
    """Return the angle of each board out of the image plane, (n_images,) [rad]."""
    normal = np.array([T.rotation.as_matrix()[:, 2] for T in fit.adjusted.T_camera_board])
    return np.asarray(np.arccos(np.clip(np.abs(normal[:, 2]), 0.0, 1.0)))


def spread(fit: RobustFit) -> float:
    """Return the largest angle between two boards' planes [rad]."""
    normal = np.array([T.rotation.as_matrix()[:, 2] for T in fit.adjusted.T_camera_board])
    return float(np.arccos(np.clip(np.abs(normal @ normal.T), 0.0, 1.0).min()))


def covered(px: Array) -> Array:
    """Return the corners (k, 2) of the convex hull of pixels (n, 2) [px]."""
    return np.asarray(cv2.convexHull(px.astype(np.float32))[:, 0])


def coverage(px: Array, camera: Camera) -> float:
    """Return the share of the image inside the convex hull of pixels (n, 2)."""
    return float(cv2.contourArea(covered(px))) / (camera.width * camera.height)


def repeat_noise(fit: RobustFit, repeats: BoardImages, first: Sequence[int]) -> Repeats | None:
    """Return the noise of corners by pairs of images in which the board stands still.

    Images 2 k and 2 k + 1 of *repeats* have the same corners, the board near its pose in image
    first[k] of the fit. What print, lens and light do to a corner is the same in both. None where
    all pairs are copies of one photograph.
    """
    camera, poses = fit.adjusted.camera, fit.adjusted.T_camera_board
    starts = [poses[k] for k in np.repeat(first, 2)]
    names = intrinsic_names(camera)
    adjusted = adjust_board(camera, starts, repeats, names, fit.adjusted.sheet, held=True)
    if adjusted is None:
        return None
    is_first, pair = repeats.image % 2 == 0, repeats.image // 2
    off = adjusted.residual[~is_first] - adjusted.residual[is_first]
    square = np.bincount(pair[is_first], 0.5 * np.sum(off**2, axis=1))
    dof = 2 * np.bincount(pair[is_first]) - 6  # a pair determines how the board moved
    differ = (dof > 0) & (square > dof * _SAME_PX**2)
    if not differ.any():
        return None
    part, _ = part_of(repeats, is_first & differ[pair], len(starts))
    return Repeats(
        pairs=int(np.count_nonzero(differ)),
        noise_px=float(np.sqrt(square[differ].sum() / dof[differ].sum())),
        length_px=noise_correlation(part, off[differ[pair[is_first]]])[0],
    )


def noise_correlation(corners: BoardImages, residual: Array) -> tuple[float, float]:
    """Return the correlation length of residuals in an image [px], and the effective corners.

    These are as a share of all: N / sum_ij exp(-d_ij / length), for a correlation that falls
    exponentially with the distance, through that of corners next to each other on the board. The
    length is zero where that correlation is not significant.
    """
    products, apart_px, between = list[Array](), list[Array](), list[Array]()
    for i in range(int(corners.image[-1]) + 1):
        of_image = corners.image == i
        px, r = corners.px[of_image], residual[of_image]
        on_board = squareform(pdist(corners.points[of_image]))
        least = on_board[on_board > 0.0].min()
        a, b = np.nonzero(np.triu(on_board > 0.0) & (on_board < _BESIDE * least))
        products.append(np.sum(r[a] * r[b], axis=1))
        apart_px.append(np.linalg.norm(px[a] - px[b], axis=1))
        between.append(squareform(pdist(px)))
    product = np.concatenate(products)
    correlation = float(product.mean() / np.mean(np.sum(residual**2, axis=1)))
    if correlation * np.sqrt(2.0 * len(product)) < _SIGNIFICANT:
        return 0.0, 1.0
    pitch = float(np.median(np.concatenate(apart_px)))
    length = -pitch / float(np.log(min(correlation, 0.99)))
    return length, len(residual) / sum(float(np.exp(-d / length).sum()) for d in between)


def refuse_undetermined(fit: RobustFit, names: Sequence[str], left_out: Sequence[str] = ()) -> None:
    """Raise NotIdentifiable if the images do not determine the camera."""
    n = len(fit.images)
    if n < MIN_IMAGES:
        raise too_few_images(n, names, left_out)
    camera = fit.adjusted.camera
    f = float(camera.K[0, 0])
    sigma = float(np.sqrt(fit.covariance[0, 0]))
    if not sigma <= _MAX_FOCAL_SIGMA * f:
        raise NotIdentifiable(
            f"The camera could not be calibrated: found boards tilted by at most "
            f"{np.degrees(tilts(fit).max()):.0f} deg out of the image plane and at most "
            f"{np.degrees(spread(fit)):.0f} deg to each other, which leave the focal length open "
            f"(fx {f:.0f} px, known to {sigma:.2g} px), needed views from several sides; tilt the "
            "board by 30 deg and more to all sides."
        )
    if (angle := camera.turns_back) is not None:
        raise NotIdentifiable(
            "The camera could not be calibrated: found a splined lens whose radius stops growing "
            f"{np.degrees(angle):.0f} deg from the axis, inside the image, needed boards as far as "
            "the corners of the image; bring the board there, or leave out --model."
        )
    centre = camera.K[:2, 2]
    if not np.all((centre > 0.0) & (centre < [camera.width - 1.0, camera.height - 1.0])):
        raise NotIdentifiable(
            f"The camera could not be calibrated: found the principal point at ({centre[0]:.0f}, "
            f"{centre[1]:.0f}) px, outside the image, needed one inside; see that the images are "
            "not cropped, that the model fits the lens, and tilt the board more."
        )


def refuse_divided(fit: RobustFit, names: Sequence[str]) -> None:
    """Raise NotIdentifiable if no group of agreeing images is clearly the largest.

    *names* are the names of all images that were fitted.
    """
    largest, rival = ([names[k] for k in images] for images in (fit.images, fit.rival))
    if len(rival) > _MAX_RIVAL * len(largest):
        reasons = [fit.left_out[k] for k in fit.rival]
        reason = max(set(reasons), key=reasons.count)
        raise NotIdentifiable(
            "The camera could not be calibrated: found two groups of images that each agree on "
            f"another camera, {few(largest)} and {few(rival)} (the second: {reason}), needed one "
            "camera; give only the images of one group, with zoom, focus and stabilisation off."
        )
    n_others = len(fit.left_out)
    if n_others > len(largest):
        reasons = [f"{names[k]}: {reason}" for k, reason in sorted(fit.left_out.items())]
        raise NotIdentifiable(
            f"The camera could not be calibrated: found that only {len(largest)} of "
            f"{len(largest) + n_others} images agree on a camera ({few(largest)}; {few(reasons)}), "
            "needed more than half; take them again, the board still, and zoom, focus, "
            "stabilisation off."
        )


def too_few_images(
    n: int,
    names: Sequence[str],
    left_out: Sequence[str] = (),
    copies: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> NotIdentifiable:
    """Return the error for too few images, with the reasons for leaving others out.

    *copies* are the names of redundant images by reason.
    """
    count = f"{n} images" if n != 1 else "1 image"
    listed = f" ({', '.join(names)})" if names else ""
    others, hint = "", ""
    if left_out:
        reasons = "; ".join(left_out)
        others = (
            f" that agree{listed}, and {len(left_out)} more that had to be left out ({reasons})"
        )
        hint = "see that the board is flat and does not move while it is photographed, and "
    elif copies:
        reasons = "; ".join(f"{few(same_names)}: {reason}" for reason, same_names in copies.items())
        n_more = sum(map(len, copies.values()))
        others = f"{listed}, and {n_more} more that show the same ({reasons})"
    return NotIdentifiable(
        f"The camera could not be calibrated: found {count} with the board{others or listed}, "
        f"needed {MIN_IMAGES} at least and better {_FEW_IMAGES}; {hint}take more, with the "
        "board tilted to all sides."
    )


def warnings(fit: RobustFit) -> list[str]:
    """Return the warnings about a usable camera, one sentence each."""
    n, camera = len(fit.images), fit.adjusted.camera
    sigma = np.sqrt(np.diag(fit.covariance))
    sentences = []
    if n < _FEW_IMAGES:
        sentences.append(
            f"{n} images are few: the standard deviations themselves are uncertain; take "
            f"{_FEW_IMAGES} or more."
        )
    tilt, largest_angle = float(tilts(fit).max()), spread(fit)
    focal = float(sigma[0] / camera.K[0, 0])
    if tilt < _MIN_TILT or largest_angle < _MIN_SPREAD or focal > _WEAK_FOCAL_SIGMA:
        sentences.append(
            f"The focal length is weakly determined, to {100.0 * focal:.2g} % ({sigma[0]:.2g} px): "
            f"the boards are tilted by at most {np.degrees(tilt):.0f} deg out of the image plane "
            f"and {np.degrees(largest_angle):.0f} deg to each other; tilt them by 30 deg and more"
            " to all sides."
        )
    share = coverage(fit.corners.px, camera)
    if share < _MIN_COVERAGE:
        sentences.append(
            f"Corners cover {100.0 * share:.0f} % of the image: the distortion outside is "
            f"extrapolated; bring the board to {_uncovered_parts(fit)} of the image."
        )
    sentences += _sheet(fit)
    ratio = float(camera.K[1, 1] / camera.K[0, 0] - 1.0)
    error = float(np.hypot(sigma[0], sigma[1])) / camera.K[0, 0]
    if abs(ratio) > _MAX_PIXEL_RATIO and abs(ratio) > _SIGNIFICANT * error:
        sentences.append(
            f"The focal lengths along x and y differ by {100.0 * abs(ratio):.2g} %, and pixels of "
            f"sensors are square: the images look stretched along {'y' if ratio > 0.0 else 'x'}, "
            "or the proportions of the board are wrong; take the files as the camera writes them, "
            "and measure the board."
        )
    if fit.ratio > _MAX_RATIO:
        sentences.append(
            f"Images disagree on the camera {np.sqrt(fit.ratio):.0f} times as much as corners "
            "scatter, which the standard deviations count: zoom, focus or stabilisation change, or "
            "the board moves or bends; switch these off, and lay the board on something flat."
        )
    if not camera.reaches(camera.corners).all():  # two directions have one pixel
        sentences.append(
            "The lens model folds back before the corners of the image, where no board was seen: "
            "pixels there cannot be used; bring the board into the corners, or take a simpler "
            "--model."
        )
    rms = fit.adjusted.rms_px()
    if rms > _LARGE_RESIDUAL_PX:
        sentences.append(
            f"The residuals are large, {rms:.2f} px (rms): the board is bent, its dimensions are "
            "wrong, or the model of the lens does not fit."
        )
    n_all = fit.n_left_out + len(fit.corners.px)
    if fit.n_left_out > _MANY_LEFT_OUT * n_all:
        sentences.append(
            f"{fit.n_left_out} of {n_all} corners disagree with the others and were left out; "
            "see that the board is flat, sharp and evenly lit."
        )
    return sentences


def _sheet(fit: RobustFit) -> list[str]:
    """Return warnings about a board that differs from the stated one or is poorly determined."""
    sheet = fit.adjusted.sheet
    if sheet is None:
        return []
    sigma = np.sqrt(np.diag(fit.all_covariance)[-len(SHEET) :])
    side, ratio = 2.0 * float(sheet.half.max()), float(sheet.numbers[3])
    sentences = []
    if abs(ratio) > _MAX_PRINT_RATIO and abs(ratio) > _SIGNIFICANT * sigma[3]:
        sentences.append(
            f"Squares or tags are {100.0 * abs(ratio):.2g} % wider than high"
            if ratio > 0.0
            else f"Squares or tags are {100.0 * abs(ratio):.2g} % higher than wide"
        )
        sentences[-1] += ", more than printers do: measure the board, and correct --board."
    k = int(np.argmax(np.abs(sheet.numbers[:3])))
    bend = abs(float(sheet.numbers[k]))
    if bend > _MAX_BEND * side and bend > _SIGNIFICANT * sigma[k]:
        sentences.append(
            f"The board is bent by {1e3 * bend:.2g} mm over {1e3 * side:.0f} mm: lay it on "
            "something flat."
        )
    if sigma[3] > _OPEN_PRIOR * sheet.prior_sigma[3]:
        sentences.append(
            f"The aspect ratio of the squares, and with it fx / fy, is determined only to "
            f"{100.0 * sigma[3]:.2g} %: turn the board by a quarter in some images."
        )
    return sentences


def _uncovered_parts(fit: RobustFit) -> str:
    """Return the names of the parts of the image with few corners."""
    camera = fit.adjusted.camera
    part = np.floor(3.0 * (fit.corners.px + 0.5) / [camera.width, camera.height]).astype(np.intp)
    number = np.clip(part, 0, 2) @ [1, 3]
    images = [len(set(fit.corners.image[number == k].tolist())) for k in range(9)]
    unseen = [name for name, n in zip(_PARTS, images, strict=True) if n < _IMAGES_OF_PART]
    return ", ".join(unseen) or "every edge and corner"
