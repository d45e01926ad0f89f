"""The blocks of all outlines of an image as one linear problem for each outline.

The amplitudes of every block are eliminated, so that what is solved for is what the outline has in
common: amplitudes as polynomials along it, its line, and the blur.
"""

from dataclasses import dataclass

import numpy as np

from legcal.detection.blocks import Blocks
from legcal.detection.powers import N_POWERS, powers
from legcal.detection.shading import N_AMPLITUDES, profile_functions
from legcal.geometry.types import Array, BoolArray, IntArray

# Standard deviations of amplitudes, in contrasts of the outline, as shading.py orders them: of
# what an outline has in common, of its changes along the outline, and of single blocks.
COMMON = np.array([1e3, 0.3, 1e3, 1.5, 1.5, 1.0, 1.0])
ALONG = np.array([1.0, 0.3, 1.0, 1.0, 1.0, 1.0, 1.0])
OF_BLOCKS = np.array([2.0, 1.0, 0.3, 0.1, 0.1, 0.05, 0.05])
N_ALONG = 3  # polynomials along an outline: constant, linear, quadratic
ROUGH = 0.02  # displacement of single blocks [px]
NEAR = (0.02, 0.35)  # standard deviation of the lines that it starts from: [px] and in blurs
BLURS = (0.2, 4.0)  # [px]
LEAST_SAMPLES = 30  # of a block
LARGEST_STEP = (0.7, 0.4)  # of one round: of the line [blurs], of the logarithm of the blur
SETTLED = 0.01  # step of every line below which the rounds end [px]
ODD = (1.5, 4.0)  # noise in that of a typical block from where on one counts less, and not at all
LEAST_NOISE = 0.05  # [grey levels^2]

SHIFT, BLUR, N_UNKNOWNS = N_AMPLITUDES, N_AMPLITUDES + 1, N_AMPLITUDES + 2  # unknowns of a block


@dataclass(frozen=True, eq=False)
class Round:
    """Where the unknowns of all edges are."""

    amplitude: Array  # (n_edges, N_ALONG, N_AMPLITUDES)
    line: Array  # (n_edges, 2) in the middle, and half of the difference of the ends [px]
    log_blur: Array  # (n_edges,)
    noise: Array  # (n_edges,) [grey levels^2]
    inverse: Array  # (n_edges, N_ALONG * N_UNKNOWNS, N_ALONG * N_UNKNOWNS)


