"""Sums over the pixels of blocks beside outlines, by their distance from the outline.

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

import numpy as np
from scipy.special import ndtr

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.perception.light import Samples

BINS_PER_BLUR = 3.0
STEP_END = (1.0, 2.5)  # distance from an outline at which the step is over: [px] and in blurs
N_SMOOTH = 3  # of the polynomial that describes a side of a block: constant to quadratic
SIDE_PIXELS = (5.0, 15.0)  # on a side of a block, from where on it says how noisy that is, and all
MIN_NOISE = 0.3  # of rounded grey levels: their standard deviation
MAX_NOISE_RATIO = 8.0  # of the noise on both sides
MIN_BLOCKS = 3  # blocks of an outline that give its noise


@dataclass(frozen=True, eq=False)
class PixelSums:
    """Sums over the pixels of blocks, in bins of their distances from the lines.

    Pixels count by their squared weights; o is the distance of one from the middle of its bin.
    """

    grid: Array  # (m,) middles of the bins [px]
    weight: Array  # (n, 3, m) of 1, o, and o^2
    light: Array  # (n, 2, m) of the light, and of the light times o
    power: Array  # (n, m) of its square
    count: Array  # (n, m) how many pixels, by their windows alone

    def of_blocks(self, blocks: BoolArray) -> "PixelSums":
        """Return the sums of some blocks (n,)."""
        of_pixels = self.weight, self.light, self.power, self.count
        return PixelSums(self.grid, *(sums[blocks] for sums in of_pixels))

    def joined(self, first: IntArray) -> "PixelSums":
        """Return the sums of blocks that consist of these, each from its first one (n_joined,)."""
        if len(first) == len(self.count):
            return self
        of_pixels = self.weight, self.light, self.power, self.count
        return PixelSums(self.grid, *(np.add.reduceat(sums, first, axis=0) for sums in of_pixels))

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
        one, other, pair = _pairs(values.shape[-1])
        left, right = values[..., one], values[..., other]
        rise, fall = slopes[..., one], slopes[..., other]
        pairs = np.concatenate([left * right, rise * right + left * fall, rise * fall], axis=1)
        return _by_groups(self.weight, pairs, bounds).take(pair, axis=1)

    def with_light(self, values: Array, slopes: Array, bounds: Sequence[int]) -> Array:
        """Return sums of products of functions and light (n, k); functions as for products."""
        return _by_groups(self.light, np.concatenate([values, slopes], axis=1), bounds)


def _by_groups(sums: Array, functions: Array, bounds: Sequence[int]) -> Array:
    """Return sums (n, i, m) times functions (n_groups, i m, k) of their groups, (n, k)."""
    flat = sums.reshape(len(sums), -1)
    found = np.empty((len(sums), functions.shape[-1]))
    for of_group, (first, last) in zip(functions, pairwise(bounds), strict=True):
        np.matmul(flat[first:last], of_group, out=found[first:last])
    return found


@lru_cache(maxsize=8)
def _pairs(k: int) -> tuple[IntArray, IntArray, IntArray]:
    """Return the pairs (n,) of k functions, and which pair every two of them are, (k, k)."""
    one, other = np.triu_indices(k)
    pair = np.empty((k, k), dtype=np.intp)
    pair[one, other] = pair[other, one] = np.arange(len(one))
    return one, other, pair


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
    found, some = np.full(len(ends) - 1, np.nan), ends[1:] > ends[:-1]
    found[some] = ordered[((ends[:-1] + ends[1:]) // 2)[some]]
    return found


def applied(matrices: Array, vectors: Array) -> Array:
    """Return the products (n, i) of matrices (n, i, k) with vectors (n, k)."""
    return np.asarray((matrices @ vectors[..., None])[..., 0], dtype=np.float64)
