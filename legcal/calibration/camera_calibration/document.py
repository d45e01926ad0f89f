"""The calibration of a camera, its document, and the camera file: written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from legcal.brief import brief
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
    """The result of :func:`legcal.calibrate_camera`.

    Attributes
    ----------
    camera : Camera
        The camera.
    covariance : (k, k) array
        Covariance of its intrinsics, in the order of ``names`` [px, and without unit].
    board : Board
        The calibration board.
    images : tuple of BoardImage
        All images in the given order.
    rms_px : float
        Root mean square of the residuals, both coordinates together [px].
    noise_px : float
        Scatter of either coordinate of a corner, one standard deviation [px].
    coverage : float
        Share of the image inside the convex hull of all corners.
    warnings : tuple of str
        Warnings, one sentence each.
    sheet : (4,) array
        Bending of the board along x and y and its twist [m], relative excess width of the print.
    sheet_covariance : (4, 4) array
        Covariance of ``sheet``.
    error_ratio : float
        Ratio of the errors, by residuals or by disagreement of images, to the claimed sigmas.
    lens : str
        The lens model, and the reason for choosing it.
    validated_px : float or None
        Root mean square of the residuals of held-out images in cross-validation [px]; None with
        fewer than four images.
    corners : (n, 4) array
        Pixels and residuals of the used corners [px].
    photographs : mapping
        Metadata of the used image files: distinct values by key of the camera file.
    """

    camera: Camera
    covariance: Array
    board: Board
    images: tuple[BoardImage, ...]
    rms_px: float
    noise_px: float
    coverage: float
    warnings: tuple[str, ...]
    sheet: Array
    sheet_covariance: Array
    error_ratio: float
    lens: str
    validated_px: float | None
    corners: Array
    photographs: Mapping[str, Sequence[Any]] = field(default_factory=dict)

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
        return CameraDocument(
            legcal_camera=1,
            model=self.camera.model,
            width=self.camera.width,
            height=self.camera.height,
            intrinsics=[Intrinsic(name=name, value=v, sigma=sigma) for name, v, sigma in numbers],
            covariance=self.covariance.tolist(),
            rms_px=self.rms_px,
            noise_px=self.noise_px,
            coverage=self.coverage,
            images=list(self.images),
            warnings=list(self.warnings),
            lens=self.lens,
            validated_px=self.validated_px,
            error_ratio=self.error_ratio,
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
