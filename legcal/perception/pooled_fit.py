"""Lines of outlines fitted to the pooled blocks of an image, with the blur and covariance.

The blocks of an outline share amplitudes that change slowly along it, a line, and a blur that is
nearly that of the whole image; each block adds a little of its own, which is eliminated. Sums over
pixels are those of products of powers of the distance (:mod:`legcal.perception.limb`), so that a
round of Gauss-Newton needs no pixel as long as lines and blurs move little.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from legcal.geometry import Array, BoolArray, IntArray
from legcal.perception.blocks import Blocks
from legcal.perception.limb import N_AMPLITUDES, N_POWERS, powers, profile_functions

# Standard deviations of amplitudes, in contrasts of the outline, as limb.py orders them: of
# what an outline has in common, of its changes along the outline, and of single blocks.
COMMON = np.array([1e3, 0.3, 1e3, 1.5, 1.5, 1.0, 1.0])
ALONG = np.array([1.0, 0.3, 1.0, 1.0, 1.0, 1.0, 1.0])
OF_BLOCKS = np.array([2.0, 1.0, 0.3, 0.1, 0.1, 0.05, 0.05])
N_ALONG = 3  # polynomials along an outline: constant, linear, quadratic
PRIOR_BLUR = 0.7  # of the logarithm of the blur, a priori
BLUR_SCATTER = 0.05  # that outlines of one image seem to have, in its logarithm
ROUGHNESS = 0.02  # displacement of single blocks [px]
START_SIGMA = (0.02, 0.35)  # standard deviation of the lines that it starts from: [px] and in blurs
BLURS = (0.2, 4.0)  # least and greatest [px]
MIN_SAMPLES = 30  # pixels of a block
ENOUGH_BLOCKS, MAX_JOINED = 16, 3  # of an outline, to join some blocks, so many at most
MAX_STEP = (0.7, 0.4)  # of one round: of the line [blurs], of the logarithm of the blur
MAX_MOVE_OF_PRODUCTS = (0.08, 0.05)  # the same up to which products of powers are not summed again
CONVERGED = 0.01  # step of a line below which its rounds end [px]
ODD_NOISE = (1.5, 4.0)  # of a typical block, from where on one counts less, and not at all
MIN_NOISE = 0.05  # variance of grey levels [grey levels^2]
MIN_LIGHT = 1e-3  # of the mean light of a block
UNKNOWN_SIGMA = 1e3  # standard deviation of what is not known

COMMON_BLUR_SIGMA = 0.03  # of the logarithm of the blur of an outline, about that of the image
FIRST_ROUNDS, LAST_ROUNDS = 2, 8  # at most

ONE, OTHER = (0, 1, 2, 1, 2, 2), (0, 0, 0, 1, 1, 2)  # pairs of polynomials
SHIFT, BLUR, N_UNKNOWNS = N_AMPLITUDES, N_AMPLITUDES + 1, N_AMPLITUDES + 2  # unknowns of a block


class PooledLines(NamedTuple):
    """Lines of outlines, by how far they lie inside those on which the blocks had converged."""

    ends: Array  # (n_edges, 2) where the band begins and where it ends [px of the band]
    covariance: Array  # (n_edges, 2, 2) of these [px^2], by noise and by what shading may be
    blur: float  # standard deviation of the blur of the image [px]
    by_gamma: Array  # (n_edges,) how far each moves inside with ln gamma [px]; NaN: nothing seen


class _Iterate(NamedTuple):
    """Where the unknowns of all edges are."""

    amplitude: Array  # (n_edges, N_ALONG, N_AMPLITUDES)
    line: Array  # (n_edges, 2) in the middle, and half of the difference of the ends [px]
    log_blur: Array  # (n_edges,)
    noise: Array  # (n_edges,) [grey levels^2]
    inverse: Array  # (n_edges, N_ALONG * N_UNKNOWNS, N_ALONG * N_UNKNOWNS)


def fit_pooled(blocks: Blocks, kept: BoolArray, blur: float, depth: float) -> PooledLines:
    """Fit the blocks (n,) that lie on the lines of their edges, of each outline together.

    From a rough blur [px]; ``depth`` is the distance from the outlines at which blocks end [px].
    """
    pool = _Pool.of(blocks, kept, depth)
    n = len(pool.half_width)
    if n == 0 or not np.any(pool.seen):
        nothing = np.full(n, np.nan)
        return PooledLines(np.zeros((n, 2)), np.tile(np.eye(2), (n, 1, 1)), blur, nothing)
    start = _Iterate(
        np.zeros((n, N_ALONG, N_AMPLITUDES)),
        np.zeros((n, 2)),
        np.full(n, np.log(blur)),
        np.full(n, 4.0),
        np.zeros((n, N_ALONG * N_UNKNOWNS, N_ALONG * N_UNKNOWNS)),
    )
    found = pool.rounds(pool.first_amplitudes(start), np.log(blur), PRIOR_BLUR, FIRST_ROUNDS)
    even, sigma = _common_blur(found, pool.seen)
    found = found._replace(log_blur=np.full(n, even))
    sigma = float(np.hypot(sigma, COMMON_BLUR_SIGMA))
    found = pool.rounds(found, even, sigma, LAST_ROUNDS)
    at_ends = np.array([[1.0, -1.0], [1.0, 1.0]])
    line = [SHIFT, N_UNKNOWNS + SHIFT]
    covariance = at_ends @ found.inverse[:, line][:, :, line] @ at_ends.T
    by_gamma = _shifts_by_gamma(pool, found, sigma)
    return PooledLines(found.line @ at_ends.T, covariance, float(np.exp(even)), by_gamma)


def _common_blur(found: _Iterate, seen: BoolArray) -> tuple[float, float]:
    """Return the logarithm of the blur that most outlines of an image agree on, and its sigma."""
    log_blur = found.log_blur[seen]
    weight = 1.0 / (found.inverse[seen, BLUR, BLUR] + BLUR_SCATTER**2)
    even, robust = 0.0, weight
    for _ in range(6):
        even = float(robust @ log_blur / robust.sum())
        robust = weight / (1.0 + 0.25 * weight * (log_blur - even) ** 2)
    return even, float(robust.sum() ** -0.5)


@dataclass(frozen=True, eq=False)
class _BlockPixels:
    """The pixels of short blocks, of which a few make a block of the pool."""

    d: Array  # (n, m) from the lines on which the blocks had converged [px]
    weight: Array  # (n, m)
    light: Array  # (n, m) times the weight, less the mean of the edge
    gain: Array  # (n,)
    along: Array  # (n, N_ALONG) polynomials at the blocks
    edge: IntArray  # (n,)
    joined: IntArray  # (n,) the block of the pool to which each belongs
    level: Array  # (n_edges,) mean light of each edge

    def products(self, line: Array, log_blur: Array, edges: BoolArray) -> Array:
        """Return the products of powers and light, summed over blocks of some edges.

        (n_blocks, N_POWERS + 1, N_POWERS + 1)
        """
        some = edges[self.edge]
        edge = self.edge[some]
        moved = self.gain[some] * np.sum(line[edge] * self.along[some, :2], axis=1)
        z = (self.d[some] - moved[:, None]) / np.exp(log_blur)[edge][:, None]
        U = powers(z)  # in double precision: sums nearly cancel
        U *= self.weight[some][..., None]
        U[..., -1] = self.light[some]
        first = np.flatnonzero(np.diff(self.joined[some], prepend=-1))
        return np.asarray(np.add.reduceat(U.swapaxes(1, 2) @ U, first, axis=0))

    def changed_by_gamma(self) -> "_BlockPixels":
        """Return how the light of these pixels changes with ln gamma, in place of it."""
        light, weight = self.light + self.level[self.edge][:, None] * self.weight, self.weight
        of_block = np.maximum(light.sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-9), 1e-9)
        part = light / np.maximum(weight * of_block[:, None], 1e-9)
        change = light * np.log(np.maximum(part, MIN_LIGHT))
        totals = (np.bincount(self.edge, x.sum(axis=1), len(self.level)) for x in (change, weight))
        total, weights = totals
        mean = total / np.maximum(weights, 1e-9)
        return replace(self, light=change - mean[self.edge][:, None] * weight)


@dataclass(eq=False)
class _Pool:
    """The blocks of all edges, and which belong together."""

    pixels: _BlockPixels
    power: Array  # (n,) sum of squares of the light of each block
    n_samples: Array  # (n,)
    gain: Array  # (n,)
    edge: IntArray  # (n,)
    bounds: IntArray  # (n_edges + 1,)
    along: Array  # (n, N_ALONG) polynomials at the blocks
    half_width: Array  # (n_edges,) [px]
    contrast: Array  # (n_edges,)
    depth: float  # distance from the outlines at which blocks end [px]
    seen: BoolArray  # (n_edges,) edges with usable blocks
    # Products of powers and light of each block, and where the lines were and how wide the blur.
    products: Array  # (n, N_POWERS + 1, N_POWERS + 1)
    at_line: Array  # (n_edges, 2) NaN before products are known
    at_log_blur: Array  # (n_edges,)

    @classmethod
    def of(cls, blocks: Blocks, kept: BoolArray, depth: float) -> "_Pool":
        """Return what is needed of some blocks."""
        n_edges = len(blocks.bounds) - 1
        of_edge = np.repeat(np.arange(n_edges), np.diff(blocks.bounds))
        usable = kept & (np.count_nonzero(blocks.weight, axis=1) >= MIN_SAMPLES)
        d, grey, weight, _ = (np.asarray(x, np.float64) for x in blocks.samples(usable))
        edge = of_edge[usable]
        n_samples = np.count_nonzero(weight, axis=1)

        def total(values: Array) -> Array:
            return np.asarray(np.bincount(edge, values, n_edges), dtype=np.float64)

        weights = total(weight.sum(axis=1))
        level = total(np.sum(weight * grey, axis=1)) / np.maximum(weights, 1e-9)
        light = (grey - level[edge][:, None]) * weight
        power = np.sum(light**2, axis=1)
        spread = total(power) / np.maximum(total(n_samples), 1.0)
        rise = 2.0 * blocks.position[usable] - 1.0
        along = np.stack([np.ones_like(rise), rise, 1.5 * rise**2 - 0.5], axis=1)
        joined = _joined(np.bincount(edge, minlength=n_edges))
        pixels = _BlockPixels(d, weight, light, blocks.gain[usable], along, edge, joined, level)
        first = np.flatnonzero(np.diff(joined, prepend=-1))
        n_joined = np.diff(first, append=len(joined))

        def summed(values: Array) -> Array:
            return np.asarray(np.add.reduceat(values, first, axis=0), dtype=np.float64)

        some = np.minimum(blocks.bounds[:-1], max(len(of_edge) - 1, 0))
        return cls(
            pixels,
            summed(power),
            summed(n_samples),
            summed(pixels.gain) / n_joined,
            edge[first],
            np.searchsorted(edge[first], np.arange(n_edges + 1)),
            summed(along) / n_joined[:, None],
            np.asarray(blocks.half_width[some, 0], dtype=np.float64),
            2.0 * np.sqrt(spread) + 1.0,
            depth,
            weights > 0.0,
            np.empty((len(first), N_POWERS + 1, N_POWERS + 1)),
            np.full((n_edges, 2), np.nan),
            np.full(n_edges, np.nan),
        )

    def first_amplitudes(self, at: _Iterate) -> _Iterate:
        """Return the amplitudes that an outline has in common, with its line where it is."""
        self._update_products(at, np.ones(len(self.half_width), dtype=np.bool_))
        values, _, _ = profile_functions(self.half_width, np.exp(at.log_blur), self.depth)
        products = self._of_edges(self.products, np.ones((len(self.edge), 1)))[:, 0]
        of_edge = values @ products[:, :-1, :-1] @ values.swapaxes(1, 2)
        prior = at.noise[:, None] / (COMMON * self.contrast[:, None]) ** 2 + 1e-9
        of_edge += prior[:, :, None] * np.eye(N_AMPLITUDES)
        target = values @ products[:, :-1, -1:]
        at.amplitude[:, 0] = np.linalg.solve(of_edge, target)[..., 0]
        return at

    def rounds(self, at: _Iterate, log_blur: float, sigma: float, n: int) -> _Iterate:
        """Take Gauss-Newton steps, ``n`` at most, the blur known to ``sigma`` beforehand."""
        moving = np.ones(len(self.half_width), dtype=np.bool_)
        for _ in range(n):
            before = at
            self._update_products(at, moving)
            if np.all(moving):
                at = self._step(at, log_blur, sigma)
            else:
                at = _Iterate(*(values.copy() for values in before))
                some = _Iterate(*(values[moving] for values in before))
                step = self._part(moving)._step(some, log_blur, sigma)
                for values, new in zip(at, step, strict=True):
                    values[moving] = new
            moved = np.abs(at.line - before.line).max(axis=1)
            moving = np.maximum(moved, np.abs(at.log_blur - before.log_blur)) >= CONVERGED
            if not np.any(moving):
                break
        return at

    def _update_products(self, at: _Iterate, edges: BoolArray) -> None:
        """Sum the products of some edges again, those that have moved from where they are."""
        blur = np.exp(self.at_log_blur)
        moved = np.abs(at.line - self.at_line).sum(axis=1) / blur
        widened = np.abs(at.log_blur - self.at_log_blur)
        stale = edges & ~((moved < MAX_MOVE_OF_PRODUCTS[0]) & (widened < MAX_MOVE_OF_PRODUCTS[1]))
        if np.any(stale):
            own = stale[self.edge]
            if np.any(own):
                self.products[own] = self.pixels.products(at.line, at.log_blur, stale)
            self.at_line[stale], self.at_log_blur[stale] = at.line[stale], at.log_blur[stale]

    def _part(self, edges: BoolArray) -> "_Pool":
        """Return the blocks of some edges."""
        own = edges[self.edge]
        edge = (np.cumsum(edges) - 1)[self.edge[own]]
        return _Pool(
            self.pixels,
            self.power[own],
            self.n_samples[own],
            self.gain[own],
            edge,
            np.searchsorted(edge, np.arange(np.count_nonzero(edges) + 1)),
            self.along[own],
            self.half_width[edges],
            self.contrast[edges],
            self.depth,
            self.seen[edges],
            self.products[own],
            self.at_line[edges],
            self.at_log_blur[edges],
        )

    def _step(self, at: _Iterate, log_blur: float, sigma: float) -> _Iterate:
        """Take one step of all edges."""
        normal, right, expected = self._block_equations(at)
        normal /= at.noise[self.edge][:, None, None]
        right /= at.noise[self.edge][:, None]
        # A block's own amplitudes and place are eliminated, its blur is that of the edge:
        # what is left is known of what the edge has in common.
        own = self._own_precision()
        free = np.asarray(np.linalg.inv(normal[:, :BLUR, :BLUR] + _diagonal(own)), np.float64)
        fitted = (free @ (right[:, :BLUR] + own * expected)[..., None])[..., 0]
        noise, weight = self._noise(at, normal[:, :BLUR, :BLUR], right[:, :BLUR], fitted)
        known = _eliminated(normal, right, free, own)
        system, target = self._edge_equations(known, weight)
        precision, pull = self._prior(at, log_blur, sigma)
        n = len(self.half_width)
        shape = n, N_ALONG * N_UNKNOWNS
        whole = system + _diagonal(precision.reshape(shape))
        inverse = np.linalg.inv(whole)
        step = (inverse @ (target + pull).reshape(*shape, 1)).reshape(n, N_ALONG, N_UNKNOWNS)
        largest = MAX_STEP[0] * np.exp(at.log_blur)[:, None]
        move = np.clip(step[:, :2, SHIFT], -largest, largest)
        widen = np.clip(step[:, 0, BLUR], -MAX_STEP[1], MAX_STEP[1])
        least, most = np.log(BLURS).tolist()
        widened = np.clip(at.log_blur + widen, least, most)
        return _Iterate(
            step[..., :N_AMPLITUDES],
            at.line + move,
            np.asarray(widened),
            noise,
            np.asarray(inverse),
        )

    def response_to_gamma(self, at: _Iterate) -> tuple[Array, Array]:
        """Return the equations of what a change of ln gamma does to all edges, where they are.

        Normal matrices (n_edges, k, k), with what is known beforehand of all unknowns but the blur,
        and right sides (n_edges, k), for the unknowns of N_ALONG polynomials one after the other.
        """
        every = np.ones(len(self.half_width), dtype=np.bool_)
        self._update_products(at, every)
        normal, right, expected = self._block_equations(at)
        products = self.pixels.changed_by_gamma().products(self.at_line, self.at_log_blur, every)
        _, change, _ = replace(self, products=products)._block_equations(at)
        noise = at.noise[self.edge]
        normal, own = normal / noise[:, None, None], self._own_precision()
        right, change = right / noise[:, None], change / noise[:, None]
        free = np.asarray(np.linalg.inv(normal[:, :BLUR, :BLUR] + _diagonal(own)), np.float64)
        fitted = (free @ (right[:, :BLUR] + own * expected)[..., None])[..., 0]
        _, weight = self._noise(at, normal[:, :BLUR, :BLUR], right[:, :BLUR], fitted)
        system, target = self._edge_equations(_eliminated(normal, change, free, own), weight)
        precision, _ = self._prior(at, 0.0, UNKNOWN_SIGMA)
        shape = len(every), N_ALONG * N_UNKNOWNS
        return system + _diagonal(precision.reshape(shape)), target.reshape(shape)

    def _edge_equations(self, known: Array, weight: Array) -> tuple[Array, Array]:
        """Return what blocks (n, N_UNKNOWNS, N_UNKNOWNS + 1) that count by a weight say of edges.

        Normal matrices (n_edges, k, k) and right sides (n_edges, N_ALONG, N_UNKNOWNS).
        """
        sums = self._of_edges(known, self.along[:, ONE] * self.along[:, OTHER] * weight[:, None])
        n = len(self.half_width)
        system = np.empty((n, N_ALONG, N_UNKNOWNS, N_ALONG, N_UNKNOWNS))
        for k, (i, j) in enumerate(zip(ONE, OTHER, strict=True)):
            system[:, i, :, j] = system[:, j, :, i] = sums[:, k, :, :-1]
        side = N_ALONG * N_UNKNOWNS
        return system.reshape(n, side, side), sums[:, :N_ALONG, :, -1]

    def _block_equations(self, at: _Iterate) -> tuple[Array, Array, Array]:
        """Return the normal equations of all blocks, and the unknowns that are expected."""
        values, slopes, widenings = profile_functions(
            self.half_width, np.exp(self.at_log_blur), self.depth
        )
        edge = self.edge
        moved = self.gain * np.sum((at.line - self.at_line)[edge] * self.along[:, :2], axis=1)
        widened = values + (at.log_blur - self.at_log_blur)[:, None, None] * widenings
        amplitude = np.einsum("nj,njk->nk", self.along, at.amplitude[edge])
        design = np.empty((len(edge), N_UNKNOWNS, N_POWERS))
        design[:, :N_AMPLITUDES] = widened[edge] - moved[:, None, None] * slopes[edge]
        for k, of in ((SHIFT, slopes), (BLUR, widenings)):
            of_polynomials = (at.amplitude @ of)[edge]
            design[:, k] = np.einsum("nj,njp->np", self.along, of_polynomials)
        design[:, SHIFT] *= -self.gain[:, None]
        with_light = design @ self.products[:, :-1]
        normal = with_light[..., :-1] @ design.swapaxes(1, 2)
        expected = np.zeros((len(edge), BLUR))
        expected[:, :N_AMPLITUDES] = amplitude
        return normal, with_light[..., -1], expected

    def _noise(
        self, at: _Iterate, normal: Array, right: Array, fitted: Array
    ) -> tuple[Array, Array]:
        """Return the noise of each edge, and how much each block counts by its own."""
        explained = 2.0 * right - (normal @ fitted[..., None])[..., 0]
        explained = np.sum(fitted * explained, axis=1) * at.noise[self.edge]
        of_block = np.maximum(self.power - explained, 0.0) / np.maximum(self.n_samples - 5.0, 1.0)
        of_edge = np.ones(len(self.half_width))
        middle = (self.bounds[:-1] + self.bounds[1:]) // 2
        of_edge[self.seen] = of_block[np.lexsort((of_block, self.edge))][middle[self.seen]]
        of_edge = np.asarray(np.maximum(of_edge, MIN_NOISE))
        excess = of_block / of_edge[self.edge]
        return of_edge, np.clip((ODD_NOISE[1] - excess) / (ODD_NOISE[1] - ODD_NOISE[0]), 0.0, 1.0)

    def _own_precision(self) -> Array:
        """Return how little amplitudes and places of single blocks scatter, (n, BLUR)."""
        precision = np.empty((len(self.edge), BLUR))
        precision[:, :N_AMPLITUDES] = (OF_BLOCKS * self.contrast[self.edge][:, None]) ** -2
        precision[:, SHIFT] = ROUGHNESS**-2
        return precision

    def _prior(self, at: _Iterate, log_blur: float, sigma: float) -> tuple[Array, Array]:
        """Return what is known of the unknowns of edges beforehand: precision, and its pull."""
        precision = np.full((len(self.half_width), N_ALONG, N_UNKNOWNS), 1e10)
        pull = np.zeros_like(precision)
        contrast = self.contrast[:, None]
        precision[:, 0, :N_AMPLITUDES] = (COMMON * contrast) ** -2
        precision[:, 1:, :N_AMPLITUDES] = ((ALONG * contrast) ** -2)[:, None, :]
        near = (START_SIGMA[0] + START_SIGMA[1] * np.exp(log_blur)) ** -2
        precision[:, :2, SHIFT] = near
        pull[:, :2, SHIFT] = -at.line * near
        precision[:, 0, BLUR] = sigma**-2
        pull[:, 0, BLUR] = (log_blur - at.log_blur) * sigma**-2
        return precision, pull

    def _of_edges(self, values: Array, weight: Array) -> Array:
        """Return sums over the blocks of each edge, (n_edges, k, i, j).

        Of values (n, i, j) times weights (n, k).
        """
        n, k = len(self.half_width), weight.shape[1]
        flat = values.reshape(len(values), -1)
        sums = np.empty((n, k, flat.shape[1]))
        for edge in range(n):
            own = slice(self.bounds[edge], self.bounds[edge + 1])
            sums[edge] = weight[own].T @ flat[own]
        return sums.reshape(n, k, *values.shape[1:])


def _joined(counts: IntArray) -> IntArray:
    """Return which of successive blocks become one, given how many there are of each edge."""
    joined, n_before = [np.empty(0, dtype=np.intp)], 0
    for n in counts.tolist():
        index = np.arange(n) // int(np.clip(n // ENOUGH_BLOCKS, 1, MAX_JOINED))
        joined.append(n_before + index)
        n_before += int(index[-1]) + 1 if n else 0
    return np.concatenate(joined)


def _eliminated(normal: Array, right: Array, free: Array, own: Array) -> Array:
    """Return normal equations (n, N_UNKNOWNS, N_UNKNOWNS + 1) without what is a block's own.

    ``own`` is the precision with which its unknowns are known to be those of the edge, and ``free``
    the covariance of all unknowns but the blur, were there no others.
    """
    known = np.empty((len(own), N_UNKNOWNS, N_UNKNOWNS + 1))
    # N - N (N + P)^-1 N = P - P (N + P)^-1 P, where P is the own precision.
    known[:, :BLUR, :BLUR] = _diagonal(own) - own[:, :, None] * free * own[:, None, :]
    others = np.stack([normal[:, :BLUR, BLUR], right[:, :BLUR]], axis=-1)
    solved = free @ others
    known[:, :BLUR, BLUR:] = own[..., None] * solved
    known[:, BLUR, :BLUR] = known[:, :BLUR, BLUR]
    left = np.stack([normal[:, BLUR, BLUR], right[:, BLUR]], axis=-1)
    known[:, BLUR, BLUR:] = left - np.sum(others[..., :1] * solved, axis=1)
    return known


def _diagonal(values: Array) -> Array:
    """Return diagonal matrices (..., n, n)."""
    return np.asarray(values[..., None] * np.eye(values.shape[-1]))


def _shifts_by_gamma(pool: _Pool, at: _Iterate, even_blur: float) -> Array:
    """Return how far the middles (n_edges,) of outlines move inside with ln gamma [px], or NaN.

    ``even_blur`` is by how much the logarithms of blurs differ in the image.
    """
    normal, right = pool.response_to_gamma(at)
    moved, inverse = _solve_with_blur(normal, right, 0.0, PRIOR_BLUR)
    counts = pool.seen / (inverse[:, BLUR, BLUR] + BLUR_SCATTER**2)
    widened = float(counts @ moved[:, BLUR] / counts.sum())
    moved, _ = _solve_with_blur(normal, right, widened, even_blur)
    return np.where(pool.seen, moved[:, SHIFT], np.nan)


def _solve_with_blur(
    normal: Array, right: Array, widened: float, sigma: float
) -> tuple[Array, Array]:
    """Return the unknowns of edges (n, k) and their covariance, the blur known to sigma."""
    whole, target = normal.copy(), right.copy()
    whole[:, BLUR, BLUR] += sigma**-2
    target[:, BLUR] += widened * sigma**-2
    inverse = np.asarray(np.linalg.inv(whole), dtype=np.float64)
    return (inverse @ target[..., None])[..., 0], inverse
