"""Ways to find both outlines of a rendered cylinder: legcal's, and three without any model."""

from collections.abc import Callable

import cv2
import numpy as np
from rendered_cylinders import Photographed, interpolated

from legcal.geometry.types import Array
from legcal.perception.profiles import Edge
from legcal.perception.subpixel_edges import LostEdge, measure_edges
from legcal.vision.cylinder import EPSILON
from legcal.vision.image_file import Grey

REACH = 2.5  # from the start, of a point that belongs to an outline [px]
SMOOTHING = 1.0  # of an image before Canny's filter [px]
NO_EDGE, NOISE, LOWER = 0.9, 4.0, 0.4  # upper threshold of Canny's filter: of the gradients, this
# quantile and this many medians; lower threshold, as a part of it

Ends = list[tuple[Array, Array] | None]
"""Of both edges: offsets at both ends of the band (2,) [px], and their standard deviations."""


def by_legcal(scene: Photographed, grey: Grey, start: Array) -> Ends:
    """Measure both edges as legcal does; errors at both ends of the used piece."""
    half_width = float(0.5 * np.mean(scene.v[1] - scene.v[0]))
    hidden = np.zeros(8, dtype=np.bool_)
    edges = [
        Edge(scene.band, v, float(epsilon), half_width, hidden)
        for v, epsilon in zip(start, EPSILON, strict=True)
    ]
    measured, _ = measure_edges(grey, scene.camera, edges)
    ends: Ends = []
    for edge, true in zip(measured, scene.v, strict=True):
        if isinstance(edge, LostEdge):
            ends.append(None)
            continue
        place = np.array([edge.line.first, edge.line.last])
        error = (edge.v - true)[0] + np.diff(edge.v - true)[0] * place
        ends.append((error, np.sqrt(np.diag(edge.covariance))))
    return ends


def by_gradient(scene: Photographed, grey: Grey, start: Array) -> Ends:
    """Find the steepest place of every profile, and a line through these."""
    t = np.arange(2.0, scene.band.length - 2.0)
    d = np.arange(-4.0, 5.0)
    ends: Ends = []
    for v, true in zip(start, scene.v, strict=True):
        at = v[0] + (v[1] - v[0]) * t / scene.band.length
        xy = scene.band.points(t[:, None], at[:, None] + d)
        smooth = np.asarray(cv2.GaussianBlur(grey, (0, 0), 1.0), dtype=np.float32)
        profile = interpolated(smooth, scene.camera, xy)
        steep = np.abs(np.gradient(profile, axis=1))
        best = np.clip(np.argmax(steep[:, 1:-1], axis=1) + 1, 1, len(d) - 2)
        left, top, right = (steep[np.arange(len(t)), best + i] for i in (-1, 0, 1))
        bend = np.minimum(left - 2.0 * top + right, -1e-6)
        place = d[best] + np.clip(0.5 * (left - right) / bend, -0.5, 0.5)
        ends.append(_line(t / scene.band.length, at + place, v, true))
    return ends


def by_canny(scene: Photographed, grey: Grey, start: Array) -> Ends:
    """Find a line through Canny's points near each edge."""
    t, v = scene.band.coordinates(scene.camera.undistort(edge_points(grey)))
    t = t / scene.band.length
    along = (t > 0.0) & (t < 1.0)
    t, v = t[along], v[along]
    return [_line(t, v, ends, true) for ends, true in zip(start, scene.v, strict=True)]


def edge_points(grey: Grey) -> Array:
    """Return the pixels (n, 2) that Canny's filter marks as edges."""
    smooth = cv2.GaussianBlur(grey, (0, 0), SMOOTHING)
    scale = 32.0  # grey levels are stretched so that rounding the gradient does not matter
    dx, dy = (
        np.rint(np.clip(scale * cv2.Sobel(smooth, cv2.CV_32F, *d), -32767, 32767)).astype(np.int16)
        for d in ((1, 0), (0, 1))
    )
    steepness = np.hypot(dx.astype(np.float32), dy.astype(np.float32))
    typical, steep = np.quantile(steepness, [0.5, NO_EDGE]).tolist()
    upper = max(steep, NOISE * typical, 1.0)
    row, column = np.nonzero(cv2.Canny(dx, dy, LOWER * upper, upper, L2gradient=True))
    return np.column_stack([column, row]).astype(np.float64)


def by_segments(scene: Photographed, grey: Grey, start: Array) -> Ends:
    """Find a line through the segments of OpenCV's detector near each edge."""
    eight = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    found = cv2.createLineSegmentDetector().detect(eight)[0]
    if found is None:
        return [None, None]
    segments = found.reshape(-1, 2, 2).astype(np.float64)
    steps = np.linspace(0.0, 1.0, 50)[:, None]
    points = segments[:, None, 0] + (segments[:, None, 1] - segments[:, None, 0]) * steps
    t, v = scene.band.coordinates(scene.camera.undistort(points))
    t = t / scene.band.length
    ends: Ends = []
    for line, true in zip(start, scene.v, strict=True):
        off = np.abs(v - line[0] - (line[1] - line[0]) * t)
        near = np.all(off < REACH, axis=1)
        ends.append(_line(t[near].ravel(), v[near].ravel(), line, true))
    return ends


def _line(t: Array, v: Array, start: Array, true: Array) -> tuple[Array, Array] | None:
    """Return the errors at both ends of the line through points, refined twice."""
    ends = start
    for reach in (REACH, 1.5, 1.5):
        near = np.abs(v - ends[0] - (ends[1] - ends[0]) * t) < reach
        if np.count_nonzero(near) < 10 or np.ptp(t[near]) < 0.2:
            return None
        design = np.column_stack([1.0 - t[near], t[near]])
        ends = np.linalg.lstsq(design, v[near], rcond=None)[0]
    return ends - true, np.full(2, np.nan)


MEASURED: dict[str, Callable[[Photographed, Grey, Array], Ends]] = {
    "legcal": by_legcal,
    "gradient": by_gradient,
    "Canny": by_canny,
    "LSD": by_segments,
}
