"""What images of a board determine of a camera: refused where it is too little, else warnings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import cv2
import numpy as np
from scipy.special import fdtrc

from legcal.calibration.camera_calibration.adjustment import RobustFit
from legcal.data.measurements import few
from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array
from legcal.perception.board_adjustment import SHEET, adjust_board
from legcal.vision.camera import Camera, intrinsic_names

MIN_IMAGES, _FEW_IMAGES = 3, 10
_MAX_FOCAL_SIGMA, _WEAK_FOCAL_SIGMA = 0.05, 0.003  # as parts of the focal length
_MIN_TILT, _MIN_SPREAD = np.radians(15.0), np.radians(20.0)
_MIN_COVERAGE = 0.5
_MAX_RIVAL = 2.0 / 3.0  # of the images that agree, those that agree on another camera
_LARGE_RESIDUAL_PX = 1.0
_MANY_LEFT_OUT = 0.05  # of all corners
_OVERFIT = 0.01  # probability from which on the gain of more coefficients may be chance
_FOLDED_PX = 0.1
_MAX_RATIO = 25.0  # of squared errors to what corners scatter
_MAX_PIXEL_RATIO = 0.01  # pixels of sensors are square
_MAX_PRINT_RATIO, _MAX_BEND = 0.015, 0.02  # three and two standard deviations of the priors
_SIGNIFICANT = 4.0  # standard deviations
_OPEN_PRIOR = 0.5  # part of the prior of the print ratio that is left where images say little
_IMAGES_OF_PART = 2  # that show corners in a part of the image
_PARTS = (
    "the top left", "the top", "the top right", "the left", "the middle", "the right",
    "the bottom left", "the bottom", "the bottom right",
)  # fmt: skip


def tilts(found: RobustFit) -> Array:
    """Return the angle of each board out of the image plane, (n_images,) [rad]."""
    normal = np.array([T.rotation.as_matrix()[:, 2] for T in found.adjusted.T_camera_board])
    return np.asarray(np.arccos(np.clip(np.abs(normal[:, 2]), 0.0, 1.0)))


def spread(found: RobustFit) -> float:
    """Return the largest angle between two boards' planes [rad]."""
    normal = np.array([T.rotation.as_matrix()[:, 2] for T in found.adjusted.T_camera_board])
    return float(np.arccos(np.clip(np.abs(normal @ normal.T), 0.0, 1.0).min()))


def coverage(found: RobustFit) -> float:
    """Return the share of the image inside the convex hull of all corners."""
    hull = cv2.convexHull(found.seen.px.astype(np.float32))
    camera = found.adjusted.camera
    return float(cv2.contourArea(hull)) / (camera.width * camera.height)


def refuse_undetermined(
    found: RobustFit, names: Sequence[str], left_out: Sequence[str] = ()
) -> None:
    """Raise NotIdentifiable if the images do not determine the camera."""
    n = len(found.images)
    if n < MIN_IMAGES:
        raise too_few_images(n, names, left_out)
    camera = found.adjusted.camera
    f = float(camera.K[0, 0])
    sigma = float(np.sqrt(found.covariance[0, 0]))
    if not sigma <= _MAX_FOCAL_SIGMA * f:
        raise NotIdentifiable(
            f"The camera could not be calibrated: found boards tilted by at most "
            f"{np.degrees(tilts(found).max()):.0f} deg out of the image plane and at most "
            f"{np.degrees(spread(found)):.0f} deg to each other, which leave the focal length open "
            f"(fx {f:.0f} px, known to {sigma:.2g} px), needed views from several sides; tilt the "
            f"board by 30 deg and more{_missing_tilts(found)}."
        )
    centre = camera.K[:2, 2]
    if not np.all((centre > 0.0) & (centre < [camera.width - 1.0, camera.height - 1.0])):
        raise NotIdentifiable(
            f"The camera could not be calibrated: found the principal point at ({centre[0]:.0f}, "
            f"{centre[1]:.0f}) px, outside the image, needed one inside; see that the images are "
            "not cropped, that the model fits the lens, and tilt the board more."
        )


