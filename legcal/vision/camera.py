"""The camera: a pinhole with a distortion model of OpenCV or a splined one, its intrinsics by name.

A distortion model is one entry of ``DISTORTION_MODELS`` and its name in
:mod:`legcal.vision.distortion`, for use in files, fits and the calibration of cameras.

Views with the same intrinsics are assumed to be from one camera: they share the intrinsics, under
the name of the first view in the order of names.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from math import factorial
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from legcal.geometry.types import Array, BoolArray
from legcal.vision.distortion import DistortionModel

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

_UNDISTORT_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-14)
MAX_RADIUS = 10.0  # maximum radius of the search on the sensor plane
N_DIRECTIONS, N_RADII = 16, 256  # grid for the search of folds of a lens
_NEWTON_STEPS, _SMALL_STEP = 8, 1e-9  # maximum number, and last size, of steps of undistortion
_STEP = 1e-6  # step of central differences of undistortion, in units of the sensor plane
_REACHED_PX = 0.1  # error of undistortion from which on a lens model does not reach a pixel


@dataclass(frozen=True)
class Distortion:
    """A distortion model: the names of its coefficients, and its functions.

    The functions take a camera matrix K and all coefficients; points are (n, 1, 2).
    """

    coefficients: tuple[str, ...]  # in OpenCV's order
    counts: tuple[int, ...]  # numbers of coefficients that a file may give; the others are zero
    prior_sigma: float  # prior standard deviation of a coefficient
    distort: Callable[[Array, Array, Array], Array]  # (x, y) of the sensor plane to pixels
    undistort: Callable[[Array, Array, Array], Array]  # pixels to (x, y)
    # pixels (n, 1, 2), and their derivatives (2 n, 2 + 4 + m) by x and y, then by intrinsics
    with_derivatives: Callable[[Array, Array, Array], tuple[Array, Array]]
    aliases: tuple[str, ...] = ()  # its names in the files of other programs
    is_fisheye: bool = False  # distorts with all coefficients zero
    is_of_opencv: bool = True  # whether other programs have it


def _polynomial_distort(xy: Array, K: Array, coefficients: Array) -> Array:
    rays = np.concatenate([xy[:, 0], np.ones((len(xy), 1))], axis=1)
    zero = np.zeros(3)
    return np.asarray(cv2.projectPoints(rays, zero, zero, K, coefficients)[0])


def _polynomial_undistort(pixels: Array, K: Array, coefficients: Array) -> Array:
    identity = np.eye(3)
    return np.asarray(
        cv2.undistortPointsIter(pixels, K, coefficients, identity, identity, _UNDISTORT_CRITERIA)
    )


def _polynomial_derivatives(xy: Array, K: Array, coefficients: Array) -> tuple[Array, Array]:
    rays = np.concatenate([xy[:, 0], np.ones((len(xy), 1))], axis=1).reshape(-1, 1, 3)
    zero = np.zeros(3)
    pixels, J = cv2.projectPoints(rays, zero, zero, K, coefficients)
    by_translation, by_intrinsics = J[:, 3:5], J[:, 6:]
    return np.asarray(pixels), np.concatenate([by_translation, by_intrinsics], axis=1)


def _fisheye_distort(xy: Array, K: Array, coefficients: Array) -> Array:
    return np.asarray(cv2.fisheye.distortPoints(xy, K, coefficients))


def _fisheye_undistort(pixels: Array, K: Array, coefficients: Array) -> Array:
    return np.asarray(
        cv2.fisheye.undistortPoints(pixels, K, coefficients, criteria=_UNDISTORT_CRITERIA)
    )


def _fisheye_derivatives(xy: Array, K: Array, coefficients: Array) -> tuple[Array, Array]:
    rays = np.concatenate([xy[:, 0], np.ones((len(xy), 1))], axis=1).reshape(-1, 1, 3)
    zero = np.zeros(3)
    pixels, J = cv2.fisheye.projectPoints(rays, zero, zero, K, coefficients)
    by_translation, by_intrinsics = J[:, 11:13], J[:, :8]
    return np.asarray(pixels), np.concatenate([by_translation, by_intrinsics], axis=1)


# A splined lens images a ray at an angle theta to the axis at theta (1 + h(theta)) focal lengths
# from the principal point. Its coefficients are h at multiples of 15 deg; h is the even spline of
# degree 5 through them with h(0) = 0, so that the radius has the slope 1 there.
_KNOTS = np.radians(15.0 * np.arange(1, 7))
_ANGLES = np.linspace(0.0, 0.5 * np.pi, 721)[:-1]  # of the table from which undistortion starts


@cache
def _spline_of_each() -> BSpline:
    """Return the splines h of unit coefficients, by an angle: with values (..., 6)."""
    from scipy.interpolate import make_interp_spline  # only where a lens is splined

    angles = np.concatenate([-_KNOTS[::-1], [0.0], _KNOTS])
    return make_interp_spline(angles, np.vstack([np.eye(6)[::-1], np.zeros(6), np.eye(6)]), k=5)


def _splined_radius(theta: Array, h: Array) -> tuple[Array, Array]:
    """Return the radius at angles (n,) to the axis, and its derivative, (n,) each."""
    spline = _spline_of_each()
    times = 1.0 + spline(theta) @ h
    return theta * times, times + theta * (spline(theta, 1) @ h)


def _splined_distort(xy: Array, K: Array, h: Array) -> Array:
    r = np.linalg.norm(xy, axis=2, keepdims=True)
    radius = _splined_radius(np.arctan(r[:, 0, 0]), h)[0][:, None, None]
    return np.asarray(xy * (radius / np.maximum(r, 1e-300)) @ K[:2, :2].T + K[:2, 2])


def _splined_undistort(pixels: Array, K: Array, h: Array) -> Array:
    """Return the points at pixels: by a table up to the fold of the lens, then Newton's method."""
    xy = (pixels - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T
    radius = np.linalg.norm(xy, axis=2)[:, 0]
    table = _splined_radius(_ANGLES, h)[0]
    folds = np.diff(table, append=-np.inf) <= 0.0
    n = int(np.argmax(folds)) + 1
    theta = np.interp(radius, table[:n], _ANGLES[:n])
    for _ in range(3):
        at, slope = _splined_radius(theta, h)
        theta = np.clip(theta - (at - radius) / np.maximum(slope, 1e-3), 0.0, _ANGLES[n - 1])
    return np.asarray(xy * (np.tan(theta) / np.maximum(radius, 1e-300))[:, None, None])


def _splined_derivatives(xy: Array, K: Array, h: Array) -> tuple[Array, Array]:
    r = np.maximum(np.linalg.norm(xy[:, 0], axis=1), 1e-300)
    outwards, theta = xy[:, 0] / r[:, None], np.arctan(r)
    radius, slope = _splined_radius(theta, h)
    along = outwards[:, :, None] * outwards[:, None, :]
    across = np.where(r[:, None, None] > 1e-9, np.eye(2) - along, np.eye(2))
    times = np.where(r > 1e-9, radius / r, 1.0)[:, None, None]
    by_xy = (slope / (1.0 + r**2))[:, None, None] * (np.eye(2) - across) + times * across
    by_h = outwards[:, :, None] * (theta[:, None] * _spline_of_each()(theta))[:, None, :]
    f = np.diag(K)[:2]
    by_f = np.eye(2) * (outwards * radius[:, None])[:, :, None]
    by_c = np.broadcast_to(np.eye(2), by_f.shape)
    J = np.concatenate([f[:, None] * by_xy, by_f, by_c, f[:, None] * by_h], axis=2)
    return _splined_distort(xy, K, h), J.reshape(2 * len(xy), -1)


_SPLINED = _splined_distort, _splined_undistort, _splined_derivatives
_POLYNOMIAL = _polynomial_distort, _polynomial_undistort, _polynomial_derivatives
_FISHEYE = _fisheye_distort, _fisheye_undistort, _fisheye_derivatives
DISTORTION_MODELS: Mapping[DistortionModel, Distortion] = {
    "plumb_bob": Distortion(
        ("k1", "k2", "p1", "p2", "k3"), (0, 4, 5), 100.0, *_POLYNOMIAL, aliases=("radtan", "none")
    ),
    # The coefficients of numerator and denominator may cancel each other.
    "rational_polynomial": Distortion(
        ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), (8,), 1.0, *_POLYNOMIAL
    ),
    "thin_prism": Distortion(
        ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4"),
        (12,),
        1.0,
        *_POLYNOMIAL,
    ),
    "equidistant": Distortion(
        ("k1", "k2", "k3", "k4"),
        (4,),
        100.0,
        *_FISHEYE,
        aliases=("fisheye", "equi"),
        is_fisheye=True,
    ),
    "splined_radial": Distortion(
        ("h15", "h30", "h45", "h60", "h75", "h90"),
        (6,),
        1.0,
        *_SPLINED,
        is_fisheye=True,
        is_of_opencv=False,
    ),
}


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics of a camera."""

    K: Array  # (3, 3) camera matrix [px]
    width: int  # of the image [px]
    height: int  # of the image [px]
    distortion: Array = field(default_factory=lambda: np.zeros(0))  # (n,)
    model: DistortionModel = "plumb_bob"  # meaning of the coefficients
    gamma: float = 1.0  # grey levels are light to the power 1 / gamma
    gamma_is_given: bool = True  # false where it is assumed
    # (n, n) of ``intrinsic_names``, zero for exact values; None if not stated
    covariance: Array | None = None
    # Metadata of the photographs used for its calibration, if recorded
    photographs: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    # (k, 2): corners of the convex part of the image in which its calibration saw boards [px];
    # none if that is not known
    covered: Array = field(default_factory=lambda: np.zeros((0, 2)))

    @cached_property
    def has_distortion(self) -> bool:
        """Whether any distortion coefficient differs from zero."""
        return bool(np.any(self.distortion != 0.0)) or DISTORTION_MODELS[self.model].is_fisheye

    @property
    def corners(self) -> Array:
        """The outermost pixels of the image, (4, 2)."""
        x, y = self.width - 1.0, self.height - 1.0
        return np.array([[0.0, 0.0], [x, 0.0], [0.0, y], [x, y]])

    def grid(self, n_columns: int, n_rows: int) -> Array:
        """Return pixels (n, 2) all over the image at even distances, row by row."""
        u, v = (
            np.linspace(0.0, self.width - 1.0, n_columns),
            np.linspace(0.0, self.height - 1.0, n_rows),
        )
        return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)

    def reaches(self, pixels: Array) -> BoolArray:
        """Return a mask (n,) of pixels (n, 2) that have a ray: none where the lens folds back."""
        off = np.linalg.norm(self.distort(self.undistort(pixels)) - pixels, axis=1)
        return np.asarray(off < _REACHED_PX)

    @property
    def turns_back(self) -> float | None:
        """Angle at which a splined radius stops growing inside the image [rad]; None for others."""
        if self.model != "splined_radial":
            return None
        away = (self.corners - self.K[:2, 2]) @ np.linalg.inv(self.K[:2, :2]).T
        radius = _splined_radius(_ANGLES, self.distortion)[0]
        inside = np.maximum.accumulate(radius)[:-1] < np.linalg.norm(away, axis=1).max()
        back = np.flatnonzero(inside & (np.diff(radius) <= 0.0))
        return float(_ANGLES[back[0]]) if len(back) else None

    @cached_property
    def unfolded(self) -> float:
        """Radius on the sensor plane up to which the radius in the image increases.

        Beyond it the polynomials of a lens may fold points back into the image.
        """
        border_radius = float(np.linalg.norm(self.undistort(self.corners), axis=1).max())
        most = 1.1 * (border_radius if border_radius < MAX_RADIUS else MAX_RADIUS)
        turn = np.linspace(0.0, 2.0 * np.pi, N_DIRECTIONS, endpoint=False)
        radius = np.linspace(0.0, most, N_RADII)
        rays = radius[:, None, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        image_radius = np.linalg.norm(self.distort(rays) - self.K[:2, 2], axis=-1)
        folds = np.any(np.diff(image_radius, axis=0) <= 0.0, axis=1)
        return float(radius[max(int(np.argmax(folds)) - 1, 0)] if folds.any() else most)

    def project(
        self,
        P_camera: Array,  # (..., 3) points in front of the camera, in its frame [m]
    ) -> Array:
        """Return the pixels (..., 2) of points."""
        xy = P_camera[..., :2] / P_camera[..., 2:]
        return self.distort(xy)

    def project_with_derivative(self, P_camera: Array) -> tuple[Array, Array]:
        """Return pixels (n, 2) of points (n, 3), and their derivatives (n, 2, 3) [px/m]."""
        xy = P_camera[:, :2] / P_camera[:, 2:]
        by_point = np.zeros((len(xy), 2, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0
        by_point[:, :, 2] = -xy
        by_point = self.pixels_per_unit(xy) @ by_point / P_camera[:, 2, None, None]
        return self.distort(xy), by_point

    def distort(self, xy: Array) -> Array:
        """Return the pixels of points (x, y) of the sensor plane, both (..., 2)."""
        if not self.has_distortion:
            return np.asarray(xy @ self.K[:2, :2].T + self.K[:2, 2])
        if xy.size == 0:  # OpenCV refuses to project nothing
            return np.zeros(xy.shape)
        flat = np.ascontiguousarray(xy, dtype=np.float64).reshape(-1, 1, 2)
        pixels = DISTORTION_MODELS[self.model].distort(flat, self.K, self.distortion)
        return np.asarray(pixels, dtype=np.float64).reshape(xy.shape)

    def undistort(self, pixels: Array) -> Array:
        """Return the points (x, y) of the sensor plane seen at pixels, both (..., 2)."""
        if not self.has_distortion:
            centred = pixels - self.K[:2, 2]
            return np.asarray(centred @ np.linalg.inv(self.K[:2, :2]).T)
        if pixels.size == 0:
            return np.zeros(pixels.shape)
        flat = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        xy = DISTORTION_MODELS[self.model].undistort(flat, self.K, self.distortion)
        return np.asarray(xy, dtype=np.float64).reshape(pixels.shape)

    def rays(self, pixels: Array) -> Array:
        """Return the rays (..., 3) through pixels (..., 2), as points of the plane z = 1."""
        xy = self.undistort(pixels)
        return np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)

    def pixels_per_unit(
        self,
        xy: Array,  # (..., 2) points of the sensor plane
    ) -> Array:
        """Return the derivative of pixels with respect to the sensor plane, at (x, y)."""
        if not self.has_distortion:
            return np.broadcast_to(self.K[:2, :2], (*xy.shape[:-1], 2, 2)).copy()
        steps = _STEP * np.eye(2)
        around = self.distort(np.stack([xy + sign * step for sign in (1, -1) for step in steps]))
        return np.stack(list((around[:2] - around[2:]) / (2.0 * _STEP)), axis=-1)

    def line_offset(
        self,
        h: Array,  # (..., 3) lines (a, b, c) of the sensor plane, eq (2)
        xy: Array,  # (..., 2) points of the sensor plane
    ) -> Array:
        """Return the signed distance in the image of points from lines, (...) [px].

        To first order in the distance, with the scale and the distortion of the lens at the
        point. Positive on the side where h . (x, y, 1) > 0.
        """
        # An offset d(u, v) in the image is J d(x, y), so the line's normal there is J^-T (a, b).
        J = self.pixels_per_unit(xy)
        normal = np.linalg.solve(np.swapaxes(J, -1, -2), h[..., :2, None])[..., 0]
        value = np.sum(h[..., :2] * xy, axis=-1) + h[..., 2]
        return np.asarray(value / np.linalg.norm(normal, axis=-1))


_PINHOLE = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}  # indices in K


def sample_camera() -> Camera:
    """Return a camera of 1024 x 768 pixels without distortion, 43 degrees wide: the example's."""
    K = np.array([[1290.3, 0.0, 518.3], [0.0, 1290.3, 379.6], [0.0, 0.0, 1.0]])
    return Camera(K, 1024, 768)


