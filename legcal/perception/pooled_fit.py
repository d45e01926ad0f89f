"""Lines of outlines fitted to the pooled blocks of an image, with the blur and covariance.

The blocks of an outline share amplitudes that change slowly along it, a line, and a blur that is
nearly that of the whole image; each block adds a little of its own, which is eliminated. A round of
Gauss-Newton needs no pixel (:mod:`legcal.perception.profiles`) as long as lines turn little.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.perception.blocks import Blocks
from legcal.perception.limb import (
    N_AMPLITUDES,
    N_POWERS,
    SURFACE,
    SURFACE_SIGMA,
    polish_evidence,
    powers,
    profile_functions,
)
from legcal.perception.profiles import (
    PixelBins,
    PixelSums,
    Samples,
    applied,
    even_weights,
    medians,
    noise_ratios,
)

# Standard deviations of amplitudes, in contrasts of the outline, as limb.py orders them: of
# what an outline has in common, of its changes along the outline, and of single blocks.
# By finish (2, N_AMPLITUDES).
COMMON = np.array([[1e3, 0.3, *sigma] for sigma in SURFACE_SIGMA])
ALONG = np.array([[1.0, 0.3, *(0.3 * sigma)] for sigma in SURFACE_SIGMA])
OF_BLOCKS = np.array([[2.0, 1.0, *(0.2 * sigma)] for sigma in SURFACE_SIGMA])
N_ALONG = 3  # polynomials along an outline: constant, linear, quadratic
PRIOR_BLUR = 0.7  # prior standard deviation of the logarithm of the blur
BLUR_SCATTER = 0.05  # scatter of the logarithm of the blur among the outlines of an image
ROUGHNESS = 0.02  # displacement of single blocks [px]
# Standard deviation of the lines that it starts from: [px] and in blurs.
START_SIGMA = (0.1, 1.75)
BLURS = (0.2, 4.0)  # least and greatest [px]
MIN_SAMPLES = 30  # pixels of a block
ENOUGH_BLOCKS, MAX_JOINED = 16, 3  # of an outline, to join some blocks, so many at most
MAX_STEP = (0.7, 0.4)  # largest step of a round: line [blurs], logarithm of the blur
MAX_MOVE_OF_SUMS = (1.0, 0.08)  # of middle and ends [blurs], to which sums over pixels serve
MAX_MOVE = (0.1, 0.04)  # of a line [blurs] and of the logarithm of the blur, to which equations do
CONVERGED = (0.005, 0.015)  # steps of lines [px] and log blurs, below which the last round follows
ODD_NOISE = (1.5, 4.0)  # of a typical block, from where on one counts less, and not at all
MIN_NOISE = 0.05  # variance of grey levels [grey levels^2]
NOISE_ROUNDS, NOISE_CONVERGED = 3, 0.2  # most rounds of the noise; change of its logarithm
MIN_LIGHT = 1e-3  # least light of a pixel, as a part of the mean light of its block

COMMON_BLUR_SIGMA = 0.03  # of the logarithm of the blur of an outline, about that of the image
# An outline whose light is unusual, or whose blur is not that of the others once both pull at each
# other, is known less well, and a plain one better: as from a Student t prior of so many degrees of
# freedom.
DEGREES, EXPECTED_ODDITY = 5.0, 4.0  # and the sum of squared pulls of outlines where all is well
BLUR_PULL = 0.01  # usual deviation of the logarithm of the blur of an outline
ROUNDS, ALL_ROUNDS = 10, 2  # at most; and before those that have converged are left out

ONE, OTHER = (0, 1, 2, 1, 2, 2), (0, 0, 0, 1, 1, 2)  # pairs of polynomials
SHIFT, BLUR, N_UNKNOWNS = N_AMPLITUDES, N_AMPLITUDES + 1, N_AMPLITUDES + 2  # unknowns of a block


class PooledLines(NamedTuple):
    """Lines of outlines, by how far they lie inside those on which the blocks had converged."""

    ends: Array  # (n_edges, 2) where the band begins and where it ends [px of the band]
    covariance: Array  # (n_edges, 2, 2) of these [px^2], by noise and by what shading may be
    blur: float  # standard deviation of the blur of the image [px]
    by_gamma: Array  # (n_edges,) how far each moves inside with ln gamma [px]; NaN: nothing seen
    polish: Array  # (n_edges,) log likelihood ratio of polished over matte; NaN: nothing seen


class _Iterate(NamedTuple):
    """Where the unknowns of all edges are."""

    amplitude: Array  # (n_edges, N_ALONG, N_AMPLITUDES)
    line: Array  # (n_edges, 2) in the middle, and half of the difference of the ends [px]
    log_blur: Array  # (n_edges,)


class _Equations(NamedTuple):
    """What blocks say of the unknowns of all edges near an iterate."""

    design: Array  # (n, N_UNKNOWNS, N_POWERS) functions of the unknowns of blocks
    elimination: Array  # (n, N_UNKNOWNS, N_UNKNOWNS) of what is a block's own, and its weight
    inverse: Array  # (n_edges, k, k) covariance of N_ALONG * N_UNKNOWNS unknowns of each edge


def fit_pooled(blocks: Blocks, share: Array, blur: float, depth: float) -> PooledLines:
    """Fit the blocks that lie on the lines of their edges, of each outline together.

    Each counts by its share (n,), from a rough blur [px]; ``depth`` is the distance from the
    outlines at which blocks end [px].
    """
    pool = _Pool.of(blocks, share, blur, depth)
    n = len(pool.half_width)
    if n == 0 or not np.any(pool.seen):
        nothing = np.full(n, np.nan)
        return PooledLines(np.zeros((n, 2)), np.tile(np.eye(2), (n, 1, 1)), blur, nothing, nothing)
    at = pool.first_amplitudes(
        _Iterate(np.zeros((n, N_ALONG, N_AMPLITUDES)), np.zeros((n, 2)), np.full(n, np.log(blur)))
    )
    equations, moving = pool.equations(at), np.ones(n, dtype=np.bool_)
    part, of_part, shared = pool, at, None
    at = _Iterate(*(values.copy() for values in at))
    for turn in range(ROUNDS):
        before, (of_part, _, shared) = of_part, part.step(of_part, equations, shared)
        for values, new in zip(at, of_part, strict=True):
            values[moving] = new
        moved, widened = (np.abs(x - y) for x, y in zip(of_part[1:], before[1:], strict=True))
        still = (moved.max(axis=1) >= CONVERGED[0]) | (widened >= CONVERGED[1])
        still &= part.seen  # what follows the blur of the image alone has nothing to converge
        if not np.any(still):
            break
        if turn >= ALL_ROUNDS and not np.all(still):
            # The blur is known by now; few outlines take longer than the others.
            part, moving[moving] = part.part(still), still
            of_part = _Iterate(*(values[still] for values in of_part))
            part.look(of_part)
            equations = part.equations(of_part)
        elif part.look(of_part, MAX_MOVE):
            equations = part.equations(of_part)
        if turn < ALL_ROUNDS:
            shared = None
    pool.look(at)
    equations = pool.equations(at)
    at, covariance, (even, _) = pool.step(at, equations)
    by_gamma = pool.response(_changed_by_gamma(blocks), equations, covariance)
    at_ends = np.array([[1.0, -1.0], [1.0, 1.0]])
    line = [SHIFT, N_UNKNOWNS + SHIFT]
    of_lines = at_ends @ covariance[:, line][:, :, line] @ at_ends.T
    of_lines *= pool.oddity(at, even)[:, None, None]
    polish = pool.polish(at, covariance)
    return PooledLines(at.line @ at_ends.T, of_lines, float(np.exp(even)), by_gamma, polish)


def _common_blur(log_blur: Array, variance: Array, seen: BoolArray) -> tuple[float, float]:
    """Return the logarithm of the blur that most outlines of an image agree on.

    And by how much that of one outline may differ from it, a standard deviation.
    """
    log_blur = log_blur[seen]
    weight = 1.0 / (variance[seen] + BLUR_SCATTER**2)
    even, robust = 0.0, weight
    for _ in range(6):
        even = float(robust @ log_blur / robust.sum())
        robust = weight / (1.0 + 0.25 * weight * (log_blur - even) ** 2)
    return even, float(np.hypot(robust.sum() ** -0.5, COMMON_BLUR_SIGMA))


@dataclass(eq=False)
class _Pool:
    """The blocks of all edges, and which belong together."""

    blocks: Blocks
    usable: BoolArray  # which of the blocks
    share: Array  # how much each of them counts
    joined: IntArray  # (n_usable,) which of the blocks here each is a part of
    row_edge: IntArray  # (n_usable,) and of which edge
    gain: Array  # (n,)
    edge: IntArray  # (n,)
    bounds: list[int]  # n_edges + 1
    along: Array  # (n, N_ALONG) polynomials at the blocks
    half_width: Array  # (n_edges,) [px]
    finish: IntArray  # (n_edges,) of surfaces, as limb.py numbers them
    contrast: Array  # (n_edges,)
    noise: Array  # (n_edges,) of the blocks by themselves [grey levels^2]
    noise_ratio: Array  # (n_edges,) inside and outside
    blur: float  # that bins suit [px]
    depth: float  # distance from the outlines at which blocks end [px]
    seen: BoolArray  # (n_edges,) edges with usable blocks
    block_precision: Array  # (n, BLUR) of the amplitudes and the place of single blocks
    # Sums over pixels by their distances from lines, and of products of powers with a blur.
    bins: PixelBins | None  # None where sums are those over the blocks as they are
    sums: PixelSums
    at_line: Array  # (n_edges, 2) of the sums
    products: Array  # (n, N_POWERS, N_POWERS)
    with_light: Array  # (n, N_POWERS)
    at: _Iterate  # of the products
    functions: tuple[Array, Array, Array]  # profile_functions there

    @classmethod
    def of(cls, blocks: Blocks, share: Array, blur: float, depth: float) -> "_Pool":
        """Return what is needed of the blocks that count."""
        n_edges, kept = len(blocks.half_width), share > 0.0
        usable = kept & (np.count_nonzero(blocks.weight, axis=1) >= MIN_SAMPLES)
        edge = blocks.edge[usable]
        of_usable = np.searchsorted(edge, np.arange(n_edges + 1)).tolist()
        noise = np.fmax(medians(blocks.noise[usable], edge, of_usable), MIN_NOISE)
        joined = _joined(blocks.bounds, usable)
        first = np.flatnonzero(np.diff(joined, prepend=-1))
        rise = 2.0 * blocks.position[usable] - 1.0
        along = np.stack([np.ones_like(rise), rise, 1.5 * rise**2 - 0.5], axis=1)
        means = np.column_stack([blocks.gain[usable], along])
        if len(first):
            means = np.add.reduceat(means, first) / np.diff(first, append=len(edge))[:, None]
        row_edge, edge = edge, edge[first]
        bounds = np.searchsorted(edge, np.arange(n_edges + 1)).tolist()
        of_all = blocks.bins(blur).sums(blocks.light)
        ratio = noise_ratios(of_all, blocks.bounds, share, blur)
        sums = of_all.choose(usable).shared(share[usable]).summed(first)
        sums = sums.weighted(even_weights(sums.grid, ratio[edge], blur))

        def total(values: Array) -> Array:
            return np.asarray(np.bincount(edge, values, n_edges), dtype=np.float64)

        weights, count = total(sums.weight[:, 0].sum(axis=1)), total(sums.count.sum(axis=1))
        lights, power = total(sums.light[:, 0].sum(axis=1)), total(sums.power.sum(axis=1))
        spread = np.maximum(power - lights**2 / np.maximum(weights, 1e-9), 0.0)
        contrast = 2.0 * np.sqrt(spread / np.maximum(count, 1.0)) + 1.0
        block_precision = np.empty((len(edge), BLUR))
        block_precision[:, :N_AMPLITUDES] = (
            OF_BLOCKS[blocks.finish[edge]] * contrast[edge][:, None]
        ) ** -2
        block_precision[:, SHIFT] = ROUGHNESS**-2
        nowhere = np.zeros((n_edges, 2)), np.full(n_edges, np.nan)
        return cls(
            blocks,
            usable,
            share,
            joined,
            row_edge,
            means[:, 0],
            edge,
            bounds,
            means[:, 1:],
            blocks.half_width,
            blocks.finish,
            contrast,
            noise,
            ratio,
            blur,
            depth,
            weights > 0.0,
            block_precision,
            None,
            sums,
            nowhere[0],
            np.empty((0, N_POWERS, N_POWERS)),
            np.empty((0, N_POWERS)),
            _Iterate(np.empty(0), *nowhere),
            (np.empty(0), np.empty(0), np.empty(0)),
        )

    def look(self, at: _Iterate, most: tuple[float, float] = (0.0, 0.0)) -> bool:
        """Sum again what has moved by more than some blurs, or widened; say whether any has."""
        move = (at.line - self.at.line) / np.exp(at.log_blur)[:, None]
        moved = np.abs(move).sum(axis=1)
        widened = np.abs(at.log_blur - self.at.log_blur)
        if np.all(moved <= most[0]) and np.all(widened <= most[1]):
            return False
        turned = np.abs(at.line - self.at_line) / np.exp(at.log_blur)[:, None]
        if np.any(turned > MAX_MOVE_OF_SUMS):
            self.at_line = at.line.copy()
            self.bins = self._bins()
            sums = self.bins.sums(self.blocks.light[self.usable])
            self.sums = sums.weighted(
                even_weights(sums.grid, self.noise_ratio[self.edge], self.blur)
            )
        self.at = at
        self.functions = profile_functions(
            self.half_width, np.exp(at.log_blur), self.depth, self.finish
        )
        values, slopes = self._powers()
        self.products = self.sums.products(values, slopes, self.bounds)
        self.with_light = self.sums.with_light(values, slopes, self.bounds)
        return True

    def part(self, edges: BoolArray) -> "_Pool":
        """Return the blocks of some edges."""
        is_kept, rows = edges[self.edge], edges[self.row_edge]
        usable, number = self.usable.copy(), np.cumsum(edges) - 1
        usable[usable] = rows
        edge = number[self.edge[is_kept]]
        values, slopes, widenings = self.functions
        return replace(
            self,
            usable=usable,
            joined=(np.cumsum(is_kept) - 1)[self.joined[rows]],
            row_edge=number[self.row_edge[rows]],
            edge=edge,
            bounds=np.searchsorted(edge, np.arange(np.count_nonzero(edges) + 1)).tolist(),
            sums=self.sums.choose(is_kept),
            at=_Iterate(*(of_all[edges] for of_all in self.at)),
            functions=(values[edges], slopes[edges], widenings[edges]),
            **{
                name: getattr(self, name)[is_kept]
                for name in ("gain", "along", "block_precision", "products", "with_light")
            },
            **{
                name: getattr(self, name)[edges]
                for name in (
                    "half_width",
                    "finish",
                    "contrast",
                    "noise",
                    "noise_ratio",
                    "seen",
                    "at_line",
                )
            },
        )

    def _bins(self) -> PixelBins:
        """Return the bins of the pixels of the usable blocks where lines were looked at."""
        blocks, usable = self.blocks, self.usable
        line, rise = self.at_line[self.row_edge], 2.0 * blocks.position[usable] - 1.0
        moved = blocks.moved[usable] + blocks.gain[usable] * (line[:, 0] + line[:, 1] * rise)
        d = blocks.d[usable] - moved.astype(np.float32)[:, None]
        root = np.sqrt(self.share[usable]).astype(np.float32)[:, None]
        weight, window = blocks.weight[usable] * root, blocks.window[usable] * root
        return PixelBins.of(d, weight, self.blur, self.joined, window)

    def _powers(self) -> tuple[Array, Array]:
        """Return powers of the distance from where the middle of each line is, and slopes by it."""
        blur = np.exp(self.at.log_blur)[:, None]
        middle = self.at.line[:, :1] - self.at_line[:, :1]
        values, slopes = powers((self.sums.grid - middle) / blur)
        return values, slopes / blur[..., None]

    def _moved(self, line: Array) -> Array:
        """Return how far lines (n_edges, 2) are inside those that powers are of, (n,) [px]."""
        change = (line - self.at_line)[self.edge]
        moved = self.gain * (change[:, 0] + change[:, 1] * self.along[:, 1])
        return np.asarray(moved - (self.at.line - self.at_line)[self.edge, 0])

    def first_amplitudes(self, at: _Iterate) -> _Iterate:
        """Return the amplitudes that an outline has in common, with its line where it is."""
        self.look(at)
        values, ones = self.functions[0], np.ones((len(self.edge), 1))
        of_edge = values @ self._of_edges(self.products, ones)[:, 0] @ values.swapaxes(1, 2)
        of_edge += _diagonal(
            self.noise[:, None] / (COMMON[self.finish] * self.contrast[:, None]) ** 2 + 1e-9
        )
        target = values @ self._of_edges(self.with_light, ones)[:, 0, :, None]
        amplitude = np.zeros_like(at.amplitude)
        amplitude[:, 0] = np.linalg.solve(of_edge, target)[..., 0]
        return at._replace(amplitude=amplitude)

    def equations(self, at: _Iterate) -> _Equations:
        """Return the equations of all edges near an iterate that has just been looked at."""
        values, slopes, widenings = self.functions
        edge, along, n = self.edge, self.along, len(self.half_width)
        design = np.empty((len(edge), N_UNKNOWNS, N_POWERS))
        design[:, :N_AMPLITUDES] = values[edge] - self._moved(at.line)[:, None, None] * slopes[edge]
        for k, of in ((SHIFT, slopes), (BLUR, widenings)):
            design[:, k] = (along[:, None] @ (at.amplitude @ of)[edge])[:, 0]
        design[:, SHIFT] *= -self.gain[:, None]
        normal = design @ self.products @ design.swapaxes(1, 2)
        right = (design @ self.with_light[..., None])[..., 0]
        amplitude = (along[:, None] @ at.amplitude[edge])[:, 0]
        within = normal[:, :BLUR, :BLUR]
        # A block's own amplitudes and place are eliminated, its blur is that of the edge:
        # what is left is known of what the edge has in common.
        for _ in range(NOISE_ROUNDS):
            precision = self.noise[edge][:, None] * self.block_precision
            free = np.asarray(np.linalg.inv(within + _diagonal(precision)), dtype=np.float64)
            pull = right[:, :BLUR].copy()
            pull[:, :N_AMPLITUDES] += precision[:, :N_AMPLITUDES] * amplitude
            fitted = applied(free, pull)
            explained = fitted * (2.0 * right[:, :BLUR] - applied(within, fitted))
            before = self.noise
            self.noise, weight = self._noise(self.sums.power.sum(axis=1) - explained.sum(axis=1))
            if np.all(np.abs(np.log(self.noise / before)) < NOISE_CONVERGED):
                break
        weight /= self.noise[edge]
        # N - N (N + P)^-1 N = P (N + P)^-1 N, where P is the precision of blocks.
        elimination = np.zeros((len(edge), N_UNKNOWNS, N_UNKNOWNS))
        elimination[:, :BLUR, :BLUR] = precision[..., None] * free
        elimination[:, BLUR, :BLUR] = -(normal[:, None, BLUR, :BLUR] @ free)[:, 0]
        elimination[:, BLUR, BLUR] = 1.0
        elimination *= weight[:, None, None]
        sums = self._of_edges(elimination @ normal, along[:, ONE] * along[:, OTHER])
        system = np.empty((n, N_ALONG, N_UNKNOWNS, N_ALONG, N_UNKNOWNS))
        for k, (i, j) in enumerate(zip(ONE, OTHER, strict=True)):
            system[:, i, :, j] = system[:, j, :, i] = sums[:, k]
        side = N_ALONG * N_UNKNOWNS
        system = system.reshape(n, side, side) + _diagonal(self.precision.reshape(n, side))
        return _Equations(design, elimination, np.asarray(np.linalg.inv(system)))

    def step(
        self, at: _Iterate, equations: _Equations, shared: tuple[float, float] | None = None
    ) -> tuple[_Iterate, Array, tuple[float, float]]:
        """Take a Gauss-Newton step, by equations near an iterate.

        Return the covariance of the unknowns as well, with a blur that all outlines nearly share,
        and that: its logarithm, and by how much the one of an outline may differ; it may be known.
        """
        values, slopes, widenings = self.functions
        widened = (at.log_blur - self.at.log_blur)[:, None, None]
        edge, along = self.edge, self.along[:, None]
        model = (along @ (at.amplitude @ (values + widened * widenings))[edge])[:, 0]
        steep = (along @ (at.amplitude @ slopes)[edge])[:, 0]
        model -= self._moved(at.line)[:, None] * steep
        left = self.with_light - (self.products @ model[..., None])[..., 0]
        target, precision = self._eliminated(equations, left), self.precision
        target[..., :N_AMPLITUDES] -= precision[..., :N_AMPLITUDES] * at.amplitude
        target[:, :2, SHIFT] -= precision[:, :2, SHIFT] * at.line
        flat, apart = target.reshape(len(target), -1), equations.inverse

        def solved(covariance: Array, log_blur: float, precision: float) -> Array:
            pulled = flat.copy()
            pulled[:, BLUR] += precision * (log_blur - at.log_blur)
            return applied(covariance, pulled)

        if shared is None:
            alone = solved(apart, float(np.log(self.blur)), PRIOR_BLUR**-2)[:, BLUR]
            alone = at.log_blur + np.clip(alone, -MAX_STEP[1], MAX_STEP[1])
            shared = _common_blur(alone, apart[:, BLUR, BLUR], self.seen)
        even, known = shared[0], shared[1] ** -2
        more = known - PRIOR_BLUR**-2
        of_blur = apart[:, :, BLUR]
        gain = more / (1.0 + more * of_blur[:, BLUR])
        covariance = apart - gain[:, None, None] * of_blur[:, :, None] * of_blur[:, None, :]
        step = solved(covariance, even, known).reshape(target.shape)
        largest = MAX_STEP[0] * np.exp(at.log_blur)[:, None]
        move = np.clip(step[:, :2, SHIFT], -largest, largest)
        widen = np.clip(step[:, 0, BLUR], -MAX_STEP[1], MAX_STEP[1])
        least, most = np.log(BLURS).tolist()
        log_blurs = np.asarray(np.clip(at.log_blur + widen, least, most))
        after = _Iterate(at.amplitude + step[..., :N_AMPLITUDES], at.line + move, log_blurs)
        return after, covariance, shared

    def oddity(self, at: _Iterate, log_blur: float) -> Array:
        """Return the factors (n_edges,) of covariances; 1 of outlines that are as expected."""
        surface = at.amplitude[:, 0, SURFACE:]
        squares = np.sum(self.precision[:, 0, SURFACE:N_AMPLITUDES] * surface**2, axis=1)
        squares += ((at.log_blur - log_blur) / BLUR_PULL) ** 2
        return np.asarray((DEGREES + squares) / (DEGREES + EXPECTED_ODDITY))

    def polish(self, at: _Iterate, covariance: Array) -> Array:
        """Return the log likelihood ratios (n_edges,) of polished over matte; NaN: nothing seen.

        What the blocks say of the surface that they have in common, whatever it was taken for.
        """
        of_surface = slice(SURFACE, N_AMPLITUDES)
        contrast = self.contrast[:, None]
        after = np.linalg.inv(covariance[:, of_surface, of_surface]) * contrast[..., None] ** 2
        before = self.precision[:, 0, of_surface] * contrast**2
        surface = at.amplitude[:, 0, of_surface] / contrast
        right = (after @ surface[..., None])[..., 0]
        ratio = polish_evidence(self.finish, after - _diagonal(before), right)
        return np.where(self.seen, ratio, np.nan)

    @cached_property
    def precision(self) -> Array:
        """Return the prior precision of the unknowns of edges, (n_edges, N_ALONG, N_UNKNOWNS).

        Lines are known by where they start, and the blur roughly.
        """
        precision = np.full((len(self.half_width), N_ALONG, N_UNKNOWNS), 1e10)
        contrast = self.contrast[:, None]
        precision[:, 0, :N_AMPLITUDES] = (COMMON[self.finish] * contrast) ** -2
        precision[:, 1:, :N_AMPLITUDES] = ((ALONG[self.finish] * contrast) ** -2)[:, None, :]
        precision[:, :2, SHIFT] = (START_SIGMA[0] + START_SIGMA[1] * self.blur) ** -2
        precision[:, 0, BLUR] = PRIOR_BLUR**-2
        return precision

    def response(self, change: Samples, equations: _Equations, covariance: Array) -> Array:
        """Return how far middles of outlines move inside with a nuisance, (n_edges,) [px] or NaN.

        One that changes the light of pixels (n_blocks, m) of all blocks; with the covariance of
        unknowns once the blur is shared.
        """
        blocks = self.blocks
        if self.bins is None:
            first = np.flatnonzero(np.diff(self.joined, prepend=-1))
            light = blocks.bins(self.blur).light(change)[self.usable]
            light *= self.share[self.usable, None, None]
            changed = np.add.reduceat(light, first, axis=0) if len(first) else light
        else:
            changed = self.bins.light(change[self.usable])
        share = even_weights(self.sums.grid, self.noise_ratio[self.edge], self.blur)
        changes = replace(self.sums, light=changed * share[:, None])
        with_light = changes.with_light(*self._powers(), self.bounds)
        target = self._eliminated(equations, with_light).reshape(len(self.half_width), -1)
        # The blurs of an image change alike: by as much as edges say whose blur is not shared.
        apart = equations.inverse[:, BLUR]
        counts = self.seen / (apart[:, BLUR] + BLUR_SCATTER**2)
        widened = float(counts @ np.sum(apart * target, axis=1) / counts.sum())
        of_blur = covariance[:, :, BLUR]
        shared = 1.0 / of_blur[:, BLUR] - 1.0 / apart[:, BLUR] + PRIOR_BLUR**-2
        moved = applied(covariance, target) + widened * shared[:, None] * of_blur
        return np.where(self.seen, moved[:, SHIFT], np.nan)

    def _eliminated(self, equations: _Equations, left: Array) -> Array:
        """Return right sides (n_edges, N_ALONG, N_UNKNOWNS) by what is left of light (n, k)."""
        right = applied(equations.elimination, applied(equations.design, left))
        return self._of_edges(right, self.along)

    def _noise(self, power: Array) -> tuple[Array, Array]:
        """Return the noise of each edge, and how much blocks (n,) count by their residuals' sum."""
        of_block = np.maximum(power, 0.0) / np.maximum(self.sums.count.sum(axis=1) - 5.0, 1.0)
        of_edge = np.fmax(medians(of_block, self.edge, self.bounds), MIN_NOISE)
        excess = of_block / of_edge[self.edge]
        return of_edge, np.clip((ODD_NOISE[1] - excess) / (ODD_NOISE[1] - ODD_NOISE[0]), 0.0, 1.0)

    def _of_edges(self, values: Array, weight: Array) -> Array:
        """Return sums over the blocks of each edge, (n_edges, k, ...).

        Of values (n, ...) times weights (n, k).
        """
        n, k = len(self.half_width), weight.shape[1]
        flat = values.reshape(len(values), -1)
        sums = np.empty((n, k, flat.shape[1]))
        for edge, (first, last) in enumerate(pairwise(self.bounds)):
            np.matmul(weight[first:last].T, flat[first:last], out=sums[edge])
        return sums.reshape(n, k, *values.shape[1:])