@dataclass(eq=False)
class Pool:
    """The blocks of all edges, and which belong together."""

    d: Array  # (n, m) from the lines on which the blocks had settled [px]
    weight: Array  # (n, m)
    light: Array  # (n, m) times the weight, less the mean of the edge
    power: Array  # (n,) its sum of squares
    n_samples: Array  # (n,)
    usable: BoolArray  # (n,)
    gain: Array  # (n,)
    edge: IntArray  # (n,)
    bounds: IntArray  # (n_edges + 1,)
    along: Array  # (n, N_ALONG) polynomials at the blocks
    half_width: Array  # (n_edges,) [px]
    contrast: Array  # (n_edges,)
    depth: float
    seen: BoolArray  # (n_edges,) edges with usable blocks
    latest: tuple[Round | None, tuple[Array, Array]]  # sums, and where the unknowns were

    @classmethod
    def of(cls, blocks: Blocks, kept: BoolArray, depth: float) -> "Pool":
        """Return what is needed of some blocks."""
        d, grey, weight, half_width = (
            np.asarray(x, dtype=np.float64) for x in blocks.samples(slice(None))
        )
        bounds = blocks.bounds
        edge = np.repeat(np.arange(len(bounds) - 1), np.diff(bounds))
        n_samples = np.count_nonzero(weight, axis=1)
        usable = kept & (n_samples >= LEAST_SAMPLES)
        counted = usable[:, None] * weight

        def total(values: Array) -> Array:
            sums = np.bincount(edge, values.sum(axis=1), len(bounds) - 1)
            return np.asarray(sums, dtype=np.float64)

        seen = total(counted) > 0.0
        level = total(counted * grey) / np.maximum(total(counted), 1e-9)
        light = (grey - level[edge][:, None]) * weight
        spread = total(usable[:, None] * light**2) / np.maximum(total(counted > 0.0), 1.0)
        rise = 2.0 * blocks.position - 1.0
        along = np.stack([np.ones_like(rise), rise, 1.5 * rise**2 - 0.5], axis=1)
        first = np.minimum(bounds[:-1], max(len(d) - 1, 0))
        return cls(
            d, weight, light, np.sum(light**2, axis=1), n_samples, usable, blocks.gain, edge,
            bounds, along, half_width[first, 0], 2.0 * np.sqrt(spread) + 1.0, depth, seen,
            (None, (np.empty(0), np.empty(0))),
        )  # fmt: skip

    def first_amplitudes(self, at: Round) -> Round:
        """Return the amplitudes that an outline has in common, with its line where it is."""
        gram, right = self._sums(at)
        values, _, _ = profile_functions(self.half_width, np.exp(at.log_blur), self.depth)
        of_edge = values @ self._of_edges(gram, self.usable) @ values.swapaxes(1, 2)
        prior = at.noise[:, None] / (COMMON * self.contrast[:, None]) ** 2 + 1e-9
        of_edge += prior[:, :, None] * np.eye(N_AMPLITUDES)
        target = values @ self._of_edges(right[..., None], self.usable)
        at.amplitude[:, 0] = np.linalg.solve(of_edge, target)[..., 0]
        return at

    def rounds(self, at: Round, log_blur: float, sigma: float, n: int) -> Round:
        """Take Gauss-Newton steps, ``n`` at most, the blur known to ``sigma`` beforehand."""
        for _ in range(n):
            before = at
            at = self._round(at, log_blur, sigma)
            steps = np.abs(at.line - before.line), np.abs(at.log_blur - before.log_blur)
            if max(float(step.max()) for step in steps) < SETTLED:
                break
        return at

    def _round(self, at: Round, log_blur: float, sigma: float) -> Round:
        """Take one step."""
        normal, right, expected = self._blocks(at)
        normal /= at.noise[self.edge][:, None, None]
        right /= at.noise[self.edge][:, None]
        own = self._own_precision()
        inverse = np.linalg.inv(normal + _diagonal(own))
        fitted = (inverse @ (right + own * expected)[..., None])[..., 0]
        noise, weight = self._noise(at, normal, right, fitted)
        # A block's own amplitudes are eliminated: what is left is known of the common ones.
        eliminated = normal @ inverse
        normal = (normal - eliminated @ normal) * weight[:, None, None]
        right = (right - (eliminated @ right[..., None])[..., 0]) * weight[:, None]
        n = len(self.half_width)
        system, target = (
            np.empty((n, N_ALONG, N_UNKNOWNS, N_ALONG, N_UNKNOWNS)),
            np.empty((n, N_ALONG, N_UNKNOWNS)),
        )
        for i, one in enumerate(self.along.T):
            target[:, i] = self._of_edges(right[..., None], one)[..., 0]
            for j, other in enumerate(self.along.T[: i + 1]):
                system[:, i, :, j] = system[:, j, :, i] = self._of_edges(normal, one * other)
        precision, pull = self._known_before(at, log_blur, sigma)
        shape = n, N_ALONG * N_UNKNOWNS
        whole = system.reshape(*shape, -1) + _diagonal(precision.reshape(shape))
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

    def _sums(self, at: Round) -> tuple[Array, Array]:
        """Return products of the powers of every block, and of them with its light."""
        if at is self.latest[0]:
            return self.latest[1]
        moved = self.gain * np.sum(at.line[self.edge] * self.along[:, :2], axis=1)
        z = (self.d - moved[:, None]) / np.exp(at.log_blur)[self.edge][:, None]
        U = np.empty((*z.shape, N_POWERS + 1))  # in double precision: sums nearly cancel
        np.multiply(powers(z), self.weight[..., None], out=U[..., :-1])
        U[..., -1] = self.light
        products = U.swapaxes(1, 2) @ U
        sums = products[:, :-1, :-1], products[:, :-1, -1]
        self.latest = at, sums
        return sums

    def _blocks(self, at: Round) -> tuple[Array, Array, Array]:
        """Return the normal equations of all blocks, and the unknowns that are expected."""
        gram, right = self._sums(at)
        functions = profile_functions(self.half_width, np.exp(at.log_blur), self.depth)
        values, slopes, widenings = (f[self.edge] for f in functions)
        expected = np.zeros((len(self.edge), N_UNKNOWNS))
        amplitude = np.einsum("nj,njk->nk", self.along, at.amplitude[self.edge])
        expected[:, :N_AMPLITUDES] = amplitude
        row = amplitude[:, None, :]
        shift = -self.gain[:, None, None] * (row @ slopes)
        design = np.concatenate([values, shift, row @ widenings], axis=1)
        normal = design @ gram @ design.swapaxes(1, 2)
        return normal, (design @ right[..., None])[..., 0], expected

    def _noise(self, at: Round, normal: Array, right: Array, fitted: Array) -> tuple[Array, Array]:
        """Return the noise of each edge, and how much each block counts by its own."""
        explained = 2.0 * right - (normal @ fitted[..., None])[..., 0]
        explained = np.sum(fitted * explained, axis=1) * at.noise[self.edge]
        of_block = np.maximum(self.power - explained, 0.0) / np.maximum(self.n_samples - 5.0, 1.0)
        of_edge = np.ones(len(self.half_width))
        for k in np.flatnonzero(self.seen):
            block = slice(self.bounds[k], self.bounds[k + 1])
            of_edge[k] = np.median(of_block[block][self.usable[block]])
        of_edge = np.asarray(np.maximum(of_edge, LEAST_NOISE))
        excess = of_block / of_edge[self.edge]
        return of_edge, self.usable * np.clip((ODD[1] - excess) / (ODD[1] - ODD[0]), 0.0, 1.0)

    def _own_precision(self) -> Array:
        """Return how little the unknowns of single blocks scatter, (n, N_UNKNOWNS)."""
        precision = np.empty((len(self.edge), N_UNKNOWNS))
        precision[:, :N_AMPLITUDES] = (OF_BLOCKS * self.contrast[self.edge][:, None]) ** -2
        precision[:, SHIFT], precision[:, BLUR] = ROUGH**-2, 1e10
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

    def _of_edges(self, values: Array, weight: Array | BoolArray) -> Array:
        """Return sums over the blocks of each edge, of values (n, i, j) times weights (n,)."""
        totals = np.zeros((len(self.half_width), *values.shape[1:]))
        some = np.flatnonzero(np.diff(self.bounds))
        weighted = values * weight[:, None, None]
        totals[some] = np.add.reduceat(weighted, self.bounds[:-1][some], axis=0)
        return totals


def _diagonal(values: Array) -> Array:
    """Return diagonal matrices (..., n, n)."""
    return np.asarray(values[..., None] * np.eye(values.shape[-1]))