def _coefficients(camera: Camera) -> tuple[str, ...]:
    return DISTORTION_MODELS[camera.model].coefficients


def intrinsic_names(camera: Camera) -> tuple[str, ...]:
    """Return the names of a camera's intrinsics: ``fx fy cx cy``, then its distortion.

    A plumb_bob camera has all five coefficients, also where its file leaves some out as
    zero. OpenCV's distortion knows no skew: a camera with skew and without distortion has none.
    """
    if camera.K[0, 1] != 0.0 and not camera.has_distortion:
        return tuple(_PINHOLE)
    return (*_PINHOLE, *_coefficients(camera))


def intrinsic_unit(name: str) -> str:
    """Return the unit of an intrinsic: ``px``, or nothing for a coefficient of distortion."""
    return "px" if name in _PINHOLE else ""


def intrinsic_values(camera: Camera) -> Array:
    """Return the values of :func:`intrinsic_names`, (n,) [px; distortion without unit]."""
    pinhole = [camera.K[place] for place in _PINHOLE.values()]
    return np.array([*pinhole, *_padded(camera)])[: len(intrinsic_names(camera))]


def with_intrinsics(camera: Camera, values: Mapping[str, float]) -> Camera:
    """Return a camera with some of its intrinsics replaced."""
    K, distortion = camera.K.copy(), _padded(camera)
    for name, value in values.items():
        if name in _PINHOLE:
            K[_PINHOLE[name]] = value
        else:
            distortion[_coefficients(camera).index(name)] = value
    if values.keys() <= _PINHOLE.keys():
        distortion = camera.distortion
    return replace(camera, K=K, distortion=distortion)


