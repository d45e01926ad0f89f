"""Which pixels a solid may cover."""

import cv2
import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.simulation.rendering.rays import PixelRays
from legcal.simulation.rendering.solid_in_view import SolidInView
from legcal.simulation.shapes import Box, Cylinder, Sphere

NEAR = 1e-4  # [m] in front of the camera
MARGIN = 2  # [px]
_SPARE = 0.02  # of the picture, around it
_SHIFT = 4  # bits of a fraction of a pixel
_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])


def footprint(rays: PixelRays, solid: SolidInView) -> IntArray:
    """Return the pixels that a solid may cover, with a small margin.

    The hull of points around the solid is cut to the part of the sensor plane that the picture
    shows, where the lens is known, before it is distorted.

    Parameters
    ----------
    rays : PixelRays
        The camera's rays.
    solid : SolidInView
        The solid.

    Returns
    -------
    (n,) array of int
        Pixels as row * width + column, in order.
    """
    points = surrounding_points(solid)
    in_front = points[:, 2] > NEAR
    if not in_front.any():
        return np.zeros(0, dtype=np.intp)
    if not in_front.all():
        return np.arange(rays.width * rays.height)
    hull = _hull(points[:, :2] / points[:, 2:])
    spare = _SPARE * (rays.high - rays.low)
    hull = _cut(hull, rays.low - spare, rays.high + spare)
    if not len(hull):
        return np.zeros(0, dtype=np.intp)
    return _filled(_hull(rays.camera.distort(_dense(hull))), rays.width, rays.height)


def surrounding_points(solid: SolidInView) -> Array:
    """Return points whose convex hull holds the solid, (n, 3), in the camera frame [m]."""
    shape = solid.shape
    if isinstance(shape, Cylinder):
        n = 12
        angles = 2.0 * np.pi * np.arange(n) / n
        outer = shape.radius / np.cos(np.pi / n)
        ring = np.stack([outer * np.cos(angles), outer * np.sin(angles), np.zeros(n)], axis=-1)
        end = np.array([0.0, 0.0, 0.5 * shape.length])
        points = np.concatenate([ring - end, ring + end])
    elif isinstance(shape, Box):
        points = _CORNERS * np.array(shape.size)
    elif isinstance(shape, Sphere):
        points = 2.0 * shape.radius * _CORNERS
    else:
        points = shape.vertices
    return np.asarray(points @ solid.R.T + solid.w)


def _hull(points: Array) -> Array:
    """Return the convex hull of points in the plane, in order, (n, 2)."""
    return np.asarray(cv2.convexHull(points.astype(np.float32))[:, 0], dtype=np.float64)


def _cut(polygon: Array, low: Array, high: Array) -> Array:
    """Return the part of a convex polygon inside a rectangle."""
    if np.all((polygon >= low) & (polygon <= high)):
        return polygon
    for axis in (0, 1):
        for bound, sign in ((low[axis], 1.0), (high[axis], -1.0)):
            inside = sign * (polygon[:, axis] - bound)
            kept = []
            for i in range(len(polygon)):
                here, before = inside[i], inside[i - 1]
                if (here >= 0.0) != (before >= 0.0):
                    t = before / (before - here)
                    kept.append(polygon[i - 1] + t * (polygon[i] - polygon[i - 1]))
                if here >= 0.0:
                    kept.append(polygon[i])
            if not kept:
                return np.zeros((0, 2))
            polygon = np.array(kept)
    return polygon


def _dense(polygon: Array, pieces: int = 12) -> Array:
    """Return more points along the sides of a polygon: the lens bends them."""
    t = np.arange(pieces)[:, None] / pieces
    side = np.roll(polygon, -1, axis=0) - polygon
    return np.asarray((polygon[:, None] + t * side[:, None]).reshape(-1, 2))


def _filled(hull: Array, width: int, height: int) -> IntArray:
    """Return the pixels in and around a convex polygon of pixels."""
    low = np.maximum(np.floor(hull.min(axis=0)).astype(int) - MARGIN - 1, 0)
    high = np.minimum(np.ceil(hull.max(axis=0)).astype(int) + MARGIN + 2, [width, height])
    if np.any(high <= low):
        return np.zeros(0, dtype=np.intp)
    mask = np.zeros((high[1] - low[1], high[0] - low[0]), dtype=np.uint8)
    corners = np.rint((hull - low) * 2**_SHIFT).astype(np.int32)
    cv2.fillConvexPoly(mask, corners, 1, shift=_SHIFT)
    cv2.polylines(mask, [corners], True, 1, thickness=2 * MARGIN + 1, shift=_SHIFT)
    where = np.flatnonzero(mask)
    skipped = width - mask.shape[1]  # pixels between the end of a row and the start of the next
    return np.asarray(where + where // mask.shape[1] * skipped + low[1] * width + low[0])
