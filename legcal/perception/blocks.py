"""Blocks of pixels along outlines, fitted one by one, and robust lines through them.

A line converges to where most blocks of its outline have their edge. Neighbouring blocks share what
the limb model leaves out (texture, shading, the lens), so the covariance of a line rests on the
scatter and the correlation that are seen, and never falls below what the model is known to be good
for.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from legcal.geometry import Array, BoolArray, IntArray
from legcal.perception.light import Samples, evened_weights, to_light
from legcal.perception.limb import N_BASIS, basis
from legcal.perception.profiles import Edge, read_profiles
from legcal.vision import Camera, Grey

DEPTH = (2.0, 2.5)  # used distance from an outline: [px] and in blurs
MAX_DEPTH = 0.8  # largest used depth, in half-widths
ROWS = 8  # of a block in the first rounds, and in the last ones of a sharp picture
MIN_ROWS_CLIPPED = 16  # of a block where the background saturates the picture
MIN_SHARE_CLIPPED = 0.1  # share of the blocks of an image from which on they are that long
ENOUGH_BLOCKS, MAX_BLOCK = 16, 3  # of an outline for longer blocks, so many times at most
ROWS_PER_BLUR = 0.6  # of the blur for which such blocks are long enough [px]
MAX_BLOCK_SIGMA = (1.3, 0.6)  # of a block that counts: in blurs, and [px]
CONVERGED = 0.1  # movement of every line below which the rounds end [px]

BLURS = (0.3, 2.7, 6)  # trials, least to greatest [px]
BLUR_BLOCKS, BLUR_ROUNDS = 16, 2  # blocks of an image that give its blur, steps of each trial
# Prior precision of the amplitudes, in units of the contrast of a block.
RIDGE = np.array([1e-6, 1.0, 1e-2, 0.05, 0.05])
BEND = (0, 1, 4)  # functions of the limb model without an edge
MAX_STEP = 0.8  # largest step of a block [px]

TUKEY = 4.0  # width of the biweight: blocks beyond have no weight [standard deviations]
N_ROUNDS = 10
N_SCALES = 3  # rounds in which the scale of the scatter is estimated
MIN_SCATTER = 0.01  # added to the standard deviation of a block [px]
COMMON_BIAS, TILT_BIAS = 0.03, 0.02  # of the outline model: of both ends, of each end [px]
MIN_BLOCKS = 4  # of a line


def depth_for_blur(blur: float) -> float:
    """Return how far from an outline pixels are used [px]: little more than the blur reaches.

    The further inside, the less the shading is that of a limb.
    """
    return DEPTH[0] + DEPTH[1] * blur


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
    contrast: Array  # (n,) step to the leg [grey levels]
    sharp: Array  # (n,) how clearly it is a step and not a bend of the shading [chi^2]
    lines: list["BlockLine | None"]

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
            rows = max(rows, ROWS * int(np.clip(shortest / (ROWS * ENOUGH_BLOCKS), 1, MAX_BLOCK)))
        half_width = np.array([edge.half_width for edge in edges])
        depths = outer, np.minimum(outer, MAX_DEPTH * half_width)
        read = read_profiles(grey, camera, edges, v, depths, rows, most)
        if rows < MIN_ROWS_CLIPPED and np.mean(read.clipped > -np.inf) > MIN_SHARE_CLIPPED:
            # Too few pixels of a sharp step are left in short blocks.
            read = read_profiles(grey, camera, edges, v, depths, MIN_ROWS_CLIPPED, most)
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

    def of_edges(self, values: Array) -> list[Array]:
        """Return values (n,) of blocks, edge by edge."""
        return np.split(values, self.bounds[1:-1])

    def merit(self) -> Array:
        """Return the weight of each block for the blur: zero where half of the step is cut."""
        return np.where(self.clipped > self.moved, 0.0, np.abs(self.contrast))

    def kept(self) -> BoolArray:
        """Return which blocks lie on the lines of their edges, (n,)."""
        nothing = [np.zeros(n, dtype=np.bool_) for n in np.diff(self.bounds)]
        lines = zip(self.lines, nothing, strict=True)
        return np.concatenate([none if line is None else line.kept for line, none in lines])

    def unmove(self) -> None:
        """Put lines back to where they were read; blocks that lay on them stay kept.

        Blocks by themselves hardly determine where a limb is that rises from the level of the
        background: lines that were near the outline must not converge elsewhere.
        """
        self.moved[:] = 0.0
        self.lines = [
            None if line is None else replace(line, ends=np.zeros(2)) for line in self.lines
        ]

    def fit(self, blur: float, n_rounds: int) -> None:
        """Fit the blocks and a line to each edge in turn, until no line moves any more."""
        active = np.ones(len(self.lines), dtype=np.bool_)
        counts = np.diff(self.bounds)
        largest = min(MAX_BLOCK_SIGMA[0] * blur, MAX_BLOCK_SIGMA[1]) ** 2
        for _ in range(n_rounds):
            chosen = np.repeat(active, counts)
            fit = fit_blocks(*self.samples(chosen), blur)
            self.contrast[chosen] = fit.contrast(self.half_width[chosen], blur)
            self.sharp[chosen] = fit.sharpness()
            bounds = np.concatenate([[0], np.cumsum(counts[active])])
            gain, position, before = (x[chosen] for x in (self.gain, self.position, self.moved))
            shift = (before + fit.shift) / gain  # a line has the whole shift
            lines = fit_lines(bounds, position, shift, fit.variance / gain**2, largest)
            after = before.copy()
            for k, (i, line) in enumerate(zip(np.flatnonzero(active).tolist(), lines, strict=True)):
                self.lines[i], own = line, slice(bounds[k], bounds[k + 1])
                if line is None:
                    active[i] = False
                    continue
                along = line.ends[0] + (line.ends[1] - line.ends[0]) * position[own]
                after[own] = along * gain[own]
                active[i] = np.abs(after[own] - before[own]).max() > CONVERGED
            self.moved[chosen] = after
            if not np.any(active):
                break


@dataclass(frozen=True, eq=False)
class BlockFit:
    """Where the outline lies in every block, (n,) each."""

    shift: Array  # of the outline from the current line, positive towards the inside [px]
    variance: Array  # of it by the noise of the block [px^2]; infinite where nothing is seen
    noise: Array  # mean square residual [grey levels^2]
    freedom: Array  # samples beyond what is fitted, at least one
    amplitude: Array  # (n, 5) of the functions of the limb model [grey levels]
    normal: Array  # (n, 5, 5) products of these functions
    right: Array  # (n, 5) of them with the grey levels
    power: Array  # of grey levels

    def contrast(self, half_width: Samples, blur: float) -> Array:
        """Return the steps (n,) to the leg, a pixel and a half inside [grey levels]."""
        reference = np.full((len(half_width), 1), 1.5 + blur, dtype=np.float32)
        at, _ = basis(reference, half_width, blur)
        return np.asarray(np.sum(at[:, 2:, 0] * self.amplitude[:, 2:], axis=1))

    def sharpness(self) -> Array:
        """Return how much chi^2 (n,) falls by there being more than a bend of the shading."""
        kept = list(BEND)
        part = self.normal[:, kept][:, :, kept] + 1e-3 * np.eye(len(kept))
        right = self.right[:, kept]
        explained = np.sum(right * np.linalg.solve(part, right[..., None])[..., 0], axis=1)
        share = (self.power - explained) / np.maximum(self.noise, 1e-9)
        return np.asarray(share - self.freedom)


def fit_blocks(
    d: Samples, grey: Samples, weight: Samples, half_width: Samples, blur: Samples | float
) -> BlockFit:
    """Fit the limb model to blocks, by one Gauss-Newton step from the current line.

    Distances inside the line [px], grey levels proportional to light, and inverse noise in some
    unit (zero for samples that are not to be used), all (n, m); half-widths (n, 1) and the blur,
    or (n, 1) blurs, in px.
    """
    X, slopes = basis(d, half_width, blur)
    n_samples = np.count_nonzero(weight, axis=1).astype(np.float64)
    level = _products(grey, weight) / np.maximum(weight.sum(axis=1), 1e-3)
    y = (grey - level.astype(np.float32)[:, None]) * weight
    X *= weight[:, None, :]
    normal = (X @ X.swapaxes(1, 2)).astype(np.float64)
    right, power = _with(X, y), _products(y, y)
    inverse = _regularised_inverse(normal, right, power, n_samples)
    amplitude = _applied(inverse, right)
    residual = y - _sum(X, amplitude)
    # The outline at distance s further inside lowers d by s.
    change = _sum(slopes, -amplitude) * weight
    change -= _sum(X, _applied(inverse, _with(X, change)))
    information, gradient = _products(change, change), _products(change, residual)
    freedom = np.maximum(n_samples - N_BASIS - 1.0, 1.0)
    seen = (information > 1e-9) & (n_samples > 4 * N_BASIS)
    safe = np.where(seen, information, 1.0)
    step = np.where(seen, gradient / safe, 0.0)
    noise = np.maximum(_products(residual, residual) - step * gradient, 0.0) / freedom
    variance = np.where(seen, noise / safe, np.inf)
    shift = np.clip(step, -MAX_STEP, MAX_STEP)
    return BlockFit(shift, variance, noise, freedom, amplitude, normal, right, power)


def _products(one: Samples, other: Samples) -> Array:
    """Return the sums of products (n,) in each block."""
    return np.asarray(np.einsum("nm,nm->n", one, other).astype(np.float64))


def _with(functions: Samples, values: Samples) -> Array:
    """Return the sums of products (n, 5) of functions (n, 5, m) with values (n, m)."""
    return np.asarray((functions @ values[..., None])[..., 0].astype(np.float64))


def _sum(functions: Samples, amplitude: Array) -> Samples:
    """Return functions (n, 5, m) with amplitudes (n, 5), added up, (n, m)."""
    return np.asarray((amplitude.astype(np.float32)[:, None] @ functions)[:, 0])


def _applied(matrices: Array, vectors: Array) -> Array:
    """Return the products (n, 5) of matrices with vectors."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])