def _changed_by_gamma(blocks: Blocks) -> Samples:
    """Return the derivative of the light of all pixels by ln gamma, (n, m)."""
    light = blocks.light + blocks.level.astype(np.float32)[blocks.edge][:, None]
    weights = np.maximum(blocks.weight.sum(axis=1), np.float32(1e-9))
    of_block = np.einsum("nm,nm->n", light, blocks.weight) / weights
    of_block = np.maximum(of_block, np.float32(1e-9))[:, None]
    return np.asarray(light * np.log(np.maximum(light / of_block, np.float32(MIN_LIGHT))))


def _joined(bounds: IntArray, usable: BoolArray) -> IntArray:
    """Return which of successive blocks become one, of those that are usable.

    Whether a block is usable does not decide which other ones are joined.
    """
    counts = np.diff(bounds)
    number = np.clip(counts // ENOUGH_BLOCKS, 1, MAX_JOINED)
    edge = np.repeat(np.arange(len(counts)), counts)
    n = -(-counts // number)
    group = (np.cumsum(n) - n)[edge] + (np.arange(len(edge)) - bounds[edge]) // number[edge]
    return np.asarray(np.unique(group[usable], return_inverse=True)[1])


def _diagonal(values: Array) -> Array:
    """Return diagonal matrices (..., n, n)."""
    matrices = np.zeros((*values.shape, values.shape[-1]))
    index = np.arange(values.shape[-1])
    matrices[..., index, index] = values
    return matrices