def refuse_divided(found: RobustFit, names: Sequence[str]) -> None:
    """Raise NotIdentifiable if no group of images is clearly the largest that agrees.

    *names* are those of all images that were fitted.
    """
    own, rival = ([names[k] for k in images] for images in (found.images, found.rival))
    if len(rival) > _MAX_RIVAL * len(own):
        whys = [found.left_out[k] for k in found.rival]
        why = max(set(whys), key=whys.count)
        raise NotIdentifiable(
            "The camera could not be calibrated: found two groups of images that each agree on "
            f"another camera, {few(own)} and {few(rival)} (the second: {why}), needed one camera; "
            "give only the images of one group, with zoom, focus and stabilisation off."
        )
    n_others = len(found.left_out)
    if n_others > len(own):
        whys = sorted({f"{names[k]}: {why}" for k, why in found.left_out.items()})
        raise NotIdentifiable(
            f"The camera could not be calibrated: found that only {len(own)} of "
            f"{len(own) + n_others} images agree on a camera ({few(own)}; {few(whys)}), needed "
            "more than half; take them again, the board still, and zoom, focus, stabilisation off."
        )


def too_few_images(
    n: int,
    names: Sequence[str],
    left_out: Sequence[str] = (),
    copies: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> NotIdentifiable:
    """Return the refusal of so few images with the board, saying why others were left out.

    *copies* are the names of images that show what one of these shows, by which.
    """
    found = f"{n} images" if n != 1 else "1 image"
    which = f" ({', '.join(names)})" if names else ""
    others, mend = "", ""
    if left_out:
        reasons = "; ".join(left_out)
        others = f" that agree{which}, and {len(left_out)} more that had to be left out ({reasons})"
        mend = "see that the board is flat and does not move while it is photographed, and "
    elif copies:
        reasons = "; ".join(f"{few(same)}: {why}" for why, same in copies.items())
        n_more = sum(map(len, copies.values()))
        others = f"{which}, and {n_more} more that show the same ({reasons})"
    return NotIdentifiable(
        f"The camera could not be calibrated: found {found} with the board{others or which}, "
        f"needed {MIN_IMAGES} at least and better {_FEW_IMAGES}; {mend}take more, with the "
        "board tilted to all sides."
    )


def warnings(found: RobustFit) -> list[str]:
    """Return what is wrong with a camera that can be used, one sentence each."""
    n, camera = len(found.images), found.adjusted.camera
    sigma = np.sqrt(np.diag(found.covariance))
    sentences = []
    if n < _FEW_IMAGES:
        sentences.append(
            f"{n} images are few: the standard deviations themselves are uncertain; take "
            f"{_FEW_IMAGES} or more."
        )
    tilt, apart = float(tilts(found).max()), spread(found)
    focal = float(sigma[0] / camera.K[0, 0])
    if tilt < _MIN_TILT or apart < _MIN_SPREAD or focal > _WEAK_FOCAL_SIGMA:
        sentences.append(
            f"The focal length is weakly determined, to {100.0 * focal:.2g} % ({sigma[0]:.2g} px): "
            f"the boards are tilted by at most {np.degrees(tilt):.0f} deg out of the image plane "
            f"and {np.degrees(apart):.0f} deg to each other; tilt them by 30 deg and more"
            f"{_missing_tilts(found)}."
        )
    covered = coverage(found)
    if covered < _MIN_COVERAGE:
        sentences.append(
            f"Corners cover {100.0 * covered:.0f} % of the image: what the lens does outside is "
            f"extrapolated; bring the board to {_unseen_parts(found)} of the image."
        )
    sentences += _sheet(found)
    ratio = float(camera.K[1, 1] / camera.K[0, 0] - 1.0)
    error = float(np.hypot(sigma[0], sigma[1])) / camera.K[0, 0]
    if abs(ratio) > _MAX_PIXEL_RATIO and abs(ratio) > _SIGNIFICANT * error:
        sentences.append(
            f"The focal lengths along x and y differ by {100.0 * abs(ratio):.2g} %, and pixels of "
            f"sensors are square: the images look stretched along {'y' if ratio > 0.0 else 'x'}, "
            "or the proportions of the board are wrong; take the files as the camera writes them, "
            "and measure the board."
        )
    if found.ratio > _MAX_RATIO:
        sentences.append(
            f"Images disagree on the camera {np.sqrt(found.ratio):.0f} times as much as corners "
            "scatter, which the standard deviations count: zoom, focus or stabilisation change, or "
            "the board moves or bends; switch these off, and lay the board on something flat."
        )
    sentences += _folding(camera)
    sentences += _overfit(found)
    rms = found.adjusted.rms_px()
    if rms > _LARGE_RESIDUAL_PX:
        sentences.append(
            f"The residuals are large, {rms:.2f} px (rms): the board is bent, its dimensions are "
            "wrong, or the model of the lens does not fit."
        )
    n_all = found.n_left_out + len(found.seen.px)
    if found.n_left_out > _MANY_LEFT_OUT * n_all:
        sentences.append(
            f"{found.n_left_out} of {n_all} corners disagree with the others and were left out; "
            "see that the board is flat, sharp and evenly lit."
        )
    return sentences


def _sheet(found: RobustFit) -> list[str]:
    """Return warnings of a board that is not what was stated, or of which too little is known."""
    sheet = found.adjusted.sheet
    if sheet is None:
        return []
    sigma = np.sqrt(np.diag(found.all_covariance)[-len(SHEET) :])
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
            f"Whether squares are square is open to {100.0 * sigma[3]:.2g} %, and with it fx over "
            "fy: turn the board by a quarter in some images."
        )
    return sentences