def _regularised_inverse(normal: Array, right: Array, power: Array, n_samples: Array) -> Array:
    """Invert normal matrices, drawing amplitudes that the noise of a block leaves open to zero."""
    count = np.maximum(n_samples, 1.0)
    power = power / count + 1e-3
    free = np.linalg.solve(normal + 1e-3 * np.eye(N_BASIS), right[..., None])[..., 0]
    unexplained = power - np.sum(right * free, axis=1) / count
    prior = np.clip(unexplained / power, 1e-4, 1.0)[:, None] * RIDGE
    return np.asarray(np.linalg.inv(normal + prior[:, :, None] * np.eye(N_BASIS)))


def estimate_blur(
    d: Samples, grey: Samples, weight: Samples, half_width: Samples, merit: Array
) -> float:
    """Return the blur [px] that explains those blocks of an image best that have most merit (n,).

    The other arguments are as for :func:`fit_blocks`.
    """
    best = np.argsort(-merit, kind="stable")[:BLUR_BLOCKS]
    d, grey, weight, half_width = d[best], grey[best], weight[best], half_width[best]
    blurs = np.geomspace(*BLURS)
    n, blur = len(blurs), np.repeat(blurs, len(d)).astype(np.float32)[:, None]
    d, grey, weight, half_width = (np.concatenate([x] * n) for x in (d, grey, weight, half_width))
    for _ in range(BLUR_ROUNDS):
        fit = fit_blocks(d, grey, weight, half_width, blur)
        d = d - fit.shift[:, None].astype(np.float32)
    misfit = np.log(fit.noise + 1e-3).reshape(n, -1).mean(axis=1)
    i = int(np.clip(np.argmin(misfit), 1, len(blurs) - 2))
    left, middle, right = misfit[i - 1 : i + 2]
    bend = left - 2.0 * middle + right
    offset = float(np.clip(0.5 * (left - right) / bend, -1.0, 1.0)) if bend > 0.0 else 0.0
    return float(blurs[i] * (blurs[1] / blurs[0]) ** offset)