def undistort_near(camera: Camera, pixels: Array, near: Array) -> Array:
    """Return the points (..., 2) of the sensor plane at pixels, by points (..., 2) near them."""
    if not pixels.size:  # OpenCV refuses to project nothing
        return pixels
    xy = _undistorted(camera, pixels.reshape(-1, 2), near.reshape(-1, 2))
    return xy.reshape(pixels.shape)


def pixel_derivatives(camera: Camera, xy: Array, names: Sequence[str]) -> tuple[Array, Array]:
    """Return derivatives of the pixels of points (..., 2): by the points, and by intrinsics.

    They are (..., 2, 2) and (..., 2, n_names).
    """
    if not xy.size:
        return np.zeros((*xy.shape, 2)), np.zeros((*xy.shape, len(names)))
    _, by_xy, by_intrinsics = _with_derivatives(camera, xy.reshape(-1, 2), names)
    return by_xy.reshape(*xy.shape, 2), by_intrinsics.reshape(*xy.shape, len(names))


def _undistorted(camera: Camera, pixels: Array, near: Array) -> Array:
    """Return points (n, 2) at pixels, by Newton's method from points nearby if it converges."""
    xy = near
    for _ in range(_NEWTON_STEPS if camera.has_distortion else 0):
        projected, by_point, _ = _with_derivatives(camera, xy, ())
        step = np.linalg.solve(by_point, (pixels - projected)[..., None])[..., 0]
        xy = xy + step
        if np.abs(step).max() < _SMALL_STEP:
            return np.asarray(xy)
    return camera.undistort(pixels)


