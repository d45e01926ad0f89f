"""Line segments of a whole image, and pairs of them that may be the two outlines of a cylinder.

A cylinder shows two nearly parallel edges, one where the picture gets brighter across it and one
where it gets darker; a lit one before something grey may do the same at both. How thick it
is, and whether it is a leg at all, is not known here.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from legcal.geometry.tables import Table, first_apart
from legcal.geometry.types import Array, BoolArray, Image, IntArray
from legcal.perception.profiles import Samples
from legcal.perception.tuning import EDGE_LENGTH, EDGE_SLOPE
from legcal.vision.camera import Camera
from legcal.vision.image_file import Grey

LONG_SIDE = 480  # of the reduced picture at least [px]
MAX_REDUCTION = 4  # by which a picture is reduced: legs are 12 px wide and more
LEG_WIDTH = 8.0  # of the thinnest leg after that [reduced px]
# What stands still in pictures of a view: by so many of them; what moves differs from it by several
# times what most pixels do, and by this part of the brightest light
MIN_STILL, NOISE_FACTOR, DIFFERS = 4, 3.0, 0.02
NEAR_MOVING, MIN_MOVING = 2, 8  # pixels around such differences; pieces there, to leave out others
N_ALONG, MOVING_SHARE = 12, 0.5  # points of a piece, and of which more must lie there
MIN_PIECE_LENGTH = 7.0  # of a piece [reduced px]
MAX_OFFSET = 1.6  # of the ends of a piece from the line that it continues [reduced px]
MAX_TURN = np.deg2rad(4.0)  # between pieces of one edge
MAX_GAP = 3.0  # between such pieces [lengths of the shorter one]
DARK = 1.0 / 30.0  # part of the brightest light below which light is mostly noise
MAX_PIECES = 400  # pieces of a picture, longest first
MIN_SLOPE = (24.0, 80.0)  # of an edge, by the noise [8 levels/px of the stretched picture]
STRONG = 2.0  # slope with which an edge begins, in the least one with which it goes on
STRIDE = 4  # every such row and column is enough for a median
# Of a sector: borders lie beside multiples of 45 deg, which whole grey levels often give, and where
# rounding, which is not the same on every CPU, would decide.
_ASIDE = 1e-3
N_SECTORS = 8  # of directions in which light changes along one edge
MIN_PIXELS = 6  # of a piece
MAX_SUBPIXEL = 0.6  # distance of the middle of an edge from its pixel [reduced px]
MAX_SAG = 1.3  # of the pixels of a piece from its line [reduced px]
MAX_CUTS = 3  # of a chain, each into two

MAX_CONVERGENCE = np.deg2rad(9.0)  # of two outlines: a leg that points at the camera
MIN_WIDTH, MAX_WIDTH = 2.5, 130.0  # [reduced px]
MIN_SLENDERNESS = 1.5  # length of a pair [widths]
MIN_OVERLAP = 0.35  # of the edges of a pair, as a part of the longer one
SAME_POLARITY = 0.5  # weight of a pair at both of whose edges the picture changes the same way
MAX_PAIRS = 48  # pairs of a picture
N_BEST = 8  # of these, by which pictures are compared
MAX_PAIRS_OF_EDGE = 4  # pairs to which one edge belongs
DUPLICATE = 0.35, 0.2  # of a pair that repeats another: distance, difference of widths [widths]


@dataclass(frozen=True, eq=False)
class EdgeSegments(Table):
    """Straight edges on the sensor plane."""

    ends: Array  # (n, 2, 2) on the way from the first to the second the picture is brighter on the
    # left-hand side, as one sees it: in the direction (dy, -dx)
    covered: Array  # (n,) share of the length on which the edge was seen
    pixel: float  # size of a pixel of the reduced picture


def reduction(camera: Camera, part: float) -> int:
    """Return the whole factor by which pictures are reduced.

    ``part`` is how thick the thinnest leg is, in mean leg lengths; these take up about half of a
    picture.
    """
    size = max(camera.width, camera.height)
    factor = min(size // LONG_SIDE, int(0.5 * part * size / LEG_WIDTH))
    return int(np.clip(factor, 1, MAX_REDUCTION))


class Still(NamedTuple):
    """The static background in reduced images of one view."""

    picture: Grey
    noise: float  # by which most pixels of pictures differ from it [grey levels]
    factor: int  # by which they are reduced


def still_picture(pictures: Sequence[Grey], factor: int) -> Still | None:
    """Return the static background in images of one view reduced by a factor; None if they are few.

    Legs are somewhere else in most pictures.
    """
    if len(pictures) < MIN_STILL:
        return None
    middle = np.median(np.stack(pictures), axis=0).astype(np.float32)
    away = [_middle(np.abs(one - middle)[::STRIDE, ::STRIDE]) for one in pictures]
    return Still(middle, float(np.median(away)), factor)


def moving_pixels(picture: Grey, still: Still) -> Image:
    """Return 1 near pixels of an image that differ from the static background, else 0."""
    size = np.ones((2 * NEAR_MOVING + 1, 2 * NEAR_MOVING + 1), dtype=np.uint8)
    least = max(NOISE_FACTOR * still.noise, DIFFERS * float(still.picture.max()))
    return np.asarray(
        cv2.dilate(np.asarray(np.abs(picture - still.picture) > least).astype(np.uint8), size)
    )


def _moving(pieces: Array, picture: Grey, still: Still) -> BoolArray:
    """Return the mask of pieces (n, 2, 2) mostly where an image differs from the background."""
    differs = moving_pixels(picture, still)
    share = np.linspace(0.0, 1.0, N_ALONG)[:, None]
    along = pieces[:, None, 0] + share * (pieces[:, None, 1] - pieces[:, None, 0])
    x, y = np.rint(np.clip(along, 0, np.array(picture.shape[::-1]) - 1)).astype(np.intp).T
    return np.asarray(differs[y, x].mean(axis=0) > MOVING_SHARE)


def segments_of_reduced(
    small: Grey, camera: Camera, factor: int, still: Still | None = None
) -> EdgeSegments:
    """Return the straight edges of a reduced picture, but of what stands still."""
    pieces = _pieces(small)
    if still is not None and len(pieces):
        moving = _moving(pieces, small, still)
        if np.count_nonzero(moving) >= MIN_MOVING:
            pieces = pieces[moving]
    focal = float(np.sqrt(abs(np.linalg.det(camera.K[:2, :2]))))
    pixel = factor / focal
    if len(pieces) == 0:
        return EdgeSegments(np.zeros((0, 2, 2)), np.zeros(0), pixel)
    ends = camera.undistort((pieces.reshape(-1, 2) + 0.5) * factor - 0.5).reshape(-1, 2, 2)
    ends, covered = _join(ends / pixel)
    return EdgeSegments(ends * pixel, covered, pixel)


def _pieces(small: Grey) -> Array:
    """Return pieces of edges (n, 2, 2) in a reduced picture [px], longest first.

    Pixels of edges in which the light changes in about the same direction make chains, which are
    cut until they are straight.
    """
    levels = _stretched(small)
    slopes = np.empty((2, *small.shape), dtype=np.int16)
    for k, slope in enumerate(slopes):
        cv2.Sobel(levels, cv2.CV_16S, 1 - k, k, dst=slope)
    some = slopes[:, ::STRIDE, ::STRIDE].astype(np.float32)
    low = EDGE_SLOPE * _middle(cv2.magnitude(some[0], some[1]))
    low = min(max(low, MIN_SLOPE[0]), MIN_SLOPE[1])
    edge = cv2.Canny(slopes[0], slopes[1], low, STRONG * low, L2gradient=True)
    edge[[0, -1]], edge[:, [0, -1]] = 0, 0
    at = np.flatnonzero(edge != 0)
    gradient = slopes.reshape(2, -1).take(at, axis=1).astype(np.float32)
    chain = _chains(at, gradient, small.shape)
    is_long = np.bincount(chain) >= MIN_PIXELS
    long = np.flatnonzero(is_long[chain])
    number = (np.cumsum(is_long) - 1).astype(np.min_scalar_type(len(at)))  # small: sorted faster
    chain = number[chain.take(long)]
    order = np.argsort(chain, kind="stable")
    at, gradient = at.take(long.take(order)), gradient.take(long.take(order), axis=1)
    pieces = _straight(_edge_middles(slopes, at, gradient), gradient, chain.take(order))
    length = np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=1)
    order = np.argsort(-length, kind="stable")[:MAX_PIECES]
    return np.asarray(pieces[order[length[order] >= MIN_PIECE_LENGTH]])


def _middle(values: Image) -> float:
    """Return the median of values of any shape."""
    n = values.size
    ordered = np.partition(values, (max(n // 2 - 1, 0), n // 2), axis=None)
    return 0.5 * float(ordered[(n - 1) // 2] + ordered[n // 2])


def _chains(at: IntArray, gradient: Samples, shape: tuple[int, ...]) -> IntArray:
    """Return the chain of each edge pixel (n,): neighbours in a sector of directions.

    Sectors are laid twice, the second time between the first ones: a pixel takes the longer chain.
    """
    n = len(at)
    number = np.full(shape[0] * shape[1], n, dtype=np.int32)
    number[at] = np.arange(n, dtype=np.int32)
    neighbours = np.array([1, shape[1] - 1, shape[1], shape[1] + 1])
    other = number.take(at[:, None] + neighbours).ravel()
    links = np.flatnonzero(other < n)
    i, j = links // len(neighbours), other.take(links).astype(np.intp)
    angle = np.arctan2(gradient[1], gradient[0]) * np.float32(0.5 * N_SECTORS / np.pi)
    begins, stops = [], []
    for lay, shift in enumerate((_ASIDE, 0.5 + _ASIDE)):
        sector = np.floor(angle + np.float32(shift)).astype(np.int8) % N_SECTORS
        same = np.flatnonzero(sector.take(i) == sector.take(j))
        begins.append(i.take(same) + lay * n)
        stops.append(j.take(same) + lay * n)
    chain = _components(np.concatenate(begins), np.concatenate(stops), 2 * n)
    (one, two), (n_one, n_two) = (x.reshape(2, n) for x in (chain, np.bincount(chain).take(chain)))
    return np.asarray(np.where(n_two > n_one, two, one), dtype=np.intp)


def _components(i: IntArray, j: IntArray, n: int) -> IntArray:
    """Return the connected component of each of n nodes, by links from i to greater j."""
    label: IntArray = np.arange(n)
    while len(i):  # each round at least halves the nodes that still have links to others
        above: IntArray = np.arange(n)
        above[j] = i  # each node follows a lesser one, if it has a link to any
        higher = above.take(above)
        while not np.array_equal(higher, above):
            above, higher = higher, higher.take(higher)
        is_first = above == np.arange(n)
        tree = (np.cumsum(is_first) - 1).take(above)
        label, n = tree.take(label), int(np.count_nonzero(is_first))
        i, j = tree.take(i), tree.take(j)
        other = np.flatnonzero(i != j)
        i, j = i.take(other), j.take(other)
        i, j = np.minimum(i, j), np.maximum(i, j)
    return label


def _edge_middles(slopes: Image, at: IntArray, gradient: Samples) -> Array:
    """Return the points (2, n) next to pixels where light changes most, across their edges."""
    height, width = slopes.shape[1:]
    upright = np.abs(gradient[0]) < np.abs(gradient[1])  # light changes along y, else along x
    place, step = at + upright * (height * width), np.where(upright, width, 1)
    before, here, after = (
        np.abs(slopes.take(place + k * step)).astype(np.float64) for k in (-1, 0, 1)
    )
    bend = np.maximum(2.0 * here - before - after, 1.0)  # of a parabola
    off = np.clip(0.5 * (after - before) / bend, -MAX_SUBPIXEL, MAX_SUBPIXEL)
    y, x = np.divmod(at, width)
    return np.stack([x + off * ~upright, y + off * upright])


def _straight(points: Array, gradient: Samples, chain: IntArray) -> Array:
    """Return the straight pieces (n, 2, 2) of chains, whose pixels follow each other.

    What bends is cut where it is farthest from the line between its ends.
    """
    pieces = []
    x, y = points
    gx, gy = gradient.astype(np.float64)
    for _ in range(MAX_CUTS + 1):
        n = np.bincount(chain)
        long = np.flatnonzero((n >= MIN_PIXELS).take(chain))
        if len(long) < len(chain):
            x, y, gx, gy, chain = (one.take(long) for one in (x, y, gx, gy, chain))
        if len(chain) == 0:
            break
        n = n[n >= MIN_PIXELS]
        first = np.cumsum(n) - n
        mx, my, mgx, mgy = (np.add.reduceat(one, first) / n for one in (x, y, gx, gy))
        dx, dy = x - np.repeat(mx, n), y - np.repeat(my, n)
        xx, xy, yy = (np.add.reduceat(one, first) for one in (dx * dx, dx * dy, dy * dy))
        turn = 0.5 * np.arctan2(2.0 * xy, xx - yy)
        u = np.stack([np.cos(turn), np.sin(turn)])
        u *= np.where(u[1] * mgx - u[0] * mgy >= 0.0, 1.0, -1.0)  # the brighter side on the left
        ux, uy = np.repeat(u, n, axis=1)
        place, off = dx * ux + dy * uy, dy * ux - dx * uy
        is_straight = np.maximum.reduceat(np.abs(off), first) <= MAX_SAG
        ends = np.stack([one.reduceat(place, first) for one in (np.minimum, np.maximum)])
        middle = np.stack([mx, my])
        lines = (middle + ends[:, None] * u).transpose(2, 0, 1)
        pieces.append(lines[is_straight])
        bent = np.flatnonzero(np.repeat(~is_straight, n))
        if len(bent) == 0:
            break
        x, y, gx, gy, place, off = (one.take(bent) for one in (x, y, gx, gy, place, off))
        n, ends = n[~is_straight], ends[:, ~is_straight]
        first = np.cumsum(n) - n
        # The pixel farthest from the line between the first and the last begins the second half.
        begin, end = (off[_first_of(place, one, first, n)] for one in ends)
        slope = (end - begin) / np.maximum(ends[1] - ends[0], 1e-9)
        sag = np.abs(off - np.repeat(begin - slope * ends[0], n) - np.repeat(slope, n) * place)
        cut = place[_first_of(sag, np.maximum.reduceat(sag, first), first, n)]
        half = place >= np.repeat(cut, n)
        chain = (2 * np.repeat(np.arange(len(n)), n) + half).astype(
            np.min_scalar_type(len(points.T))
        )
        order = np.argsort(chain, kind="stable")
        x, y, gx, gy, chain = (one.take(order) for one in (x, y, gx, gy, chain))
    return np.concatenate([np.zeros((0, 2, 2)), *pieces])


def _first_of(values: Array, value: Array, first: IntArray, n: IntArray) -> IntArray:
    """Return the index of the first occurrence of each value within its group."""
    at = np.flatnonzero(values == np.repeat(value, n))
    return at[np.searchsorted(at, first)]


def _stretched(small: Grey) -> NDArray[np.uint8]:
    """Return about the logarithm of the light: a dark leg's edges count as much as a bright one's.

    What is darker than ``DARK`` of the brightest is mostly noise and keeps its distances.
    """
    values = small[::4, ::4]
    k, share = divmod(0.995 * (values.size - 1), 1.0)
    near = int(k), min(int(k) + 1, values.size - 1)
    low, high = np.partition(values, near, axis=None)[list(near)].tolist()
    top = max(float(low + share * (high - low)), 1.0)
    light = np.clip(small, 0.0, np.float32(top))
    light /= np.float32(DARK * top)
    light += 1.0
    cv2.log(light, dst=light)
    light *= 255.0 / math.log1p(1.0 / DARK)
    return light.astype(np.uint8)


def _join(ends: Array) -> tuple[Array, Array]:
    """Join pieces that continue each other; return the edges and how much of them was seen."""
    along = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(along, axis=1)
    along = along / length[:, None]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    middle = ends.mean(axis=1)
    # Segment j against the line of piece i, the longer one (pieces come longest first).
    i, j = np.nonzero(along @ along.T >= np.cos(MAX_TURN))
    i, j = (x[i < j] for x in (i, j))
    to_ends = ends[j] - middle[i, None]
    offset = np.abs(np.einsum("nkx,nx->nk", to_ends, normal[i])).max(axis=1)
    place = np.einsum("nkx,nx->nk", to_ends, along[i])
    gap = np.maximum(place.min(axis=1), -place.max(axis=1)) - 0.5 * length[i]
    # A long way ahead a line is known less well.
    allowed = MAX_OFFSET * (1.0 + 0.5 * np.maximum(gap, 0.0) / length[i])
    near = (gap <= MAX_GAP * length[j]) & (offset <= np.minimum(allowed, 2 * MAX_OFFSET))
    i, j = i[near], j[near]
    label = _components(i, j, len(ends))
    order = np.argsort(label, kind="stable")
    found, covered = _fitted(ends[order], length[order], label[order])
    long = np.linalg.norm(found[:, 1] - found[:, 0], axis=1) >= EDGE_LENGTH
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
    place, offset = away[..., 0] * x + away[..., 1] * y, away[..., 1] * x - away[..., 0] * y
    start = np.minimum.reduceat(place.min(axis=1), first)
    stop = np.maximum.reduceat(place.max(axis=1), first)
    lines = centre[:, None] + np.stack([start, stop], axis=1)[..., None] * direction[:, None]
    straight = np.maximum.reduceat(np.abs(offset).max(axis=1), first) <= 1.5 * MAX_OFFSET
    bent = ~straight[label]
    order = np.argsort(np.concatenate([np.flatnonzero(straight), label[bent]]), kind="stable")
    share = np.minimum(total / (stop - start), 1.0)
    return (
        np.concatenate([lines[straight], pieces[bent]])[order],
        np.concatenate([share[straight], np.ones(np.count_nonzero(bent))])[order],
    )


@dataclass(frozen=True, eq=False)
class CandidatePairs(Table):
    """Candidate cylinders of a picture, best first, on its sensor plane."""

    middle: Array  # (n, 2) of the axis
    along: Array  # (n, 2) unit direction of the axis
    half_length: Array  # (n,) from the middle to the ends
    width: Array  # (n, 2) distance of the edges at both ends; the first one is against ``along``
    merit: Array  # (n,) length on which both edges were seen
    pixel: float  # how well edges are known

    @property
    def best_merit(self) -> float:
        """Merit of the best pairs together."""
        return float(self.merit[:N_BEST].sum())

    @property
    def normal(self) -> Array:
        """Unit normals (n, 2) of the axes."""
        return np.stack([-self.along[:, 1], self.along[:, 0]], axis=1)


def find_candidate_pairs(segments: EdgeSegments) -> CandidatePairs:
    """Return the best pairs of edges that may be a cylinder."""
    ends, pixel = segments.ends, segments.pixel
    along = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(along, axis=1)
    along = along / np.where(length > 0.0, length, 1.0)[:, None]
    cosines = along @ along.T
    i, j = np.nonzero(np.abs(cosines) >= np.cos(MAX_CONVERGENCE))
    i, j = (x[i < j] for x in (i, j))
    cosine = cosines[i, j]
    axis = along[i] * length[i, None] + np.sign(cosine)[:, None] * along[j] * length[j, None]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    across = np.stack([-axis[:, 1], axis[:, 0]], axis=1)
    middle = 0.5 * (ends[:, 0] + ends[:, 1])
    origin = 0.5 * (middle[i] + middle[j])
    frame = np.stack([axis, across], axis=2)
    spans, lines = [], []
    for edge in (i, j):
        t, v = ((ends[edge] - origin[:, None]) @ frame).transpose(2, 0, 1)
        slope = (v[:, 1] - v[:, 0]) / (t[:, 1] - t[:, 0])
        spans.append((np.minimum(t[:, 0], t[:, 1]), np.maximum(t[:, 0], t[:, 1])))
        lines.append((v[:, 0] - slope * t[:, 0], slope))
    first, last = np.maximum(spans[0][0], spans[1][0]), np.minimum(spans[0][1], spans[1][1])
    overlap = last - first
    longer = np.maximum(length[i], length[j])
    offsets = [at + slope * np.stack([first, last]) for at, slope in lines]  # each (2, n)
    gap = offsets[1] - offsets[0]
    width = np.abs(gap)
    good = (overlap >= MIN_OVERLAP * longer) & (gap[0] * gap[1] > 0.0)
    good &= (width.min(axis=0) >= MIN_WIDTH * pixel) & (width.max(axis=0) <= MAX_WIDTH * pixel)
    good &= overlap >= MIN_SLENDERNESS * width.mean(axis=0)
    merit = overlap * np.minimum(segments.covered[i], segments.covered[j])
    merit = (
        merit
        * np.where(cosine < 0.0, 1.0, SAME_POLARITY)
        * np.sqrt(np.maximum(overlap, 0.0) / longer)
    )
    centre = 0.5 * (offsets[0] + offsets[1])  # (2, n) of the axis at both ends
    start, stop = (
        origin + t[:, None] * axis + v[:, None] * across
        for t, v in ((first, centre[0]), (last, centre[1]))
    )
    chosen = _best(np.where(good, merit, 0.0), i, j, len(ends))
    chosen = chosen[_distinct(start[chosen], stop[chosen], width.mean(axis=0)[chosen])]
    start, stop = start[chosen], stop[chosen]
    full = np.linalg.norm(stop - start, axis=1)
    return CandidatePairs(
        0.5 * (start + stop),
        (stop - start) / full[:, None],
        0.5 * full,
        width.T[chosen],
        merit[chosen],
        pixel,
    )


def _best(merit: Array, i: IntArray, j: IntArray, n_edges: int) -> IntArray:
    """Return the best pairs, few of each edge: more than wanted, some of them may be alike."""
    order = np.argsort(-merit, kind="stable")
    order = order[merit[order] > 0.0]
    used, chosen = [0] * n_edges, list[int]()
    for k, one, two in zip(order.tolist(), i[order].tolist(), j[order].tolist(), strict=True):
        if len(chosen) == 2 * MAX_PAIRS:
            break
        if max(used[one], used[two]) < MAX_PAIRS_OF_EDGE:
            used[one] += 1
            used[two] += 1
            chosen.append(k)
    return np.array(chosen, dtype=np.intp)


def _distinct(start: Array, stop: Array, width: Array) -> IntArray:
    """Return the pairs, best first, that are not within better ones of the same width."""
    along = stop - start
    length = np.linalg.norm(along, axis=1)
    along = along / length[:, None]
    # Ends of pair j in the frame of pair i.
    to_ends = np.stack([start, stop], axis=1)[None] - start[:, None, None]
    place = np.einsum("ijkx,ix->ijk", to_ends, along)
    offset = to_ends[..., 1] * along[:, None, None, 0] - to_ends[..., 0] * along[:, None, None, 1]
    middle = place.mean(axis=2)
    alike = np.abs(offset).max(axis=2) <= DUPLICATE[0] * width[:, None]
    alike &= (middle > 0.0) & (middle < length[:, None])
    alike &= np.abs(width[None, :] - width[:, None]) <= DUPLICATE[1] * width[:, None]
    return first_apart(alike.T, MAX_PAIRS)
