"""Blocks of pixels along outlines, fitted one by one, and robust lines through them.

A line converges to where most blocks of its outline have their edge. Neighbouring blocks share what
the limb model leaves out (texture, shading, the lens), so the covariance of a line rests on the
scatter and the correlation that are seen, and never falls below what the model is known to be good
for.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from legcal.estimation.loss import biweights
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.perception.limb import N_SIMPLE, powers, simple_functions
from legcal.perception.profiles import (
    Edge,
    PixelBins,
    PixelSums,
    Samples,
    applied,
    fading,
    read_profiles,
    to_light,
)
from legcal.perception.tuning import BLOCK_SIGMAS
from legcal.vision.camera import Camera
from legcal.vision.image_file import Grey

DEPTH = (2.0, 2.5)  # used distance from an outline: [px] and in blurs
MAX_DEPTH = 0.8  # largest used depth, in half-widths
NEAR_DEPTH = (1.0, 2.0)  # the same inside narrow parts once lines are known well
MILD_DEPTH, MAX_NEAR_DEPTH = 0.25, 0.6  # then, in half-widths: used if it is more; and at most
ROWS = 8  # rows of a block in the first rounds, and in the last ones of a sharp picture
MIN_ROWS_CLIPPED = 16  # least rows of a block where the background saturates the picture
MIN_SHARE_CLIPPED = 0.1  # share of the blocks of an image from which on they are that long
ENOUGH_BLOCKS, MAX_BLOCK = 16, 3  # of an outline for longer blocks, so many times at most
ROWS_PER_BLUR = 0.6  # of the blur for which such blocks are long enough [px]
MAX_BLOCK_SIGMA = (1.3, 0.6)  # of a block that counts: in blurs, and [px]
CONVERGED = 0.1  # movement of every line below which the rounds end [px]

BLURS = (0.3, 2.7, 6)  # trials, least to greatest [px]
BLUR_BLOCKS = 16  # blocks of an image that give its blur
# Prior precision of the amplitudes, in units of the contrast of a block.
RIDGE = np.array([1e-6, 1.0, 1e-2, 0.05, 0.05])
DEEP = 1.5  # inside, besides the blur, where the step to the leg is read [px]
BEND = (0, 1, 4)  # functions of the limb model without an edge
MAX_STEP = 0.8  # largest step of a block [px]

DOUBTFUL = 0.25  # part of BLOCK_SIGMAS in which blocks count less when all are fitted together
N_ROUNDS, CONVERGED_LINE = 10, 1e-3  # of weights: at most, and until no end moves more [px]
N_SCALES = 3  # rounds in which the scale of the scatter is estimated
MIN_SCATTER = 0.01  # added to the standard deviation of a block [px]
COMMON_BIAS, TILT_BIAS = 0.03, 0.02  # of the outline model: of both ends, of each end [px]
MIN_BLOCKS = 4  # least blocks of a line


def depth_for_blur(blur: float) -> float:
    """Return how far from an outline pixels are used [px]: little more than the blur reaches.

    The further inside, the less the shading is that of a limb.
    """
    return DEPTH[0] + DEPTH[1] * blur


@dataclass(eq=False)
class Blocks:
    """The blocks of all edges of an image, and how far their lines have moved."""

    d: Samples  # (n, m) from the lines at which they were read
    light: Samples  # (n, m) from which the mean of the edge is taken
    weight: Samples  # (n, m) by their noise and window
    window: Samples  # (n, m) 1 but where the used range ends
    gain: Array  # (n,)
    bounds: IntArray  # (n_edges + 1,) first block of each edge
    position: Array  # (n,) as fractions of the bands
    half_width: Array  # (n_edges,)
    finish: IntArray  # (n_edges,) of surfaces, as limb.py numbers them
    clipped: Samples  # (n,) up to where the background saturates the picture [px], or -inf

    def __post_init__(self) -> None:
        """Begin where the lines were read; nothing has been fitted."""
        n, n_edges = len(self.d), len(self.half_width)
        total, weights = (
            np.bincount(self.edge, values.sum(axis=1), n_edges)
            for values in (self.light * self.weight, self.weight)
        )
        self.level: Array = total / np.maximum(weights, 1e-9)  # (n_edges,) mean light of each edge
        self.light = self.light - self.level.astype(np.float32)[self.edge][:, None]
        self.moved: Array = np.zeros(n)  # [px]
        self.contrast: Array = np.zeros(n)  # step to the leg [grey levels]
        self.sharp: Array = np.zeros(n)  # how clearly it is one, and no bend of the shading [chi^2]
        self.noise: Array = np.zeros(n)  # mean square residual [grey levels^2]
        self.lines: list[BlockLine | None] = [None] * n_edges
        # Blur and moved of the last bins
        self.last: tuple[float, Array, PixelBins] | None = None

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
        light, weight = to_light(read.grey, read.window, camera.gamma)
        return cls(
            read.d,
            light,
            weight,
            read.window,
            read.gain,
            read.bounds,
            read.position,
            half_width,
            np.array([edge.polished for edge in edges], dtype=np.intp),
            read.clipped,
        )

    @property
    def edge(self) -> IntArray:
        """The edge of each block, (n,)."""
        return np.repeat(np.arange(len(self.half_width)), np.diff(self.bounds))

    def bins(self, blur: float) -> PixelBins:
        """Return the bins of all pixels by their distances from the current lines."""
        if self.last is not None:
            of_blur, moved, bins = self.last
            if of_blur == blur and np.array_equal(moved, self.moved):
                return bins
        d = self.d - self.moved[:, None].astype(np.float32)
        bins = PixelBins.of(d, self.weight, blur, window=self.window)
        self.last = blur, self.moved.copy(), bins
        return bins

    def kept(self) -> BoolArray:
        """Whether blocks lie on the lines of their edges, (n,)."""
        return np.asarray(self.shares() > 0.0)

    def shares(self) -> Array:
        """Return how much blocks count that lie on the lines of their edges, 0 of others, (n,)."""
        nothing = [np.zeros(n) for n in np.diff(self.bounds)]
        lines = zip(self.lines, nothing, strict=True)
        return np.concatenate([none if line is None else line.share for line, none in lines])

    def unmove(self) -> None:
        """Put lines back to where they were read; blocks that lay on them stay kept.

        Blocks by themselves hardly determine where a limb is that rises from the level of the
        background: lines that were near the outline must not converge elsewhere.
        """
        self.moved[:] = 0.0
        self.lines = [
            None if line is None else replace(line, ends=np.zeros(2)) for line in self.lines
        ]

    def narrow(self, blur: float) -> None:
        """Leave out pixels far inside narrow parts, which are not needed near the lines.

        The further inside, the less the shading is that of a limb: highlights and shadows begin,
        and draw outlines inwards. Lines converge from more pixels than determine them.
        """
        least = NEAR_DEPTH[0] + NEAR_DEPTH[1] * blur
        depth = np.clip(MILD_DEPTH * self.half_width, least, depth_for_blur(blur))
        depth = np.minimum(depth, MAX_NEAR_DEPTH * self.half_width)
        d = self.d - self.moved[:, None].astype(np.float32)
        window = fading(d, depth[self.edge, None].astype(np.float32))
        self.weight, self.window, self.last = self.weight * window, self.window * window, None

    def fit(self, blur: float, n_rounds: int) -> None:
        """Fit the blocks and a line to each edge in turn, until no line moves any more."""
        active = np.ones(len(self.lines), dtype=np.bool_)
        counts, edge = np.diff(self.bounds), self.edge
        of_edges = np.full(len(active), blur)
        largest = min(MAX_BLOCK_SIGMA[0] * blur, MAX_BLOCK_SIGMA[1]) ** 2
        for _ in range(n_rounds):
            chosen = active[edge]
            if np.all(chosen):
                sums = self.bins(blur).sums(self.light)
            else:
                d = self.d[chosen] - self.moved[chosen, None].astype(np.float32)
                bins = PixelBins.of(d, self.weight[chosen], blur, window=self.window[chosen])
                sums = bins.sums(self.light[chosen])
            fit = fit_blocks(sums, self.half_width, of_edges, edge[chosen])
            self.contrast[chosen] = fit.contrast
            self.sharp[chosen], self.noise[chosen] = fit.sharpness(), fit.noise
            bounds = np.concatenate([[0], np.cumsum(counts[active])])
            gain, position, before = (x[chosen] for x in (self.gain, self.position, self.moved))
            shift = (before + fit.shift) / gain  # a line has the whole shift
            lines = fit_lines(bounds, position, shift, fit.variance / gain**2, largest)
            after = before.copy()
            for k, (i, line) in enumerate(zip(np.flatnonzero(active).tolist(), lines, strict=True)):
                self.lines[i], in_line = line, slice(bounds[k], bounds[k + 1])
                if line is None:
                    active[i] = False
                    continue
                along = line.ends[0] + (line.ends[1] - line.ends[0]) * position[in_line]
                after[in_line] = along * gain[in_line]
                active[i] = np.abs(after[in_line] - before[in_line]).max() > CONVERGED
            self.moved[chosen] = after
            if not np.any(active):
                break

    def estimate_blur(self, n_rounds: int) -> float:
        """Return the blur [px] that explains best the blocks with most contrast.

        Once each has moved with every blur, in some rounds. Blocks of which half of the step is cut
        have no say.
        """
        merit = np.where(self.clipped > self.moved, 0.0, np.abs(self.contrast))
        best = np.argsort(-merit, kind="stable")[:BLUR_BLOCKS]
        blurs = np.geomspace(*BLURS)
        half_width = np.tile(self.half_width[self.edge[best]], len(blurs))
        d, light, weight = (
            np.concatenate([x[best]] * len(blurs)) for x in (self.d, self.light, self.weight)
        )
        every = np.arange(len(d))
        bounds = [*range(0, len(d), len(best)), len(d)]
        moved = np.tile(self.moved[best], len(blurs))
        for _ in range(n_rounds):
            bins = PixelBins.of(d - moved[:, None].astype(np.float32), weight, blurs[0])
            fit = fit_blocks(
                bins.sums(light), half_width, np.repeat(blurs, len(best)), every, bounds
            )
            moved += fit.shift
        misfit = np.log(fit.noise + 1e-3).reshape(len(blurs), -1).mean(axis=1)
        i = int(np.clip(np.argmin(misfit), 1, len(blurs) - 2))
        left, middle, right = misfit[i - 1 : i + 2]
        bend = left - 2.0 * middle + right
        offset = float(np.clip(0.5 * (left - right) / bend, -1.0, 1.0)) if bend > 0.0 else 0.0
        return float(blurs[i] * (blurs[1] / blurs[0]) ** offset)


@dataclass(frozen=True, eq=False)
class BlockFit:
    """Where the outline lies in every block, (n,) each."""

    shift: Array  # of the outline from the current line, positive towards the inside [px]
    variance: Array  # of it by the noise of the block [px^2]; infinite where nothing is seen
    noise: Array  # mean square residual [grey levels^2]
    contrast: Array  # step to the leg, a pixel and a half inside [grey levels]
    freedom: Array  # samples beyond what is fitted, at least one
    normal: Array  # (n, 5, 5) products of the functions of the limb model
    right: Array  # (n, 5) of them with the grey levels
    power: Array  # sums of squared grey levels

    def sharpness(self) -> Array:
        """Return how much chi^2 (n,) falls by there being more than a bend of the shading."""
        kept = list(BEND)
        part = self.normal[:, kept][:, :, kept] + 1e-3 * np.eye(len(kept))
        right = self.right[:, kept]
        explained = np.sum(right * np.linalg.solve(part, right[..., None])[..., 0], axis=1)
        share = (self.power - explained) / np.maximum(self.noise, 1e-9)
        return np.asarray(share - self.freedom)


def fit_blocks(
    sums: PixelSums,
    half_width: Array,
    blur: Array,
    edge: IntArray,
    bounds: Sequence[int] | None = None,
) -> BlockFit:
    """Fit the limb model to blocks, by one Gauss-Newton step from the current line.

    Of edges with half-widths and blurs (n_edges,) [px], one or more blocks each: ``edge`` (n,).
    Blurs are the same between two successive bounds (n_groups + 1,).
    """
    bounds = (0, len(edge)) if bounds is None else bounds
    of_block = blur[edge]
    of_group = of_block[np.array(bounds[:-1], dtype=np.intp)][:, None]
    functions, changes = powers(sums.grid / of_group)
    at_bins = functions, changes / of_group[..., None], bounds
    products, with_light = sums.products(*at_bins), sums.with_light(*at_bins)
    design = np.concatenate(simple_functions(half_width, blur), axis=1)[edge]
    pairs = design @ products @ design.swapaxes(1, 2)
    right: Array = (design @ with_light[..., None])[..., 0]
    # Grey levels less their mean in the block: sums nearly cancel.
    level = right[:, 0] / np.maximum(pairs[:, 0, 0], 1e-3)
    power = np.maximum(sums.power.sum(axis=1) - level * right[:, 0], 0.0)
    right -= level[:, None] * pairs[:, :, 0]
    simple, turned = slice(0, N_SIMPLE), slice(N_SIMPLE, None)
    normal, steep = pairs[:, simple, simple], pairs[:, turned, turned]
    n_samples = sums.count.sum(axis=1)
    inverse = _regularised_inverse(normal, right[:, simple], power, n_samples)
    amplitude = applied(inverse, right[:, simple])
    left = right - applied(pairs[:, :, simple], amplitude)  # products with the residuals
    # The outline at distance s further inside lowers d by s.
    crossed = applied(pairs[:, simple, turned], -amplitude)
    imitated = applied(inverse, crossed)  # by other amplitudes
    information = _dot(amplitude, applied(steep, amplitude)) + _dot(
        imitated, applied(normal, imitated) - 2.0 * crossed
    )
    gradient = -_dot(amplitude, left[:, turned]) - _dot(imitated, left[:, simple])
    residual = power - _dot(amplitude, right[:, simple] + left[:, simple])
    freedom = np.maximum(n_samples - N_SIMPLE - 1.0, 1.0)
    seen = (information > 1e-9) & (n_samples > 4 * N_SIMPLE)
    safe = np.where(seen, information, 1.0)
    step = np.where(seen, gradient / safe, 0.0)
    noise = np.maximum(residual - step * gradient, 0.0) / freedom
    variance = np.where(seen, noise / safe, np.inf)
    shift = np.clip(step, -MAX_STEP, MAX_STEP)
    deep, _ = powers((DEEP + of_block) / of_block)
    steps = (design[:, 2:N_SIMPLE] @ deep[..., None])[..., 0]
    contrast = _dot(steps, amplitude[:, 2:])
    of_model = normal, right[:, simple], power
    return BlockFit(shift, variance, noise, contrast, freedom, *of_model)


def _dot(a: Array, b: Array) -> Array:
    """Return the products (n,) of vectors (n, k)."""
    return np.asarray(np.einsum("nk,nk->n", a, b), dtype=np.float64)


def _regularised_inverse(normal: Array, right: Array, power: Array, n_samples: Array) -> Array:
    """Invert normal matrices, drawing amplitudes that the noise of a block leaves open to zero."""
    count = np.maximum(n_samples, 1.0)
    power = np.asarray(power / count + 1e-3, dtype=np.float64)
    free = np.linalg.solve(normal + 1e-3 * np.eye(N_SIMPLE), right[..., None])[..., 0]
    unexplained = power - np.einsum("nk,nk->n", right, free) / count
    prior = np.clip(unexplained / power, 1e-4, 1.0)[:, None] * RIDGE
    return np.asarray(np.linalg.inv(normal + prior[:, :, None] * np.eye(N_SIMPLE)))


@dataclass(frozen=True, eq=False)
class BlockLine:
    """A line through the blocks of an outline, with those that lie on it."""

    ends: Array  # (2,) shift of the outline at t = 0 and at t = length [px of the band]
    share: Array  # (n,) how much blocks count that lie on it, 0 of others
    inlier_share: float  # share of the blocks that show an edge at all which lie on the line
    position: Array  # (n_kept,) as fractions of the length
    residual: Array  # (n_kept,) distances from the line [px]
    variance: Array  # (n_kept,) of these by noise, scaled to the scatter seen [px^2]

    @property
    def kept(self) -> BoolArray:
        """Which blocks lie on the line, (n,)."""
        return np.asarray(self.share > 0.0)

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
    left out, and those of more than half of it count less. None where fewer than ``MIN_BLOCKS``
    blocks agree.
    """
    counts = np.diff(bounds)
    filled = np.arange(int(counts.max(initial=0))) < counts[:, None]  # (n_edges, n_most)

    def padded(values: Array) -> Array:
        table = np.zeros(filled.shape)
        table[filled] = values
        return table

    along, moved, noise = (padded(values) for values in (position, shift, variance))
    part = np.divide(noise, largest, out=np.ones_like(noise), where=filled & (noise < largest))
    gate = np.clip(2.0 - 2.0 * part, 0.0, 1.0)
    usable = gate > 0.0
    n_usable = np.count_nonzero(usable, axis=1)
    fits = n_usable >= MIN_BLOCKS
    along, moved = np.where(usable, along, 0.0), np.where(usable, moved, 0.0)
    floored = np.where(usable, noise + MIN_SCATTER**2, 1.0)
    start = _weighted_medians(np.where(usable, moved, np.inf), usable / floored)
    ends = np.repeat(np.where(fits, start, 0.0)[:, None], 2, axis=1)
    factor, robust = np.ones(len(counts)), np.zeros(filled.shape)
    moving = fits.copy()
    sigma, share = np.sqrt(floored), gate / floored
    products = share * np.stack(
        [(1.0 - along) ** 2, (1.0 - along) * along, along**2, (1.0 - along) * moved, along * moved]
    )
    for turn in range(N_ROUNDS):
        pull = np.abs(moved - ends[:, :1] - (ends[:, 1:] - ends[:, :1]) * along) / sigma
        if turn < N_SCALES:
            scatter = 1.4826 * _medians(np.where(usable, pull, np.inf), n_usable)
            factor = np.where(fits, np.maximum(1.0, scatter), 1.0)
        counted = usable * biweights((pull / (BLOCK_SIGMAS * factor[:, None])) ** 2)
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
            moving &= step >= CONVERGED_LINE
        if not np.any(moving):
            break
    on_line = robust > 0.0
    within = 1.0 - np.sqrt(1.0 - np.sqrt(robust))  # 1 on the line, 0 where a block has no weight
    count = gate * np.minimum(within / DOUBTFUL, 1.0)
    residual = moved - ends[:, :1] - (ends[:, 1:] - ends[:, :1]) * along
    scaled = floored * factor[:, None] ** 2
    return [
        BlockLine(
            ends[i],
            count[i, : counts[i]],
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
