"""The calibration of a camera, its document, the camera file and the picture: written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from legcal.brief import brief
from legcal.calibration.camera_calibration.diagnostics import Repeats, coverage, covered
from legcal.calibration.camera_calibration.projection import GRID, finite, projection_sigma
from legcal.files.folder import OutputFile
from legcal.files.schema import Document
from legcal.geometry.types import Array
from legcal.perception.board_adjustment import SHEET
from legcal.vision.board import Board
from legcal.vision.camera import Camera, intrinsic_names, intrinsic_values
from legcal.vision.camera_file import CALIBRATED, camera_info

CAMERA_FILE = OutputFile(
    "the camera", "camera file", CALIBRATED, "a new file or one that this command wrote"
)
_DIGITS = 6  # significant digits of the diagnostics
_LONGER = 1280  # side of the picture [px]
_CELLS = 16  # cells along the longer side
_ARROW = 0.45  # length of the longest arrow, relative to a cell
_LEAST_ARROW = 3  # smallest number of corners of a cell with an arrow
_LETTER = 0.55  # scale of letters
_LABELLED = 4  # every fourth place of the grid has its standard deviation written
_DARK, _WHITE, _EMPTY = (32, 32, 32), (255, 255, 255), (60, 60, 140)
_SEEN, _RESIDUAL, _CENTRE = (90, 120, 60), (0, 225, 255), (255, 170, 40)  # blue, green, red
_MARK = "Software", "legcal camera"  # of a picture that this command wrote
PICTURE_FILE = OutputFile(
    "the picture",
    "picture",
    "",
    "a new file or a picture that this command wrote",
    mark="\0".join(_MARK).encode(),
)


class BoardImage(Document):
    """Corners, residuals and board tilt of an image."""

    image: str  # name of the file
    corners: int  # of the board that were found
    used: int
    rms_px: float | None  # of the residuals, both coordinates together; None if left out
    tilt_rad: float | None  # of the board out of the image plane
    reason: str | None  # for leaving the image out


@brief
@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """The result of :func:`legcal.calibrate_camera`."""

    camera: Camera
    # (k, k): covariance of its intrinsics, in the order of ``names`` [px, and without unit]
    covariance: Array
    board: Board
    images: tuple[BoardImage, ...]  # all images in the given order
    rms_px: float  # root mean square of the residuals, both coordinates together [px]
    noise_px: float  # scatter of either coordinate of a corner, one standard deviation [px]
    # correlation length of that in an image [px], 0 if none is seen; effective share of the corners
    noise_length_px: float
    effective_corners: float
    repeats: Repeats | None  # noise by images in which the board stands still; None without any
    warnings: tuple[str, ...]  # warnings, one sentence each
    # (4,): bending of the board along x and y and its twist [m], relative excess width of the print
    sheet: Array
    sheet_covariance: Array  # (4, 4): covariance of ``sheet``
    # ratio of the errors, by residuals or by disagreement of images, to the claimed sigmas
    error_ratio: float
    lens: str  # the lens model, and the reason for choosing it
    # root mean square of the residuals of held-out images in cross-validation [px]; None with fewer
    # than four images
    validated_px: float | None
    corners: Array  # (n, 4): pixels and residuals of the used corners [px]
    # metadata of the used image files: distinct values by key of the camera file
    photographs: Mapping[str, Sequence[Any]] = field(default_factory=dict)

    @property
    def coverage(self) -> float:
        """Share of the image inside the convex hull of all corners."""
        return coverage(self.corners[:, :2], self.camera)

    @property
    def projection_sigma(self) -> Array:
        """Standard deviations of the projection over the image, 13 rows of 17 [px].

        In the worst direction, but for a turn of the camera; infinite where the lens folds back.
        """
        return projection_sigma(self.camera, self.covariance).reshape(GRID[::-1])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the intrinsics: ``fx fy cx cy``, then the distortion in OpenCV's order."""
        return intrinsic_names(self.camera)

    @property
    def values(self) -> Array:
        """The intrinsics, (k,) [px, and without unit]."""
        return intrinsic_values(self.camera)

    @property
    def sigma(self) -> Array:
        """Standard deviations of the intrinsics, (k,) [px, and without unit]."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def sheet_sigma(self) -> Array:
        """Standard deviations of the numbers of the sheet, (4,)."""
        return np.sqrt(np.diag(self.sheet_covariance))

    def document(self) -> dict[str, Any]:
        """Return the output of ``--json``."""
        sheet = zip(SHEET, self.sheet.tolist(), self.sheet_sigma.tolist(), strict=True)
        numbers = zip(self.names, self.values.tolist(), self.sigma.tolist(), strict=True)
        return CameraDocument.describing(
            self,
            legcal_camera=1,
            model=self.camera.model,
            width=self.camera.width,
            height=self.camera.height,
            intrinsics=[Intrinsic(name=name, value=v, sigma=sigma) for name, v, sigma in numbers],
            covariance=self.covariance.tolist(),
            projection_sigma_px=[finite(row) for row in self.projection_sigma],
            sheet=[Intrinsic(name=name, value=v, sigma=sigma) for name, v, sigma in sheet],
        ).document()


class Intrinsic(Document):
    """A number of the camera or of the sheet [px, m, or without unit]."""

    name: str
    value: float
    sigma: float


class CameraDocument(Document):
    """The output of ``legcal camera --json``."""

    legcal_camera: int
    model: str
    width: int
    height: int
    intrinsics: list[Intrinsic]
    covariance: list[list[float]]
    rms_px: float
    noise_px: float
    noise_length_px: float
    effective_corners: float
    repeats: Repeats | None
    coverage: float
    images: list[BoardImage]
    warnings: list[str]
    lens: str
    validated_px: float | None
    error_ratio: float
    projection_sigma_px: list[list[float | None]]
    sheet: list[Intrinsic]


def write_camera(calibration: CameraCalibration, path: Path) -> None:
    """Write a camera; an earlier one of this command is replaced, any other file is not.

    Raises
    ------
    UsageError
        If another file stands there, or none can be written.
    OutOfResources
        If the file cannot be written.
    """
    names, sigma = calibration.names, calibration.sigma.tolist()
    block = {
        "version": 1,
        "rms_px": _short(calibration.rms_px),
        "coverage": _short(calibration.coverage),
        "lens": calibration.lens,
        "validated_px": calibration.validated_px and _short(calibration.validated_px),
        "sheet": {
            name: {"value": _short(v), "sigma": _short(s)}
            for name, v, s in zip(
                SHEET, calibration.sheet.tolist(), calibration.sheet_sigma.tolist(), strict=True
            )
        },
        "sigma": {name: _short(s) for name, s in zip(names, sigma, strict=True)},
        "names": list(names),
        "covariance": calibration.covariance.tolist(),
        "covered": [
            [_short(x) for x in corner] for corner in covered(calibration.corners[:, :2]).tolist()
        ],
        "images": [
            {"image": i.image, "corners": i.used, "rms_px": _short(i.rms_px)}
            for i in calibration.images
            if i.rms_px is not None
        ],
        "photographs": {key: list(values) for key, values in calibration.photographs.items()},
        "warnings": list(calibration.warnings),
    }
    text = camera_info(calibration.camera, path.stem, {CALIBRATED: block})
    CAMERA_FILE.write(path, text)


def _short(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


def write_picture(calibration: CameraCalibration, path: Path) -> None:
    """Write the picture as PNG; an earlier one of this command is replaced, any other file is not.

    Raises
    ------
    UsageError
        If another file stands there, or none can be written.
    OutOfResources
        If the file cannot be written.
    """
    mark, png = PngInfo(), BytesIO()
    mark.add_text(*_MARK)
    Image.fromarray(_picture(calibration)[..., ::-1]).save(png, "PNG", pnginfo=mark)
    PICTURE_FILE.write(path, png.getvalue())


def _picture(calibration: CameraCalibration) -> NDArray[np.uint8]:
    """Return the picture (BGR): cells coloured by number of corners, arrows of mean residuals."""
    camera = calibration.camera
    factor = _LONGER / max(camera.width, camera.height)
    side = _LONGER / _CELLS
    width, height = (round(factor * n) for n in (camera.width, camera.height))
    canvas = np.full((height, width, 3), _DARK, dtype=np.uint8)
    points = (calibration.corners[:, :2] + 0.5) * factor
    cell = np.floor(points / side).astype(np.intp)
    shape = int(np.ceil(height / side)), int(np.ceil(width / side))
    index = np.clip(cell[:, 1], 0, shape[0] - 1) * shape[1] + np.clip(cell[:, 0], 0, shape[1] - 1)
    count = np.bincount(index, minlength=shape[0] * shape[1])
    mean = (
        np.stack([np.bincount(index, r, len(count)) for r in calibration.corners[:, 2:].T], axis=-1)
        / np.maximum(count, 1)[:, None]
    )
    enough = count >= _LEAST_ARROW
    longest = float(np.linalg.norm(mean[enough], axis=1).max()) if enough.any() else 0.0
    scale = _ARROW * side / max(longest, 1e-9)
    full = max(float(np.quantile(count[count > 0], 0.9)), 1.0) if count.any() else 1.0
    for k in range(len(count)):
        y, x = divmod(k, shape[1])
        low = round(x * side) + 1, round(y * side) + 1
        high = min(round((x + 1) * side), width) - 1, min(round((y + 1) * side), height) - 1
        share = 0.25 + 0.75 * min(count[k] / full, 1.0)
        colour = _EMPTY if not count[k] else tuple(int(share * c) for c in _SEEN)
        cv2.rectangle(canvas, low, high, colour, -1)
    for point in points:
        cv2.circle(canvas, tuple(np.rint(point).astype(int).tolist()), 1, (150, 180, 130), -1)
    for drawn in np.flatnonzero(enough).tolist():
        y, x = divmod(drawn, shape[1])
        middle = (np.array([x, y]) + 0.5) * side
        start, end = (
            tuple(np.rint(p).astype(int).tolist())
            for p in (middle - scale * mean[drawn], middle + scale * mean[drawn])
        )
        cv2.arrowedLine(canvas, start, end, _RESIDUAL, 2, cv2.LINE_AA, tipLength=0.3)
    places = camera.grid(*GRID).reshape(*GRID[::-1], 2)[::_LABELLED, ::_LABELLED].reshape(-1, 2)
    sigmas = calibration.projection_sigma[::_LABELLED, ::_LABELLED].ravel()
    for place, sigma in zip(places, sigmas.tolist(), strict=True):
        label = f"{sigma:.2g}"
        (w, h), _ = cv2.getTextSize(label, cv2.FONT_HERSHEY_SIMPLEX, _LETTER, 1)
        at = np.rint(place * factor - [0.5 * w, -0.5 * h]).astype(int)
        left, bottom = np.clip(at, [12, 12 + h], [width - w - 12, height - 12]).tolist()
        origin = left, bottom
        cv2.putText(
            canvas, label, origin, cv2.FONT_HERSHEY_SIMPLEX, _LETTER, _WHITE, 1, cv2.LINE_AA
        )
    centre = tuple(np.rint((camera.K[:2, 2] + 0.5) * factor).astype(int).tolist())
    cv2.drawMarker(canvas, centre, _CENTRE, cv2.MARKER_CROSS, 24, 2, cv2.LINE_AA)
    validated_px = calibration.validated_px
    lines = (
        f"{camera.model}, {len(points)} corners, {calibration.rms_px:.3f} px off (rms)"
        + ("" if validated_px is None else f", {validated_px:.3f} px in held-out images"),
        f"arrows: mean residual of a cell, the longest {longest:.3f} px; green: corners, brighter "
        "where more; red: none; cross: principal point; numbers: projection, 1 sigma [px]",
    )
    legend = np.full((62, width, 3), _DARK, dtype=np.uint8)
    for row, line in enumerate(lines):
        (w, _), _ = cv2.getTextSize(line, cv2.FONT_HERSHEY_SIMPLEX, _LETTER, 1)
        letter_scale = _LETTER * min(1.0, (width - 20) / w)
        origin = (10, 24 + 26 * row)
        cv2.putText(
            legend, line, origin, cv2.FONT_HERSHEY_SIMPLEX, letter_scale, _WHITE, 1, cv2.LINE_AA
        )
    return np.vstack([canvas, legend])