@dataclass(frozen=True, eq=False)
class BlockLine:
    """A line through the blocks of an outline, with those that lie on it."""

    ends: Array  # (2,) shift of the outline at t = 0 and at t = length [px of the band]
    kept: BoolArray  # (n,) the blocks that lie on it
    inlier_share: float  # share of the blocks that show an edge at all which lie on the line
    position: Array  # (n_kept,) as fractions of the length
    residual: Array  # (n_kept,) distances from the line [px]
    variance: Array  # (n_kept,) of these by noise, scaled to the scatter seen [px^2]

    @property
    def first(self) -> float:
        """Position of the first kept block, as a fraction of the length."""
        return float(self.position.min())

    @property
    def last(self) -> float:
        """Position of the last kept block, as a fraction of the length."""
        return float(self.position.max())

    @property
    def scatter(self) -> float:
        """Robust standard deviation of the blocks about the line [px]."""
        return 1.4826 * _median(np.abs(self.residual))

    @property
    def covariance(self) -> Array:
        """Covariance (2, 2) of the shifts at ``first`` and ``last`` [px^2]."""
        along = (self.position - self.first) / (self.last - self.first)
        design = np.column_stack([1.0 - along, along])
        covariance = np.linalg.inv(design.T @ (design / self.variance[:, None]))
        covariance *= _correlation_length(self.residual / np.sqrt(self.variance))
        bias = COMMON_BIAS**2 * np.ones((2, 2)) + TILT_BIAS**2 * np.eye(2)
        return np.asarray(0.5 * (covariance + covariance.T) + bias)


