"""A straight band of the sensor plane along a predicted leg, with coordinates in pixels.

Outlines are straight on the undistorted sensor plane, not in the picture. A band has an origin,
a direction *along* the leg from base to platform and a *normal* to it; t and v are the
coordinates in these directions, multiplied by the local scale of the camera so that one unit is
about one pixel. The normal points so that edge 1 (epsilon +1) of a leg has the smaller v.
"""

from dataclasses import dataclass

import numpy as np

from legcal.geometry.lines import moment
from legcal.geometry.types import Array, BoolArray
from legcal.vision.camera import Camera

N_SAMPLES = 64  # points along a leg that are tested for visibility
NEAREST = 0.05  # points nearer to the image plane than this fraction of the leg length are cut off


@dataclass(frozen=True, eq=False)
class Band:
    """A frame on the sensor plane.

    Attributes
    ----------
    origin, along, normal : (2,) array
        Point with t = v = 0, and unit directions of t and v, on the sensor plane.
    scale : float
        Pixels per unit of the sensor plane.
    length : float
        The predicted leg is visible for 0 <= t <= length [px].
    """

    origin: Array
    along: Array
    normal: Array
    scale: float
    length: float

    def points(self, t: Array, v: Array) -> Array:
        """Return the points (x, y) of the sensor plane with coordinates t, v [px], (..., 2)."""
        along = self.origin + t[..., None] * (self.along / self.scale)
        return np.asarray(along + v[..., None] * (self.normal / self.scale))

    def coordinates(self, xy: Array) -> tuple[Array, Array]:
        """Return t and v [px] of points (..., 2) of the sensor plane, both (...)."""
        from_origin = self.scale * (xy - self.origin)
        return np.asarray(from_origin @ self.along), np.asarray(from_origin @ self.normal)

    def offsets(self, h: Array, t: Array) -> Array:
        """Return the coordinate v of lines h (..., 3) of eq (2) at t (...) [px]."""
        on_axis = self.points(t, np.zeros(()))
        value = np.sum(h[..., :2] * on_axis, axis=-1) + h[..., 2]
        return np.asarray(-self.scale * value / (h[..., :2] @ self.normal))

    def line(self, v0: Array | float, v1: Array | float) -> Array:
        """Return the unit (a, b, c) of the line through (0, v0) and (length, v1), eq (2).

        The sign is that of eq (3): positive on the side of greater v.
        """
        ends = np.stack([np.asarray(v0, dtype=np.float64), np.asarray(v1, dtype=np.float64)], -1)
        (x0, y0), (x1, y1) = np.moveaxis(
            self.points(np.array([0.0, self.length]), ends), (-2, -1), (0, 1)
        )
        h = np.stack([y0 - y1, x1 - x0, x0 * y1 - x1 * y0], axis=-1)  # the vector product of rays
        h /= np.linalg.norm(h, axis=-1, keepdims=True)
        return np.asarray(h * np.sign(h[..., :2] @ self.normal)[..., None])


def band_of_leg(
    camera: Camera, A_camera: Array, B_camera: Array, start: float, end: float
) -> Band | None:
    """Return the band along the visible stretch of a leg, or None if the image misses it.

    Parameters
    ----------
    camera : Camera
        The camera.
    A_camera, B_camera : (3,) array
        Predicted joint centres in the camera frame [m].
    start, end : float
        The stretch of the axis that is of interest, as distances from A [m].

    Returns
    -------
    Band or None
        From the first to the last point of the longest stretch that the image shows.
    """
    ends = np.array([[start], [end]])
    return bands_of_legs(camera, A_camera[None], B_camera[None], *ends)[0]


def bands_of_legs(
    camera: Camera, A_camera: Array, B_camera: Array, start: Array, end: Array
) -> list[Band | None]:
    """Return the bands along the visible stretches of legs, as :func:`band_of_leg` does for one.

    Parameters
    ----------
    camera : Camera
        The camera.
    A_camera, B_camera : (n, 3) array
        Predicted joint centres in the camera frame [m].
    start, end : (n,) array
        The stretches of the axes that are of interest, as distances from A [m].
    """
    length = np.linalg.norm(B_camera - A_camera, axis=1)
    u = (B_camera - A_camera) / length[:, None]
    s = start[:, None] + (end - start)[:, None] * np.linspace(0.0, 1.0, N_SAMPLES)
    axis = A_camera[:, None] + s[..., None] * u[:, None]
    inside = in_picture(camera, axis, NEAREST * length[:, None])
    m = moment(u, A_camera)
    runs = [longest_run(one) if np.count_nonzero(one) > 1 else (0, 0) for one in inside]
    first, last = np.array(runs, dtype=np.intp).reshape(-1, 2).T
    legs = np.arange(len(axis))
    shown = last > first
    ends = np.stack([axis[legs, first], axis[legs, last]], axis=1)
    ends = ends[..., :2] / np.where(shown[:, None, None], ends[..., 2:], 1.0)
    along = ends[:, 1] - ends[:, 0]
    distance, offset = np.linalg.norm(along, axis=1), np.linalg.norm(m, axis=1)
    shown &= (distance > 0.0) & (offset >= 1e-6 * length)  # others are seen end-on
    middle = np.where(shown[:, None], ends.mean(axis=1), 0.0)
    scale = np.sqrt(np.abs(np.linalg.det(camera.pixels_per_unit(middle))))
    return [
        Band(
            ends[i, 0],
            along[i] / distance[i],
            m[i, :2] / np.linalg.norm(m[i, :2]),
            float(scale[i]),
            float(distance[i] * scale[i]),
        )
        if shown[i]
        else None
        for i in legs.tolist()
    ]


def in_picture(camera: Camera, P_camera: Array, nearest: Array | float) -> BoolArray:
    """Return whether points (..., 3) are in front of the camera and inside its image, (...)."""
    depth = P_camera[..., 2]
    front = depth > nearest
    xy = P_camera[..., :2] / np.where(front, depth, 1.0)[..., None]
    inside = front & pixels_inside(camera, camera.distort(xy))
    if camera.has_distortion:  # the polynomials fold far points back into the image
        back = camera.undistort(camera.distort(np.where(inside[..., None], xy, 0.0)))
        inside &= np.linalg.norm(back - np.where(inside[..., None], xy, 0.0), axis=-1) < 1e-3
    return np.asarray(inside)


def pixels_inside(camera: Camera, pixels: Array, margin: float = 0.0) -> BoolArray:
    """Return whether pixels (..., 2) lie in the image, at least ``margin`` px from its border."""
    x, y = pixels[..., 0], pixels[..., 1]
    inside = (x >= margin) & (x <= camera.width - 1.0 - margin)
    return np.asarray(inside & (y >= margin) & (y <= camera.height - 1.0 - margin))


def longest_run(flags: BoolArray) -> tuple[int, int]:
    """Return the first and the last index of the longest run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    starts, stops = edges[::2], edges[1::2]
    longest = int(np.argmax(stops - starts))
    return int(starts[longest]), int(stops[longest]) - 1