def splined(camera: Camera) -> Camera:
    """Return an equidistant camera as a splined one."""
    h = sum(k * _KNOTS ** (2 * i) for i, k in enumerate(camera.distortion.tolist(), start=1))
    return replace(camera, distortion=np.asarray(h), model="splined_radial")


def spline_pieces(camera: Camera) -> list[list[float]]:
    """Return h of a splined camera as polynomials from 0, 15, 30, 45, 60 and 75 deg on [rad]."""
    start = np.concatenate([[0.0], _KNOTS[:-1]])
    spline = _spline_of_each()
    terms = [spline(start, n) @ camera.distortion / factorial(n) for n in range(spline.k + 1)]
    return [[float(term[k]) for term in terms] for k in range(len(start))]


def shared_cameras(names: Sequence[str], cameras: Sequence[Camera]) -> tuple[str, ...]:
    """Return for each view the name of the first view with the same intrinsics."""
    keys = [tuple(camera_numbers(camera).items()) for camera in cameras]
    owner: dict[object, str] = {}
    for name, key in sorted(zip(names, keys, strict=True), key=lambda pair: pair[0]):
        owner.setdefault(key, name)
    return tuple(owner[key] for key in keys)


def stated_covariances(names: Sequence[str], cameras: Sequence[Camera]) -> dict[str, Array]:
    """Return the stated covariances of intrinsics by the view that names each camera.

    Among several files with the same numbers, the covariance of the first view counts.
    """
    covariances: dict[str, Array] = {}
    owners = shared_cameras(names, cameras)
    for _, owner, camera in sorted(zip(names, owners, cameras, strict=True), key=lambda v: v[0]):
        if camera.covariance is not None:
            covariances.setdefault(owner, camera.covariance)
    return covariances


