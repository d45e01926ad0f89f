"""The calibrated camera: pinhole projection with lens distortion, by OpenCV.

The camera frame has x to the right, y down, z forward. The *sensor plane* of eq (2) is the
undistorted plane z = 1: a point of it is (x, y, 1), without unit. Pixel (0, 0) is the centre
of the top-left pixel.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np

from legcal.geometry.types import Array

DistortionModel = Literal["plumb_bob", "rational_polynomial", "equidistant"]

_UNDISTORT_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-14)
_STEP = 1e-6  # of the central differences of undistortion, in units of the sensor plane


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics of a camera.

    Attributes
    ----------
    K : (3, 3) array
        Camera matrix [px].
    distortion : (n,) array
        Coefficients in OpenCV's order; empty for a camera without distortion.
    width, height : int
        Image size [px].
    model : {"plumb_bob", "rational_polynomial", "equidistant"}
        Meaning of the coefficients: OpenCV's usual model with 5 or 8 of them, or its
        fisheye model with 4.
    gamma : float
        Grey levels are light to the power 1 / gamma; 1 for a camera whose levels are proportional
        to light.
    gamma_is_told : bool
        False if nobody said so: outlines are then measured with ``gamma`` for a start, and a fit
        looks for the true one.
    sigma : mapping
        Standard deviations of its numbers, by the names of
        :func:`legcal.vision.intrinsics.intrinsic_names` [px; distortion without unit]; those that
        nobody stated are missing.
    """

    K: Array
    width: int
    height: int
    distortion: Array = field(default_factory=lambda: np.zeros(0))
    model: DistortionModel = "plumb_bob"
    gamma: float = 1.0
    gamma_is_told: bool = True
    sigma: Mapping[str, float] = field(default_factory=dict)

    @property
    def has_distortion(self) -> bool:
        """Whether any distortion coefficient differs from zero."""
        return bool(np.any(self.distortion != 0.0)) or self.model == "equidistant"

    def project(self, P_camera: Array) -> Array:
        """Return the pixels at which points are seen.

        Parameters
        ----------
        P_camera : (..., 3) array
            Points in front of the camera, in its frame [m].

        Returns
        -------
        (..., 2) array
            Pixels.
        """
        xy = P_camera[..., :2] / P_camera[..., 2:]
        return self.distort(xy)

    def distort(self, xy: Array) -> Array:
        """Return the pixels of points (x, y) of the sensor plane, both (..., 2)."""
        if not self.has_distortion:
            return np.asarray(xy @ self.K[:2, :2].T + self.K[:2, 2])
        flat = np.ascontiguousarray(xy, dtype=np.float64).reshape(-1, 1, 2)
        if self.model == "equidistant":
            pixels = cv2.fisheye.distortPoints(flat, self.K, self.distortion)
        else:
            rays = np.concatenate([flat[:, 0], np.ones((len(flat), 1))], axis=1)
            zero = np.zeros(3)
            pixels, _ = cv2.projectPoints(rays, zero, zero, self.K, self.distortion)
        return np.asarray(pixels, dtype=np.float64).reshape(xy.shape)

    def undistort(self, pixels: Array) -> Array:
        """Return the points (x, y) of the sensor plane seen at pixels, both (..., 2)."""
        if not self.has_distortion:
            centred = pixels - self.K[:2, 2]
            return np.asarray(centred @ np.linalg.inv(self.K[:2, :2]).T)
        flat = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        if self.model == "equidistant":
            xy = cv2.fisheye.undistortPoints(
                flat, self.K, self.distortion, criteria=_UNDISTORT_CRITERIA
            )
        else:
            xy = cv2.undistortPointsIter(
                flat, self.K, self.distortion, np.eye(3), np.eye(3), _UNDISTORT_CRITERIA
            )
        return np.asarray(xy, dtype=np.float64).reshape(pixels.shape)

    def pixels_per_unit(self, xy: Array) -> Array:
        """Return the derivative of pixels with respect to the sensor plane, at (x, y).

        Parameters
        ----------
        xy : (..., 2) array
            Points of the sensor plane.

        Returns
        -------
        (..., 2, 2) array
            d(u, v) / d(x, y) [px].
        """
        if not self.has_distortion:
            return np.broadcast_to(self.K[:2, :2], (*xy.shape[:-1], 2, 2)).copy()
        steps = _STEP * np.eye(2)
        columns = [(self.distort(xy + s) - self.distort(xy - s)) / (2.0 * _STEP) for s in steps]
        return np.stack(columns, axis=-1)

    def line_offset(self, h: Array, xy: Array) -> Array:
        """Return the signed distance in the image of points from lines.

        To first order in the distance, with the scale and the distortion of the lens at the
        point. Positive on the side where h . (x, y, 1) > 0.

        Parameters
        ----------
        h : (..., 3) array
            Lines (a, b, c) of the sensor plane, eq (2).
        xy : (..., 2) array
            Points of the sensor plane.

        Returns
        -------
        (...) array
            Distances [px].
        """
        # An offset d(u, v) in the image is J d(x, y), so the line's normal there is J^-T (a, b).
        J = self.pixels_per_unit(xy)
        normal = np.linalg.solve(np.swapaxes(J, -1, -2), h[..., :2, None])[..., 0]
        value = np.sum(h[..., :2] * xy, axis=-1) + h[..., 2]
        return np.asarray(value / np.linalg.norm(normal, axis=-1))
