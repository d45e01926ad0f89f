"""Outlines as the paper found them: Canny's edge points, and a line by least squares (4.2).

The search for the edges is that of ``measure``, so that both methods look at
the same edges; the points are whole pixels, and the line through them is the one with the least sum
of squared distances (total least squares). The thresholds follow the picture in the usual way: a
share of all pixels is no edge. Nothing more is asked of the lines: that shading displaces them, and
the width of the leg with them, belongs to the method.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from legcal.data.outlines import Outlines
from legcal.geometry.types import Array
from legcal.perception.outline import (
    MIN_LONE_KEPT,
    ImageSearch,
    OutlineLine,
    PartLines,
    find_parts,
    outline_table,
)
from legcal.perception.part_edges import LegPart
from legcal.vision.image_file import Grey
from legcal.vision.visibility import least_length

SMOOTHING = 1.0  # of the picture before its gradient is taken [px]
NO_EDGE = 0.9  # share of the pixels whose gradient is below the upper threshold
NOISE = 4.0  # median gradients that the upper threshold is at least: those of the noise
LOWER = 0.4  # lower threshold in the upper one
REACH = 2.0  # from the line, of a point that belongs to it [px]
N_ROUNDS = 10
QUANTUM = 1.0 / 12.0  # variance of a coordinate that is rounded to whole pixels [px^2]


@dataclass(frozen=True, eq=False)
class _CannyLine:
    """A line through edge points: offsets at the band's ends, used stretch, covariance there."""

    v: Array  # (2,) [px]
    place: Array  # (2,) as fractions of the band
    covariance: Array  # (2, 2) [px^2]
    kept: float  # points for each pixel of the unhidden length


def canny_parts(search: ImageSearch) -> tuple[Outlines, float]:
    """Find the outlines of all parts in one image by Canny's edge points and least squares.

    Two for every part of every leg that is looked for, and no blur. The covariances take the
    points' scatter about their line for independent errors.
    """
    parts, results = find_parts(search)
    if parts:
        xy = search.camera.undistort(edge_points(search.grey))
        results += [_measured(part, xy) for part in parts]
    return outline_table(search, results), np.nan


def edge_points(grey: Grey) -> Array:
    """Return the pixels (n, 2) that Canny's filter marks as edges.

    Parameters
    ----------
    grey : Grey
        The image, 0 to 255.
    """
    smooth = cv2.GaussianBlur(grey, (0, 0), SMOOTHING)
    scale = 32.0  # grey levels are stretched so that rounding the gradient does not matter
    dx, dy = (
        np.rint(np.clip(scale * cv2.Sobel(smooth, cv2.CV_32F, *d), -32767, 32767)).astype(np.int16)
        for d in ((1, 0), (0, 1))
    )
    steepness = np.hypot(dx.astype(np.float32), dy.astype(np.float32))
    typical, steep = np.quantile(steepness, [0.5, NO_EDGE]).tolist()
    upper = max(steep, NOISE * typical, 1.0)
    edges = cv2.Canny(dx, dy, LOWER * upper, upper, L2gradient=True)
    row, column = np.nonzero(edges)
    return np.column_stack([column, row]).astype(np.float64)


def _measured(part: LegPart, xy: Array) -> PartLines:
    """Measure both outlines of a part from all edge points of the image, and judge them."""
    t, v = part.band.coordinates(xy)
    n = len(part.hidden)
    near = (t >= 0.0) & (t <= part.band.length)
    stretch = np.clip((t / part.band.length * n), 0, n - 1).astype(np.intp)
    near &= ~part.hidden[stretch]
    free = part.band.length * float(np.mean(~part.hidden))
    lines = [
        _line(t[near], v[near], start, part.band.length, free) if found else None
        for start, found in zip(part.edges.v, part.edges.found, strict=True)
    ]
    found = [
        None if line is None else OutlineLine(line.v, line.place, line.covariance) for line in lines
    ]
    return PartLines(part.leg.leg, part.segment.link, _reasons(part, lines), found, part.band)


def _line(t: Array, v: Array, start: Array, length: float, free: float) -> _CannyLine | None:
    """Return the line of the points near a line known to a pixel; None if there are too few."""
    ends = np.asarray(start, dtype=np.float64)
    chosen = np.zeros(len(t), dtype=np.bool_)
    for _ in range(N_ROUNDS):
        near = np.abs(v - ends[0] - (ends[1] - ends[0]) * t / length) < REACH
        if np.count_nonzero(near) < 3 or np.ptp(t[near]) < least_length(0.0):
            return None
        ends = _least_squares(t[near], v[near], length)
        if np.array_equal(near, chosen):
            break
        chosen = near
    t, v = t[near], v[near]
    residual = v - ends[0] - (ends[1] - ends[0]) * t / length
    place = np.array([t.min(), t.max()]) / length
    along = (t / length - place[0]) / (place[1] - place[0])
    design = np.column_stack([1.0 - along, along])
    variance = max(float(residual @ residual) / (len(t) - 2), QUANTUM / len(t))
    covariance = variance * np.linalg.inv(design.T @ design)
    return _CannyLine(ends, place, np.asarray(covariance), len(t) / free)


def _least_squares(t: Array, v: Array, length: float) -> Array:
    """Return the offsets at t = 0 and t = length of the line nearest to points."""
    points = np.column_stack([t, v])
    centre = points.mean(axis=0)
    along = np.linalg.svd(points - centre, full_matrices=False)[2][0]
    slope = along[1] / along[0]
    return np.asarray(centre[1] + slope * (np.array([0.0, length]) - centre[0]))


def _reasons(part: LegPart, lines: Sequence[_CannyLine | None]) -> tuple[str, str]:
    """Return why each outline is not to be used, "" if it is."""
    least = least_length(2.0 * part.half_width)
    reasons = []
    for line in lines:
        reason = "" if line is not None else "too few edge points"
        if line is not None and float(np.ptp(line.place)) * part.band.length < least:
            reason = "edge points too close together"
        elif line is not None and line.kept < MIN_LONE_KEPT:
            reason = f"edge points on {100 * line.kept:.0f} % of the outline"
        reasons.append(reason)
    return reasons[0], reasons[1]
