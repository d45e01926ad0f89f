"""Pixels beside an outline with their distances from it, and sums over them: the data of limb fits.

No pixel is interpolated: rows of the picture (columns, where the outline is flat) are
read as they are, and the distance of every pixel centre from the outline is computed. Grey levels
become light, which is grey levels to the power gamma.

What is fitted to an outline is a function of the distance. Pixels are counted in bins of distance
that are finer than the blur, with the moments of where they lie in their bin, and functions are
taken to be straight within bins. All sums of products of such functions over pixels are products of
two small matrices then, for all functions and blurs alike: pixels are looked at again only where
their line has moved.

Noise grows with light, and a surface has texture: a dark background is several times quieter than a
lit leg in front of it, so that the foot of the blurred step determines its place better than the
top. :func:`even_weights` are those by the noise that is seen on both sides.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from legcal.geometry.tables import Table
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.vision.camera import Camera
from legcal.vision.image_file import Grey
from legcal.vision.visibility import Band

Samples = NDArray[np.float32]

SATURATED = 250.0  # grey level from which a pixel is saturated
MAX_NOISY = 4  # saturated pixels of a block that may be noise
MAX_OFFSET = 1.0  # how far an outline may be from where it was found [px]
MIN_SHARE_CLIPPED = 0.5  # share of saturated pixels with which a background is clipped
MAX_ROWS = 512  # along one outline
TAPER = 1.0  # over which pixels come to count where the used range begins [px]
NODE_SPACING = 16.0  # between points at which the lens distortion is computed [px]


@dataclass(frozen=True, eq=False)
class Edge:
    """An outline that is known to about a pixel."""

    band: Band  # the frame of its part
    v: Array  # (2,) offsets at both ends of the band [px]
    epsilon: float  # +1 for edge 1, whose inside has greater v, -1 for edge 2
    half_width: float  # of the part in the image [px]
    hidden: BoolArray  # (n,) which of n equal stretches of the band other legs hide
    polished: bool = False  # the surface of its part


@dataclass(frozen=True, eq=False)
class Profiles:
    """Blocks of pixels along outlines, one outline after the other."""

    bounds: IntArray  # (n_edges + 1,) first block of each outline
    position: Array  # (n_blocks,) as fractions of the bands
    gain: Array  # (n_blocks,) pixels of distance in the image per unit of v of the band; near 1
    d: Samples  # (n_blocks, n_samples) distances inside the outline [px]
    grey: Samples  # (n_blocks, n_samples) grey levels
    # (n_blocks, n_samples) how much pixels count: 0 outside the image, out of range and saturated,
    # falling from 1 within TAPER where the range ends, so that no pixel counts or not by a hair
    window: Samples
    clipped: Samples  # (n_blocks,) depth up to which the background saturates [px], or -inf


def read_profiles(
    grey: Grey,
    camera: Camera,
    edges: Sequence[Edge],
    v: Sequence[Array],
    depths: tuple[float, Array],
    n_rows: int,
    most: int | None = None,
) -> Profiles:
    """Read the pixels beside one outline or more with offsets v (2,), where nothing hides them.

    Up to the depths (outside, and inside of each) from the outlines [px], in blocks of ``n_rows``;
    about ``most`` blocks of each outline at even distances, all of them by default.
    """
    nodes = _nodes(camera, edges, np.array(v))
    rows = nodes.rows(n_rows)
    # Blocks that are read: a few consecutive rows of one edge.
    position = nodes.at(rows, nodes.position).reshape(-1, n_rows).mean(axis=1)
    edge = rows.edge[::n_rows]
    free = np.ones(len(edge), dtype=np.bool_)
    if most is not None:
        first = np.searchsorted(edge, np.arange(len(edges) + 1))
        step = np.maximum(np.diff(first) // most, 1)
        free = (np.arange(len(edge)) - first[edge]) % step[edge] == 0
    for k, searched in enumerate(edges):
        if np.any(searched.hidden):
            n, blocks = len(searched.hidden), slice(*np.searchsorted(edge, [k, k + 1]))
            free[blocks] &= ~searched.hidden[
                np.clip((position[blocks] * n).astype(np.intp), 0, n - 1)
            ]
    kept = np.repeat(free, n_rows)
    rows = _Rows(rows.edge[kept], rows.along[kept], rows.node[kept], rows.part[kept])
    edge = edge[free]
    centre, tangent = nodes.at(rows, nodes.offset), nodes.at(rows, nodes.slope)
    cosine = 1.0 / np.sqrt(1.0 + tangent**2)
    across = nodes.at(rows, nodes.across)
    inner = depths[1][rows.edge]
    outside, inside_of = depths[0] + 0.5 * TAPER, inner + 0.5 * TAPER
    first = np.ceil(centre - np.where(across > 0.0, outside, inside_of) / cosine)
    n_columns = int(np.max((outside + inside_of) / cosine, initial=0.0)) + 1
    columns = first[:, None] + np.arange(n_columns)
    d = (columns - centre[:, None]) * (cosine * np.sign(across))[:, None]
    height, width = len(grey), grey.shape[1]
    flat = nodes.flat[rows.edge][:, None]
    along = rows.along[:, None]
    n_columns_there, n_rows_there = np.where(flat, height, width), np.where(flat, width, height)
    inside = (columns >= 0) & (columns < n_columns_there) & (along >= 0) & (along < n_rows_there)
    window = np.minimum(fading(-d, depths[0]), fading(d, inner[:, None])) * inside
    inside = window > 0.0
    row = np.clip(along, 0, n_rows_there - 1) * np.where(flat, 1, width)
    column = np.clip(columns, 0, n_columns_there - 1) * np.where(flat, width, 1)
    values = np.asarray(np.ravel(grey).take((row + column).astype(np.intp)), dtype=np.float32)
    shape = (len(edge), n_rows * n_columns)
    distance, values = d.reshape(shape).astype(np.float32), values.reshape(shape)
    inside, window = inside.reshape(shape), window.reshape(shape).astype(np.float32)
    clipped, bright = _unsaturated(distance, values, inside)
    # A step dv moves the outline by dv across; its part normal to the tangent is the gain.
    gain = np.abs(nodes.at(rows, nodes.gain)) * cosine
    return Profiles(
        np.searchsorted(edge, np.arange(len(edges) + 1)),
        position[free],
        gain.reshape(-1, n_rows).mean(axis=1),
        distance,
        values,
        window * ((distance > clipped[:, None]) & (distance < bright[:, None])),
        clipped,
    )


def fading(depth: NDArray[Any], end: NDArray[Any] | float) -> NDArray[Any]:
    """Return the weights of pixels at depths, with a used range that ends at ``end`` [px].

    From 1 to 0 within TAPER, half of it to either side of the end.
    """
    within = end + 0.5 * TAPER - depth
    return np.asarray(np.clip(within / TAPER, 0.0, 1.0), dtype=depth.dtype)


class _Rows(NamedTuple):
    """Rows of pixels (columns, where an outline is flat) that outlines cross, edge by edge."""

    edge: IntArray  # (n,)
    along: Array  # (n,) y of rows, x of columns [px]
    node: IntArray  # (n,) the node before it, among those of all edges
    part: Array  # (n,) how far it is towards the next


@dataclass(frozen=True, eq=False)
class _Nodes:
    """Points of outlines between which the image is taken to be without distortion."""

    flat: BoolArray  # (n_edges,) whether an outline crosses columns in place of rows
    position: Array  # (n_edges, n_nodes) fractions of the bands
    along: Array  # (n_edges, n_nodes) y, or x of flat outlines, rising [px]
    offset: Array  # (n_edges, n_nodes) x, or y of flat outlines [px]
    slope: Array  # (n_edges, n_nodes) the change of offset by along
    across: Array  # (n_edges, n_nodes) how offset changes inwards; only its sign is of use
    gain: Array  # (n_edges, n_nodes) px of offset at the same along, by px of v

    def rows(self, n_rows: int) -> _Rows:
        """Return the rows of all whole blocks."""
        first, last = np.ceil(self.along[:, 0]), np.floor(self.along[:, -1])
        available = np.maximum(0, (last - first).astype(np.intp) + 1)
        stride = np.maximum(1, -(-available // MAX_ROWS))
        # Blocks stay where they are in the image while bands move by less.
        first = np.ceil(first / (n_rows * stride)) * (n_rows * stride)
        available = np.maximum(0, (last - first).astype(np.intp) + 1)
        n = available // (n_rows * stride) * n_rows
        edge = np.repeat(np.arange(len(n)), n)
        number = np.arange(len(edge)) - np.repeat(np.cumsum(n) - n, n)
        along = first[edge] + stride[edge] * number
        n_nodes = self.along.shape[1]
        apart = 4.0 * np.abs(self.along).max(initial=0.0) + 1.0  # puts one edge after the other
        keys = self.along + apart * np.arange(len(n))[:, None]
        node = np.searchsorted(keys.ravel(), along + apart * edge, side="right") - 1
        node = np.clip(node, edge * n_nodes, edge * n_nodes + n_nodes - 2)
        here, there = self.along.ravel()[node], self.along.ravel()[node + 1]
        return _Rows(edge, along, node, (along - here) / np.maximum(there - here, 1e-9))

    def at(self, rows: _Rows, values: Array) -> Array:
        """Return values of nodes (n_edges, n_nodes) at rows (n,)."""
        values = values.ravel()
        here = values[rows.node]
        return np.asarray(here + (values[rows.node + 1] - here) * rows.part)


def _nodes(camera: Camera, edges: Sequence[Edge], v: Array) -> _Nodes:
    """Return points of all outlines with offsets v (n_edges, 2) [px]."""
    bands = [edge.band for edge in edges]
    length, scale = np.array([[b.length, b.scale] for b in bands]).T[..., None]
    origin, along, normal = np.array([[b.origin, b.along, b.normal] for b in bands]).swapaxes(0, 1)
    origin, along, normal = origin[:, None], along[:, None], normal[:, None]
    position = np.linspace(0.0, 1.0, max(3, int(length.max() / NODE_SPACING) + 1))
    at = v[:, :1] + (v[:, 1:] - v[:, :1]) * position
    xy = origin + (length / scale * position)[..., None] * along + (at / scale)[..., None] * normal
    pixels = camera.distort(xy)
    across = np.sum(camera.pixels_per_unit(xy) * normal[:, :, None, :], axis=-1) / scale[..., None]
    reach = np.abs(pixels[:, -1] - pixels[:, 0])
    flat = reach[:, 0] > reach[:, 1]
    pixels, across = (np.where(flat[:, None, None], x[..., ::-1], x) for x in (pixels, across))
    order = np.argsort(pixels[..., 1], axis=1, kind="stable")
    offset, along_px = (np.take_along_axis(pixels[..., k], order, axis=1) for k in (0, 1))
    inwards, besides = (np.take_along_axis(across[..., k], order, axis=1) for k in (0, 1))
    slope = _slopes(offset, along_px)
    epsilon = np.array([[edge.epsilon] for edge in edges])
    return _Nodes(
        flat,
        np.take_along_axis(np.broadcast_to(position, order.shape), order, axis=1),
        along_px,
        offset,
        slope,
        epsilon * inwards,
        inwards - besides * slope,
    )


def _slopes(y: Array, x: Array) -> Array:
    """Return dy/dx at the points of curves (n, m) with rising x, to second order inside."""
    rise = np.diff(y, axis=1) / np.maximum(np.diff(x, axis=1), 1e-9)
    apart = np.diff(x, axis=1)
    part = apart[:, :-1] / np.maximum(apart[:, :-1] + apart[:, 1:], 1e-9)
    inner = rise[:, :-1] + (rise[:, 1:] - rise[:, :-1]) * part
    return np.concatenate([rise[:, :1], inner, rise[:, -1:]], axis=1)


def _unsaturated(d: Samples, grey: Grey, inside: BoolArray) -> tuple[Samples, Samples]:
    """Return between which depths (n,) of each block nothing saturates the picture.

    Clipped, a background ends the blurred step too early, and the outline would seem to lie where
    the rest of the step does. One whose noise alone reaches saturation is not clipped.
    """
    first, last = (np.full(len(d), at, dtype=np.float32) for at in (-np.inf, np.inf))
    bright = inside & (grey >= SATURATED)
    some = np.flatnonzero(np.count_nonzero(bright, axis=1) > MAX_NOISY)
    if len(some) == 0:
        return first, last
    d, bright, inside = d[some], bright[some], inside[some]
    behind = np.partition(np.where(bright & (d < 0.0), d, -np.inf), -1 - MAX_NOISY, axis=1)[
        :, -1 - MAX_NOISY
    ]
    beyond = inside & (d <= behind[:, None])
    n_bright = np.count_nonzero(beyond & bright, axis=1)
    clipped = (n_bright > MIN_SHARE_CLIPPED * np.count_nonzero(beyond, axis=1))[:, None]
    # The line may be off: what is bright near it is the background, where that is clipped.
    near = np.where(clipped, np.float32(MAX_OFFSET), np.float32(0.0))
    first[some] = np.max(np.where(bright & clipped & (d < near), d, -np.inf), axis=1)
    last[some] = np.partition(np.where(bright & (d > near), d, np.inf), MAX_NOISY, axis=1)[
        :, MAX_NOISY
    ]
    return first, last


DARK = 12.0  # grey level below which the noise is constant
BINS_PER_BLUR = 3.0
STEP_END = (1.0, 2.5)  # distance from an outline at which the step is over: [px] and in blurs
N_SMOOTH = 3  # coefficients of the polynomial on a side of a block: constant to quadratic
SIDE_PIXELS = (5.0, 15.0)  # on a side of a block, from where on it says how noisy that is, and all
MIN_NOISE = 0.3  # standard deviation of rounding to grey levels
MAX_NOISE_RATIO = 8.0  # largest ratio of the noise on both sides
MIN_BLOCKS = 3  # blocks of an outline that give its noise


def to_light(grey: Samples, window: Samples, gamma: float) -> tuple[Samples, Samples]:
    """Return light (n, m) in blocks of pixels, and the weights by noise of grey levels.

    Light changes as grey levels do at the mean of the block; pixels count by their window. Noise of
    grey levels is taken to be even in a block: shot noise grows like the root of light, so that it
    is even all over a picture where gamma is 2.
    """
    if gamma == 1.0:
        return grey, window
    level = np.sum(grey * window, axis=1) / np.maximum(window.sum(axis=1), 1.0)
    level = np.maximum(level, DARK).astype(np.float32)[:, None]
    light = (level / np.float32(gamma)) * (np.maximum(grey, 0.0) / level) ** np.float32(gamma)
    weight = window * (np.maximum(grey, DARK) / level) ** np.float32(1.0 - gamma)
    return light.astype(np.float32), weight.astype(np.float32)


@dataclass(frozen=True, eq=False)
class PixelSums(Table):
    """Sums over the pixels of blocks, in bins of their distances from the lines.

    Pixels count by their squared weights; o is the distance of one from the middle of its bin.
    """

    common = ("grid",)

    grid: Array  # (m,) middles of the bins [px]
    weight: Array  # (n, 3, m) of 1, o, and o^2
    light: Array  # (n, 2, m) of the light, and of the light times o
    power: Array  # (n, m) of its square
    count: Array  # (n, m) how many pixels, by their windows alone

    def summed(self, first: IntArray) -> "PixelSums":
        """Return the sums of blocks that consist of these, each from its first one (n_summed,)."""
        if len(first) == len(self.count):
            return self
        sums = self.columns().values()
        return PixelSums(self.grid, *(np.add.reduceat(x, first, axis=0) for x in sums))

    def shared(self, share: Array) -> "PixelSums":
        """Return the sums of blocks that count as so many (n,)."""
        part, parts = share[:, None], share[:, None, None]
        of_pixels = self.weight * parts, self.light * parts, self.power * part, self.count * part
        return PixelSums(self.grid, *of_pixels)

    def weighted(self, share: Array) -> "PixelSums":
        """Return the sums with squared weights times shares (n, m) for each bin."""
        share = share[:, None]
        weight, light, power = self.weight * share, self.light * share, self.power * share[:, 0]
        return PixelSums(self.grid, weight, light, power, self.count)

    def products(self, values: Array, slopes: Array, bounds: Sequence[int]) -> Array:
        """Return sums of products of functions (n, k, k).

        Functions of the distance have values and slopes [1/px] (n_groups, m, k) in the middles of
        bins; each group is for the blocks between two successive bounds (n_groups + 1,).
        """
        i, j, pair = _pairs(values.shape[-1])
        left, right = values[..., i], values[..., j]
        rise, fall = slopes[..., i], slopes[..., j]
        pairs = np.concatenate([left * right, rise * right + left * fall, rise * fall], axis=1)
        return _by_groups(self.weight, pairs, bounds).take(pair, axis=1)

    def with_light(self, values: Array, slopes: Array, bounds: Sequence[int]) -> Array:
        """Return sums of products of functions and light (n, k); functions as for products."""
        return _by_groups(self.light, np.concatenate([values, slopes], axis=1), bounds)


def _by_groups(sums: Array, functions: Array, bounds: Sequence[int]) -> Array:
    """Return sums (n, i, m) times functions (n_groups, i m, k) of their groups, (n, k)."""
    flat = sums.reshape(len(sums), -1)
    products = np.empty((len(sums), functions.shape[-1]))
    for of_group, (first, last) in zip(functions, pairwise(bounds), strict=True):
        np.matmul(flat[first:last], of_group, out=products[first:last])
    return products


@lru_cache(maxsize=8)
def _pairs(k: int) -> tuple[IntArray, IntArray, IntArray]:
    """Return the pairs (n,) of k functions, and which pair every two of them are, (k, k)."""
    i, j = np.triu_indices(k)
    pair = np.empty((k, k), dtype=np.intp)
    pair[i, j] = pair[j, i] = np.arange(len(i))
    return i, j, pair


@dataclass(frozen=True, eq=False)
class PixelBins:
    """The bins of pixels, by their distances inside the lines."""

    grid: Array  # (m,) middles of the bins [px]
    entry: IntArray  # (n_rows k,) bin of each pixel, those of one block after the other
    square: Samples  # (n_rows, k) squared weights
    moment: Samples  # (n_rows, k) times o
    weight: Array  # (n, 3, m), and
    count: Array  # (n, m) as in PixelSums

    @classmethod
    def of(
        cls,
        d: Samples,
        weight: Samples,
        blur: float,
        block: IntArray | None = None,
        window: Samples | None = None,
    ) -> "PixelBins":
        """Return bins that suit a blur [px]; pixels (n_rows, k) of no weight do not count.

        Weights are by the noise of pixels and by a window (n_rows, k), 1 by default. Rows of pixels
        are blocks, or parts of a ``block`` (n_rows,), rising from 0 without gaps.
        """
        used = weight > 0.0
        per_px = np.float32(BINS_PER_BLUR / blur)
        place = d * per_px
        number = np.rint(place)
        np.copyto(number, 0.0, where=~used)
        first, last = int(number.min(initial=0)), int(number.max(initial=0))
        size = last - first + 1
        block = np.arange(len(d)) if block is None else block
        n = int(block[-1]) + 1 if len(block) else 0
        entry = (number + (block * size - first)[:, None]).astype(np.intp).ravel()
        offset = (place - number) / per_px
        square = weight * weight
        moment = square * offset
        sums = _binned(entry, n, size, (square, moment, moment * offset))
        count = _binned(entry, n, size, (used if window is None else window * window,))[:, 0]
        grid = np.arange(first, last + 1) / float(per_px)
        return cls(grid, entry, square, moment, sums, count)

    def light(self, light: Samples) -> Array:
        """Return sums (n, 2, m) of the light of all pixels (n_rows, k), as in PixelSums."""
        of_pixels = self.square * light, self.moment * light
        return _binned(self.entry, len(self.count), len(self.grid), of_pixels)

    def sums(self, light: Samples) -> PixelSums:
        """Return all sums with the light of all pixels (n_rows, k)."""
        bright = self.square * light
        of_pixels = bright, self.moment * light, bright * light
        sums = _binned(self.entry, len(self.count), len(self.grid), of_pixels)
        return PixelSums(self.grid, self.weight, sums[:, :2], sums[:, 2], self.count)


def _binned(entry: IntArray, n: int, size: int, values: Sequence[Samples | BoolArray]) -> Array:
    """Return sums (n, n_values, size) over pixels of several values (n, k)."""
    sums = np.empty((n, len(values), size))
    for k, of_pixels in enumerate(values):
        sums[:, k] = np.bincount(entry, of_pixels.ravel(), n * size).reshape(n, size)
    return sums


def noise_ratios(sums: PixelSums, bounds: IntArray, share: Array, blur: float) -> Array:
    """Return by how much noisier the inside of each edge is than its background, (n_edges,).

    The geometric mean of the variances that blocks show there about parabolas, which count by their
    ``share`` (n,), those of an edge between successive bounds; one where nothing is known. The blur
    is in px.
    """
    beyond = max(STEP_END[0], STEP_END[1] * blur)
    n_edges = len(bounds) - 1
    edge, sides = np.repeat(np.arange(n_edges), np.diff(bounds)), []
    inside, outside = np.searchsorted(sums.grid, [beyond, -beyond], side="right").tolist()
    for side in (slice(0, outside), slice(inside, None)):
        variance, count = _variance(sums, side)
        first, enough = SIDE_PIXELS
        counts = share * np.clip((count - first) / (enough - first), 0.0, 1.0)
        level = counts * np.log(np.maximum(variance, MIN_NOISE**2))
        n_known = np.bincount(edge, counts, n_edges)
        sides.append((np.bincount(edge, level, n_edges) / np.maximum(n_known, 1e-9), n_known))
    (outer, n_outer), (inner, n_inner) = sides
    known = np.minimum(n_outer, n_inner) ** 2  # sides of few blocks are taken to be alike
    ratio = np.exp((inner - outer) * known / (known + MIN_BLOCKS**2))
    return np.asarray(np.clip(ratio, MAX_NOISE_RATIO**-2, MAX_NOISE_RATIO**2))


def even_weights(grid: Array, ratio: Array, blur: float) -> Array:
    """Return squared weights (n, m) at distances inside, given the ratio (n,) of noise there.

    Either side of an outline keeps the noise that is seen there; across the blurred step the
    variance changes as light does.
    """
    rise, ratio = ndtr(grid / blur), ratio[:, None]
    # In units of the noise in the middle of the step, which keeps the mean noise about the same.
    return np.asarray(0.5 * (1.0 + ratio) / (1.0 + (ratio - 1.0) * rise))


def _variance(sums: PixelSums, side: slice) -> tuple[Array, Array]:
    """Return the variance (n,) of pixels in some bins of each block about a parabola.

    And how many pixels there are.
    """
    x = sums.grid[side]
    powers = (x - 0.5 * (x[:1] + x[-1:]))[:, None] ** np.arange(2 * N_SMOOTH - 1)
    moments = sums.weight[:, 0, side] @ powers
    right = sums.light[:, 0, side] @ powers[:, :N_SMOOTH]
    level = right[:, 0] / np.maximum(moments[:, 0], 1e-3)
    power = sums.power[:, side].sum(axis=1) - level * right[:, 0]
    right -= level[:, None] * moments[:, :N_SMOOTH]
    order = np.arange(N_SMOOTH)
    normal = moments[:, order[:, None] + order] + 1e-6 * np.eye(N_SMOOTH)
    explained = np.sum(right * np.linalg.solve(normal, right[..., None])[..., 0], axis=1)
    count = sums.count[:, side].sum(axis=1)
    free = np.maximum(count - N_SMOOTH, 1.0)
    return np.maximum(power - explained, 0.0) / free, count


def medians(values: Array, edge: IntArray, bounds: Sequence[int]) -> Array:
    """Return the middle of the values (n,) of each edge, NaN of none; the upper one of two.

    ``edge`` (n,) is that of each value, those of an edge between two successive bounds.
    """
    ordered, ends = values[np.lexsort((values, edge))], np.array(bounds)
    middle, has_values = np.full(len(ends) - 1, np.nan), ends[1:] > ends[:-1]
    middle[has_values] = ordered[((ends[:-1] + ends[1:]) // 2)[has_values]]
    return middle


def applied(matrices: Array, vectors: Array) -> Array:
    """Return the products (n, i) of matrices (n, i, k) with vectors (n, k)."""
    return np.asarray((matrices @ vectors[..., None])[..., 0], dtype=np.float64)