def camera_numbers(camera: Camera) -> dict[str, float | str]:
    """Return all that distinguishes cameras: size, model and intrinsics, by their names."""
    numbers = zip(intrinsic_names(camera), intrinsic_values(camera).tolist(), strict=True)
    skew = float(camera.K[0, 1])
    size = {"width": camera.width, "height": camera.height, "model": camera.model}
    return size | {"skew": skew} | dict(numbers)


def _padded(camera: Camera) -> Array:
    """Return all the coefficients of a camera's model, with zeros for omitted ones."""
    distortion = np.zeros(len(_coefficients(camera)))
    distortion[: len(camera.distortion)] = camera.distortion
    return distortion


def project_with_derivatives(
    camera: Camera, P_camera: Array, names: Sequence[str]
) -> tuple[Array, Array, Array]:
    """Return pixels (n, 2) of points (n, 3), and their derivatives by points and by intrinsics.

    The derivatives are (n, 2, 3) [px/m] and (n, 2, n_names). The camera must have no skew.
    """
    xy = P_camera[:, :2] / P_camera[:, 2:]
    pixels, by_xy, by_intrinsics = _with_derivatives(camera, xy, names)
    by_point = np.concatenate([by_xy, -by_xy @ xy[:, :, None]], axis=2)
    return pixels, by_point / P_camera[:, 2, None, None], by_intrinsics


def _with_derivatives(
    camera: Camera, xy: Array, names: Sequence[str]
) -> tuple[Array, Array, Array]:
    """Return pixels (n, 2) of points (n, 2), derivatives by these (n, 2, 2), and by intrinsics.

    The camera is assumed to have no skew.
    """
    intrinsics = (*_PINHOLE, *_coefficients(camera))
    with_derivatives = DISTORTION_MODELS[camera.model].with_derivatives
    pixels, J = with_derivatives(xy.reshape(-1, 1, 2), camera.K, _padded(camera))
    J = J.reshape(len(xy), 2, 2 + len(intrinsics))
    by_point = J[:, :, :2] if camera.has_distortion else camera.pixels_per_unit(xy)
    columns = [2 + intrinsics.index(name) for name in names]
    return pixels.reshape(-1, 2), by_point, np.asarray(J[:, :, columns])
