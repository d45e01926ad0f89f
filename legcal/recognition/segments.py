"""Straight edges of a picture on the sensor plane, those of one line joined.

OpenCV's line segment detector finds pieces of straight edges. A leg that another one crosses, a
highlight or noise cut an edge into several; pieces that continue each other are joined here. Ends
are taken to the undistorted sensor plane before, where edges of legs are straight.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from legcal.detection.picture import Grey, reduce
from legcal.geometry.types import Array, IntArray
from legcal.vision.camera import Camera

LONG_SIDE = 480  # of the reduced picture at least [px]
LARGEST_FACTOR = 4  # by which a picture is reduced: legs are 12 px wide and more
SHORTEST = 7.0  # of a piece [reduced px]
LEAST_LENGTH = 14.0  # of a joined edge [reduced px]
ASIDE = 1.6  # of the ends of a piece from the line that it continues [reduced px]
TURN = np.deg2rad(4.0)  # between pieces of one edge
GAP = 3.0  # between them, in lengths of the shorter one
DARK = 1.0 / 30.0  # part of the brightest light
MOST = 400  # pieces of a picture, longest first
STEEPNESSES = 64  # that are told apart in the order of pixels: each one takes time


@dataclass(frozen=True, eq=False)
class Segments:
    """Straight edges.

    Attributes
    ----------
    ends : (n, 2, 2) array
        Both ends on the sensor plane. On the way from the first to the second the picture is
        brighter on the left-hand side, as one sees it: in the direction (dy, -dx).
    covered : (n,) array
        Share of the length on which the edge was seen.
    pixel : float
        Size of a pixel of the reduced picture on the sensor plane.
    """

    ends: Array
    covered: Array
    pixel: float

    def __len__(self) -> int:
        """Return the number of edges."""
        return len(self.ends)


def find_segments(grey: Grey, camera: Camera, long_side: int = LONG_SIDE) -> Segments:
    """Return the straight edges of a picture.

    Parameters
    ----------
    grey : Grey
        The picture.
    camera : Camera
        Its camera.
    long_side : int
        The picture is reduced by the largest whole factor that leaves its longer side this long.
    """
    factor = int(np.clip(max(grey.shape) // long_side, 1, LARGEST_FACTOR))
    pieces = _pieces(reduce(grey, factor))
    focal = float(np.sqrt(abs(np.linalg.det(camera.K[:2, :2]))))
    pixel = factor / focal
    if len(pieces) == 0:
        return Segments(np.zeros((0, 2, 2)), np.zeros(0), pixel)
    ends = camera.undistort((pieces.reshape(-1, 2) + 0.5) * factor - 0.5).reshape(-1, 2, 2)
    ends, covered = _join(ends / pixel)
    return Segments(ends * pixel, covered, pixel)


def _pieces(small: Grey) -> Array:
    """Return pieces of edges (n, 2, 2) in a reduced picture [px]."""
    levels = _stretched(small)
    # Reduced enough already. Whether steep pixels come first matters, not in which order.
    detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_NONE, 1.0, n_bins=STEEPNESSES)
    lines = detector.detect(levels)[0]
    if lines is None:
        return np.zeros((0, 2, 2))
    pieces = np.asarray(lines, dtype=np.float64).reshape(-1, 2, 2)  # of middles of pixels
    length = np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=1)
    order = np.argsort(-length, kind="stable")[:MOST]
    return np.asarray(pieces[order[length[order] >= SHORTEST]])


def _stretched(small: Grey) -> NDArray[np.uint8]:
    """Return about the logarithm of the light: a dark leg's edges count as much as a bright one's.

    What is darker than ``DARK`` of the brightest is mostly noise and keeps its distances.
    """
    top = max(float(np.percentile(small[::4, ::4], 99.5)), 1.0)
    light = 1.0 + np.clip(small, 0.0, top) / np.float32(DARK * top)
    return np.asarray((255.0 / math.log1p(1.0 / DARK)) * cv2.log(light), dtype=np.uint8)


def _join(ends: Array) -> tuple[Array, Array]:
    """Join pieces that continue each other; return the edges and how much of them was seen."""
    along = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(along, axis=1)
    along = along / length[:, None]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    middle = ends.mean(axis=1)
    # Piece j against the line of piece i, the longer one (pieces come longest first).
    i, j = np.nonzero(np.triu(along @ along.T >= np.cos(TURN), 1))
    to_ends = ends[j] - middle[i, None]
    aside = np.abs(np.einsum("nkx,nx->nk", to_ends, normal[i])).max(axis=1)
    place = np.einsum("nkx,nx->nk", to_ends, along[i])
    gap = np.maximum(place.min(axis=1), -place.max(axis=1)) - 0.5 * length[i]
    # A long way ahead a line is known less well.
    allowed = ASIDE * (1.0 + 0.5 * np.maximum(gap, 0.0) / length[i])
    near = (gap <= GAP * length[j]) & (aside <= np.minimum(allowed, 2 * ASIDE))
    i, j = i[near], j[near]
    graph = coo_array((np.ones(len(i)), (i, j)), shape=(len(ends), len(ends)))
    label: IntArray = np.asarray(connected_components(graph, directed=False)[1], dtype=np.intp)
    order = np.argsort(label, kind="stable")
    found, covered = _fitted(ends[order], length[order], label[order])
    long = np.linalg.norm(found[:, 1] - found[:, 0], axis=1) >= LEAST_LENGTH
    return found[long], covered[long]


def _fitted(pieces: Array, length: Array, label: IntArray) -> tuple[Array, Array]:
    """Return one line through the pieces of each label, or the pieces as they are if they bend.

    Pieces (n, 2, 2) and their lengths (n,) come label by label, from 0 without gaps, the longest
    first; lines as well, with the share of each that its pieces cover.
    """
    first = np.flatnonzero(np.diff(label, prepend=-1))
    total = np.add.reduceat(length, first)
    centre = np.add.reduceat(pieces.mean(axis=1) * length[:, None], first) / total[:, None]
    away = pieces - centre[label, None]
    xx, xy, yy = (
        np.add.reduceat(np.sum(away[..., i] * away[..., j], axis=1) * length, first)
        for i, j in ((0, 0), (0, 1), (1, 1))
    )
    turn = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    direction = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    longest = pieces[first, 1] - pieces[first, 0]
    direction *= np.sign(np.sum(direction * longest, axis=1))[:, None]
    x, y = direction[label].T[..., None]
    place, aside = away[..., 0] * x + away[..., 1] * y, away[..., 1] * x - away[..., 0] * y
    start = np.minimum.reduceat(place.min(axis=1), first)
    stop = np.maximum.reduceat(place.max(axis=1), first)
    lines = centre[:, None] + np.stack([start, stop], axis=1)[..., None] * direction[:, None]
    straight = np.maximum.reduceat(np.abs(aside).max(axis=1), first) <= 1.5 * ASIDE
    bent = ~straight[label]
    order = np.argsort(np.concatenate([np.flatnonzero(straight), label[bent]]), kind="stable")
    share = np.minimum(total / (stop - start), 1.0)
    return (
        np.concatenate([lines[straight], pieces[bent]])[order],
        np.concatenate([share[straight], np.ones(np.count_nonzero(bent))])[order],
    )
