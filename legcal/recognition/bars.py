"""Pairs of edges that may be the two outlines of a cylinder.

A cylinder shows two nearly parallel edges, one where the picture gets brighter across it and one
where it gets darker; a lit one before something grey may do the same at both. What it is not told
here: how thick it is, and whether it is a leg at all.
"""

from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.recognition.segments import Segments

CONVERGENCE = np.deg2rad(9.0)  # of two outlines: a leg that points at the camera
NARROWEST, WIDEST = 2.5, 130.0  # [reduced px]
SLENDER = 1.5  # length in widths
LEAST_OVERLAP = 0.35  # of the longer edge
SAME_WAY = 0.5  # what a pair counts at both of whose edges the picture changes the same way
MOST = 48  # bars of a picture
MOST_OF_EDGE = 4  # bars to which one edge belongs
ALIKE = 0.35, 0.2  # of a bar that says the same as another: distance, widths in widths


@dataclass(frozen=True, eq=False)
class Bars:
    """Candidate cylinders of a picture, best first, on its sensor plane.

    Attributes
    ----------
    middle : (n, 2) array
        The middle of the axis.
    along : (n, 2) array
        Unit direction of the axis.
    half_length : (n,) array
        From the middle to the ends.
    width : (n, 2) array
        Distance of the edges at both ends; the first one is against ``along``.
    merit : (n,) array
        Length on which both edges were seen.
    pixel : float
        How well edges are known.
    """

    middle: Array
    along: Array
    half_length: Array
    width: Array
    merit: Array
    pixel: float

    def __len__(self) -> int:
        """Return the number of bars."""
        return len(self.middle)

    @property
    def normal(self) -> Array:
        """Unit normals (n, 2) of the axes."""
        return np.stack([-self.along[:, 1], self.along[:, 0]], axis=1)

    def take(self, chosen: IntArray | BoolArray) -> "Bars":
        """Return some of the bars."""
        return Bars(
            self.middle[chosen],
            self.along[chosen],
            self.half_length[chosen],
            self.width[chosen],
            self.merit[chosen],
            self.pixel,
        )


def find_bars(segments: Segments, most: int = MOST) -> Bars:
    """Return the pairs of edges that may be a cylinder.

    Parameters
    ----------
    segments : Segments
        Straight edges.
    most : int
        How many are kept.
    """
    ends, pixel = segments.ends, segments.pixel
    i, j = np.triu_indices(len(ends), 1)
    along = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(along, axis=1)
    along = along / np.where(length > 0.0, length, 1.0)[:, None]
    cosine = np.sum(along[i] * along[j], axis=1)
    i, j, cosine = (x[np.abs(cosine) >= np.cos(CONVERGENCE)] for x in (i, j, cosine))
    axis = along[i] * length[i, None] + np.sign(cosine)[:, None] * along[j] * length[j, None]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    across = np.stack([-axis[:, 1], axis[:, 0]], axis=1)
    origin = 0.5 * (ends[i].mean(axis=1) + ends[j].mean(axis=1))
    spans, lines = [], []
    for edge in (i, j):
        to_ends = ends[edge] - origin[:, None]
        t, v = np.einsum("nkx,nx->nk", to_ends, axis), np.einsum("nkx,nx->nk", to_ends, across)
        slope = (v[:, 1] - v[:, 0]) / (t[:, 1] - t[:, 0])
        spans.append(np.sort(t, axis=1))
        lines.append((v[:, 0] - slope * t[:, 0], slope))
    first, last = (
        np.maximum(spans[0][:, 0], spans[1][:, 0]),
        np.minimum(spans[0][:, 1], spans[1][:, 1]),
    )
    overlap = last - first
    longer = np.maximum(length[i], length[j])
    offsets = [at + slope * np.stack([first, last]) for at, slope in lines]  # each (2, n)
    gap = offsets[1] - offsets[0]
    width = np.abs(gap)
    good = (overlap >= LEAST_OVERLAP * longer) & (gap[0] * gap[1] > 0.0)
    good &= (width.min(axis=0) >= NARROWEST * pixel) & (width.max(axis=0) <= WIDEST * pixel)
    good &= overlap >= SLENDER * width.mean(axis=0)
    merit = overlap * np.minimum(segments.covered[i], segments.covered[j])
    merit = (
        merit * np.where(cosine < 0.0, 1.0, SAME_WAY) * np.sqrt(np.maximum(overlap, 0.0) / longer)
    )
    centre = 0.5 * (offsets[0] + offsets[1])  # (2, n) of the axis at both ends
    start, stop = (
        origin + t[:, None] * axis + v[:, None] * across
        for t, v in ((first, centre[0]), (last, centre[1]))
    )
    chosen = _best(np.where(good, merit, 0.0), i, j, len(ends), most)
    chosen = chosen[_distinct(start[chosen], stop[chosen], width.mean(axis=0)[chosen])][:most]
    start, stop = start[chosen], stop[chosen]
    full = np.linalg.norm(stop - start, axis=1)
    return Bars(
        0.5 * (start + stop),
        (stop - start) / full[:, None],
        0.5 * full,
        width.T[chosen],
        merit[chosen],
        pixel,
    )


def _best(merit: Array, i: IntArray, j: IntArray, n_edges: int, most: int) -> IntArray:
    """Return the best pairs, few of each edge: more than wanted, some of them may be alike."""
    used = np.zeros(n_edges, dtype=np.intp)
    chosen: list[int] = []
    for k in np.argsort(-merit, kind="stable").tolist():
        if merit[k] <= 0.0 or len(chosen) == 2 * most:
            break
        if max(used[i[k]], used[j[k]]) < MOST_OF_EDGE:
            used[[i[k], j[k]]] += 1
            chosen.append(k)
    return np.array(chosen, dtype=np.intp)


def _distinct(start: Array, stop: Array, width: Array) -> BoolArray:
    """Return which bars (n,), best first, do not lie within better ones of the same width."""
    along = stop - start
    length = np.linalg.norm(along, axis=1)
    along = along / length[:, None]
    # Ends of bar j in the frame of bar i.
    to_ends = np.stack([start, stop], axis=1)[None] - start[:, None, None]
    place = np.einsum("ijkx,ix->ijk", to_ends, along)
    aside = to_ends[..., 1] * along[:, None, None, 0] - to_ends[..., 0] * along[:, None, None, 1]
    middle = place.mean(axis=2)
    alike = np.abs(aside).max(axis=2) <= ALIKE[0] * width[:, None]
    alike &= (middle > 0.0) & (middle < length[:, None])
    alike &= np.abs(width[None, :] - width[:, None]) <= ALIKE[1] * width[:, None]
    kept = np.ones(len(start), dtype=np.bool_)
    for j in range(1, len(start)):
        kept[j] = not np.any(alike[:j, j] & kept[:j])
    return kept
