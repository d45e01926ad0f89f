"""Sub-pixel lines of all outlines of an image, from edges known to about a pixel.

First rounds on a few blocks pull the lines in, with a wide blur and then with that of the image as
its best blocks show it: where it is wrong, lines lie beside their outlines, and where they do, the
blur seems wide. Then lines settle robustly on blocks that are fitted apart.
At last all blocks of an outline that lie on its line are fitted together, and the blur to all
outlines. Pixels are used as far as the blurred outline reaches and little farther, since the
further inside, the less the shading is that of a limb.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from legcal.geometry import Array, BoolArray, IntArray
from legcal.perception.limb import (
    N_AMPLITUDES,
    N_POWERS,
    Samples,
    powers_with_room,
    profile_functions,
)
from legcal.perception.picture import Grey, evened_weights, to_light
from legcal.perception.profiles import Edge, read_profiles
from legcal.perception.straight import (
    StraightFit,
    depth_for_blur,
    estimate_blur,
    fit_blocks,
    fit_straights,
)
from legcal.vision import Camera

SHALLOWEST = 0.8  # largest used depth, in half-widths
ROWS = 8  # of a block in the first rounds, and in the last ones of a sharp picture
LEAST_ROWS_CLIPPED = 16  # of a block where the background saturates the picture
SOME_CLIPPED = 0.1  # share of the blocks of an image from which on they are that long
ENOUGH, LONGEST = 16, 3  # blocks of an outline from which on longer ones are made, so many times
ROWS_PER_BLUR = 0.6  # of the blur for which such blocks are long enough [px]
VAGUE = (1.3, 0.6)  # uncertainty from which on a block tells nothing: in blurs, and [px]
SETTLED = 0.1  # movement of every line below which the rounds end [px]


@dataclass(eq=False)
class Blocks:
    """The blocks of all edges of an image, and how far their lines have moved."""

    d: Samples  # (n, m) from the lines at which they were read
    grey: Samples  # (n, m) proportional to light
    weight: Samples  # (n, m)
    gain: Array  # (n,)
    bounds: IntArray  # (n_edges + 1,) first block of each edge
    position: Array  # (n,) as fractions of the bands
    half_width: Samples  # (n, 1)
    clipped: Samples  # (n,) up to where the background saturates the picture [px], or -inf
    moved: Array  # (n,) [px]
    contrast: Array  # (n,) [grey levels]
    sharp: Array  # (n,) chi^2
    lines: list[StraightFit | None]

    @classmethod
    def read(
        cls,
        grey: Grey,
        camera: Camera,
        edges: Sequence[Edge],
        v: Sequence[Array],
        blur: float,
        most: int | None = None,
    ) -> "Blocks":
        """Read the unhidden blocks of all edges; about ``most`` short ones of each, if given."""
        outer = depth_for_blur(blur)
        rows = ROWS
        if most is None:
            rows *= int(np.clip(np.rint(blur / ROWS_PER_BLUR), 1, 4))
            shortest = min(edge.band.length * float(np.mean(~edge.hidden)) for edge in edges)
            rows = max(rows, ROWS * int(np.clip(shortest / (ROWS * ENOUGH), 1, LONGEST)))
        half_width = np.array([edge.half_width for edge in edges])
        depths = outer, np.minimum(outer, SHALLOWEST * half_width)
        read = read_profiles(grey, camera, edges, v, depths, rows, most)
        if rows < LEAST_ROWS_CLIPPED and np.mean(read.clipped > -np.inf) > SOME_CLIPPED:
            # Too few pixels of a sharp step are left in short blocks.
            read = read_profiles(grey, camera, edges, v, depths, LEAST_ROWS_CLIPPED, most)
        light, weight = to_light(read.grey, read.inside, camera.gamma)
        n = len(read.position)
        return cls(
            read.d,
            light,
            weight,
            read.gain,
            read.bounds,
            read.position,
            np.repeat(half_width, np.diff(read.bounds)).astype(np.float32)[:, None],
            read.clipped,
            np.zeros(n),
            np.zeros(n),
            np.zeros(n),
            [None] * len(edges),
        )

    def samples(self, blocks: slice | BoolArray) -> tuple[Samples, Samples, Samples, Samples]:
        """Return distances from the current lines, grey levels, weights, half-widths."""
        d = self.d[blocks] - self.moved[blocks, None].astype(np.float32)
        return d, self.grey[blocks], self.weight[blocks], self.half_width[blocks]

    def even_noise(self, kept: BoolArray, blur: float) -> None:
        """Weigh the pixels by the noise that is seen on both sides of each edge."""
        d = self.samples(slice(None))[0]
        self.weight = evened_weights(d, self.grey, self.weight, self.bounds, kept, blur)

    def contrasts(self) -> list[Array]:
        """Return the contrasts of the blocks of each edge, without sign."""
        return np.split(np.abs(self.contrast), self.bounds[1:-1])

    def clipping(self) -> list[Array]:
        """Return up to which distance inside each line the background saturates blocks [px]."""
        return np.split(self.clipped - self.moved, self.bounds[1:-1])

    def merit(self) -> Array:
        """Return how much each block tells of the blur: nothing where half of the step is cut."""
        return np.where(self.clipped > self.moved, 0.0, np.abs(self.contrast))

    def kept(self) -> BoolArray:
        """Return which blocks lie on the lines of their edges, (n,)."""
        counts = np.diff(self.bounds)
        return np.concatenate(
            [
                np.zeros(n, dtype=np.bool_) if line is None else line.kept
                for line, n in zip(self.lines, counts, strict=True)
            ]
        )

    def sharpness(self) -> list[Array]:
        """Return how clearly the blocks of each edge show a step and not a bend [chi^2]."""
        return np.split(self.sharp, self.bounds[1:-1])

    def unmove(self) -> None:
        """Put lines back to where they were read; blocks that lay on them stay kept.

        Blocks by themselves hardly tell where a limb is that rises from the level of the
        background: lines that were near the outline must not settle elsewhere.
        """
        self.moved[:] = 0.0
        self.lines = [
            None if line is None else replace(line, ends=np.zeros(2)) for line in self.lines
        ]

    def settle(self, blur: float, n_rounds: int) -> None:
        """Fit the blocks and a line to each edge in turn, until no line moves any more."""
        active = np.ones(len(self.lines), dtype=np.bool_)
        counts = np.diff(self.bounds)
        largest = min(VAGUE[0] * blur, VAGUE[1]) ** 2
        for _ in range(n_rounds):
            chosen = np.repeat(active, counts)
            fit = fit_blocks(*self.samples(chosen), blur)
            self.contrast[chosen] = fit.contrast(self.half_width[chosen], blur)
            self.sharp[chosen] = fit.sharpness()
            bounds = np.concatenate([[0], np.cumsum(counts[active])])
            gain, position, before = (x[chosen] for x in (self.gain, self.position, self.moved))
            shift = (before + fit.shift) / gain  # a line holds the whole shift
            lines = fit_straights(bounds, position, shift, fit.variance / gain**2, largest)
            after = before.copy()
            for k, (i, line) in enumerate(zip(np.flatnonzero(active).tolist(), lines, strict=True)):
                self.lines[i], own = line, slice(bounds[k], bounds[k + 1])
                if line is None:
                    active[i] = False
                    continue
                along = line.ends[0] + (line.ends[1] - line.ends[0]) * position[own]
                after[own] = along * gain[own]
                active[i] = np.abs(after[own] - before[own]).max() > SETTLED
            self.moved[chosen] = after
            if not np.any(active):
                break


# Standard deviations of amplitudes, in contrasts of the outline, as shading.py orders them: of
# what an outline has in common, of its changes along the outline, and of single blocks.
COMMON = np.array([1e3, 0.3, 1e3, 1.5, 1.5, 1.0, 1.0])
ALONG = np.array([1.0, 0.3, 1.0, 1.0, 1.0, 1.0, 1.0])
OF_BLOCKS = np.array([2.0, 1.0, 0.3, 0.1, 0.1, 0.05, 0.05])
N_ALONG = 3  # polynomials along an outline: constant, linear, quadratic
OPEN_BLUR = 0.7  # of the logarithm of the blur, before outlines tell it
UNEQUAL_BLUR = 0.05  # that outlines of one image seem to have, in its logarithm
ROUGH = 0.02  # displacement of single blocks [px]
NEAR = (0.02, 0.35)  # standard deviation of the lines that it starts from: [px] and in blurs
BLURS = (0.2, 4.0)  # [px]
LEAST_SAMPLES = 30  # of a block
ENOUGH, LONGEST = 16, 3  # blocks of an outline from which on some are joined, so many at most
LARGEST_STEP = (0.7, 0.4)  # of one round: of the line [blurs], of the logarithm of the blur
NEARBY = (0.08, 0.05)  # the same up to which products of powers tell of a place and a blur
SETTLED_pool = 0.01  # step of a line below which its rounds end [px]
ODD = (1.5, 4.0)  # noise in that of a typical block from where on one counts less, and not at all
LEAST_NOISE = 0.05  # [grey levels^2]
DARKEST = 1e-3  # of the mean light of a block
ANYTHING = 1e3  # standard deviation of what is not known

ONE, OTHER = (0, 1, 2, 1, 2, 2), (0, 0, 0, 1, 1, 2)  # pairs of polynomials
SHIFT, BLUR, N_UNKNOWNS = N_AMPLITUDES, N_AMPLITUDES + 1, N_AMPLITUDES + 2  # unknowns of a block


@dataclass(frozen=True, eq=False)
class Round:
    """Where the unknowns of all edges are."""

    amplitude: Array  # (n_edges, N_ALONG, N_AMPLITUDES)
    line: Array  # (n_edges, 2) in the middle, and half of the difference of the ends [px]
    log_blur: Array  # (n_edges,)
    noise: Array  # (n_edges,) [grey levels^2]
    inverse: Array  # (n_edges, N_ALONG * N_UNKNOWNS, N_ALONG * N_UNKNOWNS)

    def some(self, edges: BoolArray) -> "Round":
        """Return the unknowns of some edges."""
        return Round(
            self.amplitude[edges],
            self.line[edges],
            self.log_blur[edges],
            self.noise[edges],
            self.inverse[edges],
        )

    def replaced(self, edges: BoolArray, others: "Round") -> "Round":
        """Return these unknowns with others of some edges."""
        together = Round(
            self.amplitude.copy(),
            self.line.copy(),
            self.log_blur.copy(),
            self.noise.copy(),
            self.inverse.copy(),
        )
        together.amplitude[edges], together.line[edges] = others.amplitude, others.line
        together.log_blur[edges], together.noise[edges] = others.log_blur, others.noise
        together.inverse[edges] = others.inverse
        return together


@dataclass(frozen=True, eq=False)
class Pixels:
    """The pixels of short blocks, of which a few make a block of the pool."""

    d: Array  # (n, m) from the lines on which the blocks had settled [px]
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
        U = powers_with_room(z)  # in double precision: sums nearly cancel
        U *= self.weight[some][..., None]
        U[..., -1] = self.light[some]
        first = np.flatnonzero(np.diff(self.joined[some], prepend=-1))
        return np.asarray(np.add.reduceat(U.swapaxes(1, 2) @ U, first, axis=0))

    def changed_by_gamma(self) -> "Pixels":
        """Return how the light of these pixels changes with ln gamma, in place of it."""
        light, weight = self.light + self.level[self.edge][:, None] * self.weight, self.weight
        of_block = np.maximum(light.sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-9), 1e-9)
        part = light / np.maximum(weight * of_block[:, None], 1e-9)
        change = light * np.log(np.maximum(part, DARKEST))
        totals = (np.bincount(self.edge, x.sum(axis=1), len(self.level)) for x in (change, weight))
        total, weights = totals
        mean = total / np.maximum(weights, 1e-9)
        return replace(self, light=change - mean[self.edge][:, None] * weight)


@dataclass(eq=False)
class Pool:
    """The blocks of all edges, and which belong together."""

    pixels: Pixels
    power: Array  # (n,) sum of squares of the light of each block
    n_samples: Array  # (n,)
    gain: Array  # (n,)
    edge: IntArray  # (n,)
    bounds: IntArray  # (n_edges + 1,)
    along: Array  # (n, N_ALONG) polynomials at the blocks
    half_width: Array  # (n_edges,) [px]
    contrast: Array  # (n_edges,)
    depth: float
    seen: BoolArray  # (n_edges,) edges with usable blocks
    # Products of powers and light of each block, and where the lines were and how wide the blur.
    products: Array  # (n, N_POWERS + 1, N_POWERS + 1)
    at_line: Array  # (n_edges, 2) NaN before products are known
    at_log_blur: Array  # (n_edges,)

    @classmethod
    def of(cls, blocks: Blocks, kept: BoolArray, depth: float) -> "Pool":
        """Return what is needed of some blocks."""
        n_edges = len(blocks.bounds) - 1
        of_edge = np.repeat(np.arange(n_edges), np.diff(blocks.bounds))
        usable = kept & (np.count_nonzero(blocks.weight, axis=1) >= LEAST_SAMPLES)
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
        pixels = Pixels(d, weight, light, blocks.gain[usable], along, edge, joined, level)
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

    def first_amplitudes(self, at: Round) -> Round:
        """Return the amplitudes that an outline has in common, with its line where it is."""
        self._know(at, np.ones(len(self.half_width), dtype=np.bool_))
        values, _, _ = profile_functions(self.half_width, np.exp(at.log_blur), self.depth)
        products = self._of_edges(self.products, np.ones((len(self.edge), 1)))[:, 0]
        of_edge = values @ products[:, :-1, :-1] @ values.swapaxes(1, 2)
        prior = at.noise[:, None] / (COMMON * self.contrast[:, None]) ** 2 + 1e-9
        of_edge += prior[:, :, None] * np.eye(N_AMPLITUDES)
        target = values @ products[:, :-1, -1:]
        at.amplitude[:, 0] = np.linalg.solve(of_edge, target)[..., 0]
        return at

    def rounds(self, at: Round, log_blur: float, sigma: float, n: int) -> Round:
        """Take Gauss-Newton steps, ``n`` at most, the blur known to ``sigma`` beforehand."""
        moving = np.ones(len(self.half_width), dtype=np.bool_)
        for _ in range(n):
            before = at
            at = self._round(at, moving, log_blur, sigma)
            step = np.maximum(
                np.abs(at.line - before.line).max(axis=1), np.abs(at.log_blur - before.log_blur)
            )
            moving = step >= SETTLED_pool
            if not np.any(moving):
                break
        return at

    def _know(self, at: Round, edges: BoolArray) -> None:
        """Sum the products of some edges again, those that have moved from where they are."""
        blur = np.exp(self.at_log_blur)
        moved = np.abs(at.line - self.at_line).sum(axis=1) / blur
        widened = np.abs(at.log_blur - self.at_log_blur)
        lost = edges & ~((moved < NEARBY[0]) & (widened < NEARBY[1]))
        if np.any(lost):
            own = lost[self.edge]
            if np.any(own):
                self.products[own] = self.pixels.products(at.line, at.log_blur, lost)
            self.at_line[lost], self.at_log_blur[lost] = at.line[lost], at.log_blur[lost]

    def _round(self, at: Round, moving: BoolArray, log_blur: float, sigma: float) -> Round:
        """Take one step of some edges."""
        self._know(at, moving)
        if np.all(moving):
            return self._step(at, log_blur, sigma)
        return at.replaced(moving, self._part(moving)._step(at.some(moving), log_blur, sigma))

    def _part(self, edges: BoolArray) -> "Pool":
        """Return the blocks of some edges."""
        own = edges[self.edge]
        edge = (np.cumsum(edges) - 1)[self.edge[own]]
        return Pool(
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

    def _step(self, at: Round, log_blur: float, sigma: float) -> Round:
        """Take one step of all edges."""
        normal, right, expected = self._blocks(at)
        normal /= at.noise[self.edge][:, None, None]
        right /= at.noise[self.edge][:, None]
        # A block's own amplitudes and place are eliminated, its blur is that of the edge:
        # what is left is known of what the edge has in common.
        own = self._own_precision()
        free = np.asarray(np.linalg.inv(normal[:, :BLUR, :BLUR] + _diagonal(own)), np.float64)
        fitted = (free @ (right[:, :BLUR] + own * expected)[..., None])[..., 0]
        noise, weight = self._noise(at, normal[:, :BLUR, :BLUR], right[:, :BLUR], fitted)
        known = _eliminated(normal, right, free, own)
        system, target = self._in_common(known, weight)
        precision, pull = self._known_before(at, log_blur, sigma)
        n = len(self.half_width)
        shape = n, N_ALONG * N_UNKNOWNS
        whole = system + _diagonal(precision.reshape(shape))
        inverse = np.linalg.inv(whole)
        step = (inverse @ (target + pull).reshape(*shape, 1)).reshape(n, N_ALONG, N_UNKNOWNS)
        largest = LARGEST_STEP[0] * np.exp(at.log_blur)[:, None]
        move = np.clip(step[:, :2, SHIFT], -largest, largest)
        widen = np.clip(step[:, 0, BLUR], -LARGEST_STEP[1], LARGEST_STEP[1])
        least, most = np.log(BLURS).tolist()
        widened = np.clip(at.log_blur + widen, least, most)
        return Round(
            step[..., :N_AMPLITUDES],
            at.line + move,
            np.asarray(widened),
            noise,
            np.asarray(inverse),
        )

    def response_to_gamma(self, at: Round) -> tuple[Array, Array]:
        """Return the equations of what a change of ln gamma does to all edges, where they are.

        Normal matrices (n_edges, k, k), with what is known beforehand of all unknowns but the blur,
        and right sides (n_edges, k), for the unknowns of N_ALONG polynomials one after the other.
        """
        every = np.ones(len(self.half_width), dtype=np.bool_)
        self._know(at, every)
        normal, right, expected = self._blocks(at)
        products = self.pixels.changed_by_gamma().products(self.at_line, self.at_log_blur, every)
        _, change, _ = replace(self, products=products)._blocks(at)
        noise = at.noise[self.edge]
        normal, own = normal / noise[:, None, None], self._own_precision()
        right, change = right / noise[:, None], change / noise[:, None]
        free = np.asarray(np.linalg.inv(normal[:, :BLUR, :BLUR] + _diagonal(own)), np.float64)
        fitted = (free @ (right[:, :BLUR] + own * expected)[..., None])[..., 0]
        _, weight = self._noise(at, normal[:, :BLUR, :BLUR], right[:, :BLUR], fitted)
        system, target = self._in_common(_eliminated(normal, change, free, own), weight)
        precision, _ = self._known_before(at, 0.0, ANYTHING)
        shape = len(every), N_ALONG * N_UNKNOWNS
        return system + _diagonal(precision.reshape(shape)), target.reshape(shape)

    def _in_common(self, known: Array, weight: Array) -> tuple[Array, Array]:
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

    def _blocks(self, at: Round) -> tuple[Array, Array, Array]:
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

    def _noise(self, at: Round, normal: Array, right: Array, fitted: Array) -> tuple[Array, Array]:
        """Return the noise of each edge, and how much each block counts by its own."""
        explained = 2.0 * right - (normal @ fitted[..., None])[..., 0]
        explained = np.sum(fitted * explained, axis=1) * at.noise[self.edge]
        of_block = np.maximum(self.power - explained, 0.0) / np.maximum(self.n_samples - 5.0, 1.0)
        of_edge = np.ones(len(self.half_width))
        middle = (self.bounds[:-1] + self.bounds[1:]) // 2
        of_edge[self.seen] = of_block[np.lexsort((of_block, self.edge))][middle[self.seen]]
        of_edge = np.asarray(np.maximum(of_edge, LEAST_NOISE))
        excess = of_block / of_edge[self.edge]
        return of_edge, np.clip((ODD[1] - excess) / (ODD[1] - ODD[0]), 0.0, 1.0)

    def _own_precision(self) -> Array:
        """Return how little amplitudes and places of single blocks scatter, (n, BLUR)."""
        precision = np.empty((len(self.edge), BLUR))
        precision[:, :N_AMPLITUDES] = (OF_BLOCKS * self.contrast[self.edge][:, None]) ** -2
        precision[:, SHIFT] = ROUGH**-2
        return precision

    def _known_before(self, at: Round, log_blur: float, sigma: float) -> tuple[Array, Array]:
        """Return what is known of the unknowns of edges beforehand: precision, and its pull."""
        precision = np.full((len(self.half_width), N_ALONG, N_UNKNOWNS), 1e10)
        pull = np.zeros_like(precision)
        contrast = self.contrast[:, None]
        precision[:, 0, :N_AMPLITUDES] = (COMMON * contrast) ** -2
        precision[:, 1:, :N_AMPLITUDES] = ((ALONG * contrast) ** -2)[:, None, :]
        near = (NEAR[0] + NEAR[1] * np.exp(log_blur)) ** -2
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
        index = np.arange(n) // int(np.clip(n // ENOUGH, 1, LONGEST))
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


def shifts_by_gamma(pool: Pool, at: Round, even_blur: float) -> Array:
    """Return how far the outlines of an image move towards the inside with ln gamma.

    Parameters
    ----------
    pool : Pool
        The blocks of all edges.
    at : Round
        Where they were fitted.
    even_blur : float
        By how much the blur of an edge differs from that of the image, in its logarithm.

    Returns
    -------
    (n_edges,) array
        In the middle of each [px]; NaN where nothing is seen.
    """
    normal, right = pool.response_to_gamma(at)
    moved, inverse = _solved(normal, right, 0.0, OPEN_BLUR)
    counts = pool.seen / (inverse[:, BLUR, BLUR] + UNEQUAL_BLUR**2)
    widened = float(counts @ moved[:, BLUR] / counts.sum())
    moved, _ = _solved(normal, right, widened, even_blur)
    return np.where(pool.seen, moved[:, SHIFT], np.nan)


def _solved(normal: Array, right: Array, widened: float, sigma: float) -> tuple[Array, Array]:
    """Return the unknowns of edges (n, k) and their covariance, the blur known to sigma."""
    whole, target = normal.copy(), right.copy()
    whole[:, BLUR, BLUR] += sigma**-2
    target[:, BLUR] += widened * sigma**-2
    inverse = np.asarray(np.linalg.inv(whole), dtype=np.float64)
    return (inverse @ target[..., None])[..., 0], inverse


EVEN_BLUR = 0.03  # of the logarithm of the blur, from edge to edge
FIRST_ROUNDS, LAST_ROUNDS = 2, 8  # at most


@dataclass(frozen=True, eq=False)
class Together:
    """Lines of outlines.

    Attributes
    ----------
    ends : (n_edges, 2) array
        How far each line lies inside the one on which the blocks had settled, where the band
        begins and where it ends [px of the band].
    covariance : (n_edges, 2, 2) array
        Of these [px^2], by noise and by what shading may be.
    blur : float
        Standard deviation of the blur of the image [px].
    by_gamma : (n_edges,) array
        How far each line moves towards the inside with ln gamma [px]; NaN where nothing is seen.
    """

    ends: Array
    covariance: Array
    blur: float
    by_gamma: Array


def fit_together(blocks: Blocks, kept: BoolArray, blur: float, depth: float) -> Together:
    """Fit the blocks of each outline together.

    Parameters
    ----------
    blocks : Blocks
        Settled blocks.
    kept : (n_blocks,) array of bool
        Those that lie on the lines of their edges.
    blur : float
        Rough standard deviation of the blur [px].
    depth : float
        Distance from the outlines at which the blocks end [px].
    """
    pool = Pool.of(blocks, kept, depth)
    n = len(pool.half_width)
    if n == 0 or not np.any(pool.seen):
        nothing = np.full(n, np.nan)
        return Together(np.zeros((n, 2)), np.tile(np.eye(2), (n, 1, 1)), blur, nothing)
    start = Round(
        np.zeros((n, N_ALONG, N_AMPLITUDES)),
        np.zeros((n, 2)),
        np.full(n, np.log(blur)),
        np.full(n, 4.0),
        np.zeros((n, N_ALONG * N_UNKNOWNS, N_ALONG * N_UNKNOWNS)),
    )
    found = pool.rounds(pool.first_amplitudes(start), np.log(blur), OPEN_BLUR, FIRST_ROUNDS)
    even, sigma = _even_blur(found, pool.seen)
    found = replace(found, log_blur=np.full(n, even))
    sigma = float(np.hypot(sigma, EVEN_BLUR))
    found = pool.rounds(found, even, sigma, LAST_ROUNDS)
    at_ends = np.array([[1.0, -1.0], [1.0, 1.0]])
    line = [SHIFT, N_UNKNOWNS + SHIFT]
    covariance = at_ends @ found.inverse[:, line][:, :, line] @ at_ends.T
    by_gamma = shifts_by_gamma(pool, found, sigma)
    return Together(found.line @ at_ends.T, covariance, float(np.exp(even)), by_gamma)


def _even_blur(found: Round, seen: BoolArray) -> tuple[float, float]:
    """Return the logarithm of the blur that most outlines of an image agree on, and its sigma."""
    log_blur = found.log_blur[seen]
    weight = 1.0 / (found.inverse[seen, BLUR, BLUR] + UNEQUAL_BLUR**2)
    even, robust = 0.0, weight
    for _ in range(6):
        even = float(robust @ log_blur / robust.sum())
        robust = weight / (1.0 + 0.25 * weight * (log_blur - even) ** 2)
    return even, float(robust.sum() ** -0.5)


FIRST_BLUR = 1.0  # [px]
LEAST_GAIN = 30  # in chi^2, by which a block shows an edge at all
FIRST_BLOCKS = 12  # of an outline
FIRST_ROUNDS_measure, LAST_ROUNDS_measure = 2, 2  # the last ones at most
TRIALS, SIMILAR = 3, 0.25  # of the blur, until its logarithm changes by less than this
SHADING = 0.5  # that the model leaves out [grey levels]
WIDENING = 1.3  # of the standard deviations of a fit of all blocks, which share what is left out
COMMON_BIAS, TILT_BIAS = 0.012, 0.02  # of both ends, of each end [px]


@dataclass(frozen=True, eq=False)
class MeasuredEdge:
    """The line of an outline.

    Attributes
    ----------
    v : (2,) array
        Offsets at both ends of the band [px].
    line : StraightFit
        How the blocks lie about it.
    contrast : float
        Median step from the background to the leg, without sign [grey levels].
    is_step : bool
        Whether most blocks show a step or a limb, and not only a bend of the shading.
    blur : float
        Standard deviation of the blur of the image [px].
    clipped : float
        Up to which depth inside the outline the background saturates the picture, in blurs, by the
        median block; -inf where it does not.
    covariance : (2, 2) array
        Of the offsets at both ends of the used piece [px^2]: that of the line, and what shading
        that the model leaves out does to an outline of this contrast.
    by_gamma : float
        How far it moves towards the inside with the logarithm of the gamma that is taken for the
        camera's [px]; NaN where that is not known.
    """

    v: Array
    line: StraightFit
    contrast: float
    is_step: bool
    blur: float
    covariance: Array
    clipped: float = -math.inf
    by_gamma: float = math.nan


def measure_edges(
    grey: Grey,
    camera: Camera,
    edges: Sequence[Edge],
    together: bool = True,
    blur: float | None = None,
) -> tuple[list[MeasuredEdge | None], float]:
    """Fit the limb model and straight lines to all edges of an image.

    Parameters
    ----------
    grey : Grey
        The image.
    camera : Camera
        Its camera.
    edges : sequence of Edge
        All outlines to measure.
    together : bool
        Fit all blocks of an outline together in the end; without it lines are good to a few
        hundredths of a pixel, in half the time.
    blur : float, optional
        Standard deviation of the blur as other images of the view show it [px]; the edges are then
        taken to be known to a few tenths of a pixel.

    Returns
    -------
    measured : list of MeasuredEdge or None
        None for an edge that no straight line fits.
    blur : float
        Standard deviation of the blur of the image [px].
    """
    v = [edge.v for edge in edges]
    near = blur is not None
    if blur is None:
        blocks = Blocks.read(grey, camera, edges, v, FIRST_BLUR, FIRST_BLOCKS)
        if len(blocks.moved) == 0:
            return [None] * len(edges), FIRST_BLUR
        blur = FIRST_BLUR
        for _ in range(FIRST_ROUNDS_measure):
            blocks.settle(blur, 1)
            blur = estimate_blur(*blocks.samples(slice(None)), blocks.merit())
        v = [_moved(edge, at, line) for edge, at, line in zip(edges, v, blocks.lines, strict=True)]
    for _ in range(TRIALS):
        tried = blur
        blocks = Blocks.read(grey, camera, edges, v, tried)
        if len(blocks.moved) == 0:
            return [None] * len(edges), tried
        blocks.settle(tried, LAST_ROUNDS_measure)
        if not together:
            return _roughly(edges, v, blocks, tried), tried
        if near:
            blocks.unmove()
        kept = blocks.kept()
        blocks.even_noise(kept, tried)
        joint = fit_together(blocks, kept, tried, depth_for_blur(tried))
        blur = joint.blur
        if abs(np.log(blur / tried)) < SIMILAR:
            break
    return [
        None
        if line is None
        else replace(
            _measured(_moved(edge, at, line), edge.epsilon, line, step, sharp, blur, ends, spread),
            clipped=(float(np.median(clipped[line.kept])) - float(ends.mean())) / blur,
            by_gamma=shift,
        )
        for edge, at, line, step, sharp, clipped, ends, spread, shift in zip(
            edges,
            v,
            blocks.lines,
            blocks.contrasts(),
            blocks.sharpness(),
            blocks.clipping(),
            joint.ends,
            joint.covariance,
            joint.by_gamma.tolist(),
            strict=True,
        )
    ], blur


def _roughly(
    edges: Sequence[Edge], v: Sequence[Array], blocks: Blocks, blur: float
) -> list[MeasuredEdge | None]:
    """Return the lines that the blocks give one by one, with the covariance that they claim."""
    found: list[MeasuredEdge | None] = []
    for edge, at, line, contrasts, sharp in zip(
        edges, v, blocks.lines, blocks.contrasts(), blocks.sharpness(), strict=True
    ):
        if line is None:
            found.append(None)
            continue
        contrast = float(np.median(contrasts[line.kept]))
        is_step = float(np.median(sharp[line.kept])) > LEAST_GAIN
        covariance = line.covariance + _shading_bias(contrast, blur) ** 2
        moved = _moved(edge, at, line)
        found.append(MeasuredEdge(moved, line, contrast, is_step, blur, covariance))
    return found


def _shading_bias(contrast: float, blur: float) -> float:
    """Return how far shading moves an outline: its grey levels over the slope of the step [px]."""
    return float(SHADING * np.sqrt(2.0 * np.pi) * blur / max(contrast, 1e-3))


def _measured(
    v: Array,
    epsilon: float,
    line: StraightFit,
    contrasts: Array,
    sharp: Array,
    blur: float,
    ends: Array,
    spread: Array,
) -> MeasuredEdge:
    """Return an edge that is measured by all its blocks together."""
    contrast = float(np.median(contrasts[line.kept]))
    is_step = float(np.median(sharp[line.kept])) > LEAST_GAIN
    bias = _shading_bias(contrast, blur)
    to_piece = np.array([[1.0 - place, place] for place in (line.first, line.last)])
    covariance = WIDENING**2 * to_piece @ spread @ to_piece.T
    covariance = 0.5 * (covariance + covariance.T)
    covariance += COMMON_BIAS**2 + TILT_BIAS**2 * np.eye(2) + bias**2
    return MeasuredEdge(v + epsilon * ends, line, contrast, is_step, blur, covariance)


def _moved(edge: Edge, v: Array, line: StraightFit | None) -> Array:
    """Return the offsets of an edge moved by a line of shifts towards the inside."""
    return v if line is None else np.asarray(v + edge.epsilon * line.ends)
