"""Blocks of pixels along all outlines of an image, and lines that settle on them.

In turns each block is fitted by itself, and a straight line robustly to the blocks of each outline.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from legcal.detection.fit import depth_for_blur, fit_blocks
from legcal.detection.limb import Samples
from legcal.detection.noise import evened_weights
from legcal.detection.picture import Grey
from legcal.detection.profiles import Edge, read_profiles
from legcal.detection.response import to_light
from legcal.detection.straight import StraightFit, fit_straights
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.vision.camera import Camera

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
            self.contrast[chosen], self.sharp[chosen] = fit.contrast, fit.sharp
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
