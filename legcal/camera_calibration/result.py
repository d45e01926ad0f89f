"""A calibrated camera: its numbers with their standard deviations, and what it rests on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from legcal.geometry.types import Array
from legcal.vision.board import Board
from legcal.vision.camera import Camera
from legcal.vision.intrinsics import intrinsic_names, intrinsic_values


@dataclass(frozen=True)
class ImageResult:
    """What an image gave.

    Attributes
    ----------
    name : str
        Its file.
    corners : int
        Of the board, found in it.
    used : int
        Those that were used.
    rms_px : float or None
        Of their residuals, both coordinates together [px]; None if the image was left out.
    tilt : float or None
        Of the board out of the image plane [rad].
    reason : str
        Why it was left out, "" if it was not.
    """

    name: str
    corners: int
    used: int
    rms_px: float | None
    tilt: float | None
    reason: str


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """The result of :func:`legcal.calibrate_camera`.

    Attributes
    ----------
    camera : Camera
        The camera.
    covariance : (k, k) array
        Of its numbers, in the order of ``names`` [px, and without unit].
    board : Board
        The board that it was calibrated with.
    images : tuple of ImageResult
        All images, in their order.
    rms_px : float
        Of the residuals, both coordinates together [px].
    noise_px : float
        Scatter of either coordinate of a corner, one standard deviation [px].
    coverage : float
        Share of the image inside the convex hull of all corners.
    warnings : tuple of str
        What is wrong with it, one sentence each.
    """

    camera: Camera
    covariance: Array
    board: Board
    images: tuple[ImageResult, ...]
    rms_px: float
    noise_px: float
    coverage: float
    warnings: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers: ``fx fy cx cy``, then the distortion in OpenCV's order."""
        return intrinsic_names(self.camera)

    @property
    def values(self) -> Array:
        """The numbers, (k,) [px, and without unit]."""
        return intrinsic_values(self.camera)

    @property
    def sigma(self) -> Array:
        """Their standard deviations, (k,) [px, and without unit]."""
        return np.sqrt(np.diag(self.covariance))

    def document(self) -> dict[str, Any]:
        """Return what ``--json`` prints."""
        numbers = zip(self.names, self.values.tolist(), self.sigma.tolist(), strict=True)
        return {
            "legcal_camera": 1,
            "model": self.camera.model,
            "width": self.camera.width,
            "height": self.camera.height,
            "intrinsics": [
                {"name": name, "value": value, "sigma": sigma} for name, value, sigma in numbers
            ],
            "covariance": self.covariance.tolist(),
            "rms_px": self.rms_px,
            "noise_px": self.noise_px,
            "coverage": self.coverage,
            "images": [
                {
                    "image": image.name,
                    "corners": image.corners,
                    "used": image.used,
                    "rms_px": image.rms_px,
                    "tilt_rad": image.tilt,
                    "reason": image.reason or None,
                }
                for image in self.images
            ],
            "warnings": list(self.warnings),
        }