def _unseen_parts(found: RobustFit) -> str:
    """Return the parts of the image where few corners were seen."""
    camera = found.adjusted.camera
    part = np.floor(3.0 * (found.seen.px + 0.5) / [camera.width, camera.height]).astype(np.intp)
    number = np.clip(part, 0, 2) @ [1, 3]
    images = [len(set(found.seen.image[number == k].tolist())) for k in range(9)]
    unseen = [name for name, n in zip(_PARTS, images, strict=True) if n < _IMAGES_OF_PART]
    return ", ".join(unseen) or "every edge and corner"


def _missing_tilts(found: RobustFit) -> str:
    """Return to which sides boards were not tilted, as the end of a sentence; "" if to all."""
    normal = np.array([T.rotation.as_matrix()[:, 2] for T in found.adjusted.T_camera_board])
    towards = -normal * np.sign(normal[:, 2:])  # the side that is seen
    slant = np.degrees(np.arctan2(towards[:, :2], -towards[:, 2:]))
    least = float(np.degrees(_MIN_TILT))
    farther = {
        "right": slant[:, 0].max() < least,
        "left": slant[:, 0].min() > -least,
        "lower": slant[:, 1].max() < least,
        "upper": slant[:, 1].min() > -least,
    }
    missing = [side for side, lacks in farther.items() if lacks]
    return f", also with the {' and the '.join(missing)} side farther away" if missing else ""


def _folding(camera: Camera) -> list[str]:
    """Return a warning if the lens model maps two directions to one pixel inside the image."""
    w, h = camera.width - 1.0, camera.height - 1.0
    corners = np.array([[0.0, 0.0], [w, 0.0], [0.0, h], [w, h]])
    back = camera.distort(camera.undistort(corners))
    off = float(np.nan_to_num(np.abs(back - corners), nan=np.inf).max())
    if off < _FOLDED_PX:
        return []
    return [
        "The lens model folds back before the corners of the image, where no board was seen: "
        "pixels there cannot be used; bring the board into the corners, or take a simpler --model."
    ]


def _overfit(found: RobustFit) -> list[str]:
    """Return a warning if the three more coefficients of the rational model gain nothing."""
    full = found.adjusted
    if full.camera.model != "rational_polynomial":
        return []
    simple = [name for name in intrinsic_names(full.camera) if name not in ("k4", "k5", "k6")]
    zeroed = full.camera.distortion.copy()
    zeroed[5:] = 0.0
    start = Camera(full.camera.K, full.camera.width, full.camera.height, zeroed, full.camera.model)
    plain = adjust_board(start, full.T_camera_board, found.seen, simple, full.sheet)
    if plain is None:
        return []
    dof = 2 * len(found.seen.px) - len(full.covariance) - 6 * len(found.images)
    gain = (plain.cost - full.cost) / 3.0 / max(full.cost / max(dof, 1), 1e-30)
    if gain > 0.0 and fdtrc(3, max(dof, 1), gain) < _OVERFIT:
        return []
    rms = [adjusted.rms_px() for adjusted in (full, plain)]
    return [
        f"The model overfits: with rational_polynomial corners are {rms[0]:.4f} px off (rms), "
        f"with plumb_bob {rms[1]:.4f} px, which is no better than chance; take --model plumb_bob."
    ]