def fit_lines(
    bounds: IntArray, position: Array, shift: Array, variance: Array, largest: float = np.inf
) -> list[BlockLine | None]:
    """Fit a line to each of several outlines by iteratively reweighted least squares.

    From positions (n,) as fractions of the length, shifts [px], and their variances by noise
    [px^2] of all blocks, one outline after the other; those of variance ``largest`` or more are
    left out. None where fewer than ``MIN_BLOCKS`` blocks agree.
    """
    counts = np.diff(bounds)
    filled = np.arange(int(counts.max(initial=0))) < counts[:, None]  # (n_edges, n_most)

    def padded(values: Array) -> Array:
        table = np.zeros(filled.shape)
        table[filled] = values
        return table

    along, moved, noise = (padded(values) for values in (position, shift, variance))
    usable = filled & (noise < largest)
    n_usable = np.count_nonzero(usable, axis=1)
    fits = n_usable >= MIN_BLOCKS
    along, moved = np.where(usable, along, 0.0), np.where(usable, moved, 0.0)
    floored = np.where(usable, noise + MIN_SCATTER**2, 1.0)
    start = _weighted_medians(np.where(usable, moved, np.inf), usable / floored)
    ends = np.repeat(np.where(fits, start, 0.0)[:, None], 2, axis=1)
    factor, robust = np.ones(len(counts)), np.zeros(filled.shape)
    moving = fits.copy()
    sigma, share = np.sqrt(floored), usable / floored
    products = share * np.stack(
        [(1.0 - along) ** 2, (1.0 - along) * along, along**2, (1.0 - along) * moved, along * moved]
    )
    for turn in range(N_ROUNDS):
        pull = np.abs(moved - ends[:, :1] - (ends[:, 1:] - ends[:, :1]) * along) / sigma
        if turn < N_SCALES:
            scatter = 1.4826 * _medians(np.where(usable, pull, np.inf), n_usable)
            factor = np.where(fits, np.maximum(1.0, scatter), 1.0)
        counted = usable * np.maximum(1.0 - (pull / (TUKEY * factor[:, None])) ** 2, 0.0) ** 2
        a, b, c, p, q = np.einsum("knm,nm->kn", products, counted)
        determinant = a * c - b * b
        singular = (np.count_nonzero(counted, axis=1) < MIN_BLOCKS) | (determinant < 1e-9 * a * c)
        fits &= ~(moving & singular)
        moving &= fits
        safe = np.where(moving, determinant, 1.0)
        after = np.stack([c * p - b * q, a * q - b * p], axis=1) / safe[:, None]
        step = np.abs(after - ends).max(axis=1)
        ends[moving], robust[moving] = after[moving], counted[moving]
        if turn >= N_SCALES:
            moving &= step >= 1e-4
        if not np.any(moving):
            break
    on_line = robust > 0.0
    residual = moved - ends[:, :1] - (ends[:, 1:] - ends[:, :1]) * along
    scaled = floored * factor[:, None] ** 2
    return [
        BlockLine(
            ends[i],
            on_line[i, : counts[i]],
            float(np.count_nonzero(on_line[i]) / n_usable[i]),
            along[i, on_line[i]],
            residual[i, on_line[i]],
            scaled[i, on_line[i]],
        )
        if fits[i]
        else None
        for i in range(len(counts))
    ]


def _correlation_length(pull: Array) -> float:
    """Return the number of successive blocks that count as one, from their correlation."""
    n = len(pull)
    if n < 8:
        return 2.0
    pull = pull - pull.mean()
    power = float(pull @ pull) + 1e-12
    rho = max(0.0, *(float(pull[lag:] @ pull[:-lag]) / power for lag in (1, 2)))
    rho = min(rho, 0.8)
    return (1.0 + rho) / (1.0 - rho)


def _median(values: Array) -> float:
    """Return the middle value, the upper one of two."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])


def _medians(values: Array, n: IntArray) -> Array:
    """Return the middle of the n (k,) smallest of each row of values (k, m), the upper of two."""
    if values.shape[1] == 0:
        return np.zeros(len(values))
    return np.asarray(np.sort(values, axis=1)[np.arange(len(values)), n // 2])


def _weighted_medians(values: Array, weight: Array) -> Array:
    """Return the median of each row of values (k, m) with weights."""
    if values.shape[1] == 0:
        return np.zeros(len(values))
    order = np.argsort(values, axis=1, kind="stable")
    total = np.cumsum(np.take_along_axis(weight, order, axis=1), axis=1)
    at = np.count_nonzero(total < 0.5 * total[:, -1:], axis=1)
    return np.asarray(np.take_along_axis(values, order, axis=1)[np.arange(len(values)), at])
