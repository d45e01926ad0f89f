"""Blocks of pixels along all outlines of an image, and lines that settle on them.

In turns each block is fitted by itself, and a straight line robustly to the blocks of each outline.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from legcal.detection.band import Band
from legcal.detection.fit import depth_for_blur, fit_blocks
from legcal.detection.limb import Samples
from legcal.detection.picture import Grey
from legcal.detection.profiles import read_profiles
from legcal.detection.response import to_light
from legcal.detection.straight import StraightFit, fit_straight
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.vision.camera import Camera

SHALLOWEST = 0.8  # largest used depth, in half-widths
ROWS = 8  # of a block in the first rounds, and in the last ones of a sharp picture
ENOUGH, LONGEST = 16, 3  # blocks of an outline from which on longer ones are made, so many times
ROWS_PER_BLUR = 0.6  # of the blur for which such blocks are long enough [px]
VAGUE = (1.3, 0.6)  # uncertainty from which on a block tells nothing: in blurs, and [px]
SETTLED = 0.03  # movement of every line below which the rounds end [px]


@dataclass(frozen=True, eq=False)
class Edge:
    """An outline that is known to about a pixel.

    Attributes
    ----------
    band : Band
        The frame of its part.
    v : (2,) array
        Offsets at both ends of the band [px].
    epsilon : float
        +1 for edge 1, -1 for edge 2.
    half_width : float
        Half of the width of the part in the image [px].
    hidden : (n,) array of bool
        Which of n equal stretches of the band other legs hide.
    """

    band: Band
    v: Array
    epsilon: float
    half_width: float
    hidden: BoolArray


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
        step: int,
    ) -> "Blocks":
        """Read every ``step``-th unhidden block of all edges."""
        outer = depth_for_blur(blur)
        reach = int(np.ceil(1.42 * outer))
        rows = ROWS * int(np.clip(np.rint(blur / ROWS_PER_BLUR), 1, 4)) if step == 1 else ROWS
        if step == 1 and edges:
            shortest = min(edge.band.length * float(np.mean(~edge.hidden)) for edge in edges)
            rows = max(rows, ROWS * int(np.clip(shortest / (ROWS * ENOUGH), 1, LONGEST)))
        profiles = []
        for edge, at in zip(edges, v, strict=True):
            inner = min(outer, SHALLOWEST * edge.half_width)
            depths = (-outer, inner)
            read = read_profiles(grey, camera, edge.band, at, edge.epsilon, depths, reach, rows)
            n = len(edge.hidden)
            stretch = np.clip((read.t / edge.band.length * n).astype(np.intp), 0, n - 1)
            free = ~edge.hidden[stretch]
            free[np.arange(len(free)) % step != 0] = False
            profiles.append(read.take(free))
        counts = [len(p.t) for p in profiles]
        half_width = np.repeat([edge.half_width for edge in edges], counts)
        inside = np.concatenate([p.inside for p in profiles])
        light, weight = to_light(np.concatenate([p.grey for p in profiles]), inside, camera.gamma)
        return cls(
            np.concatenate([p.d for p in profiles]),
            light,
            weight,
            np.concatenate([p.gain for p in profiles]),
            np.cumsum([0, *counts]),
            np.concatenate(
                [p.t / edge.band.length for p, edge in zip(profiles, edges, strict=True)]
            ),
            half_width.astype(np.float32)[:, None],
            np.zeros(sum(counts)),
            np.zeros(sum(counts)),
            np.zeros(sum(counts)),
            [None] * len(edges),
        )

    def samples(self, blocks: slice | BoolArray) -> tuple[Samples, Samples, Samples, Samples]:
        """Return distances from the current lines, grey levels, weights, half-widths."""
        d = self.d[blocks] - self.moved[blocks, None].astype(np.float32)
        return d, self.grey[blocks], self.weight[blocks], self.half_width[blocks]

    def contrasts(self) -> list[Array]:
        """Return the contrasts of the blocks of each edge, without sign."""
        return np.split(np.abs(self.contrast), self.bounds[1:-1])

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

    def settle(self, blur: float, n_rounds: int, least_gain: float) -> None:
        """Fit the blocks and a line to each edge in turn, until no line moves any more."""
        active = np.ones(len(self.lines), dtype=np.bool_)
        counts = np.diff(self.bounds)
        for turn in range(n_rounds):
            least = least_gain if turn > 1 else -np.inf  # a line that is off shows bad fits
            chosen = np.repeat(active, counts)
            fit = fit_blocks(*self.samples(chosen), blur)
            self.contrast[chosen], self.sharp[chosen] = fit.contrast, fit.sharp
            shift, variance = np.zeros(len(chosen)), np.full(len(chosen), np.inf)
            shift[chosen] = fit.shift
            variance[chosen] = np.where(fit.gain > least, fit.variance, np.inf)
            for i in np.flatnonzero(active):
                block = slice(self.bounds[i], self.bounds[i + 1])
                movement = self._fit_line(
                    int(i), shift[block], variance[block], min(VAGUE[0] * blur, VAGUE[1]) ** 2
                )
                active[i] = movement > SETTLED
            if not np.any(active):
                break

    def _fit_line(self, i: int, shift: Array, variance: Array, largest: float) -> float:
        """Fit the line of an edge, which holds the whole shift; return its movement [px]."""
        block = slice(self.bounds[i], self.bounds[i + 1])
        gain, position, before = self.gain[block], self.position[block], self.moved[block].copy()
        line = fit_straight(position, (before + shift) / gain, variance / gain**2, largest)
        self.lines[i] = line
        if line is None:
            return 0.0
        along = line.ends[0] + (line.ends[1] - line.ends[0]) * position
        self.moved[block] = along * gain
        return float(np.abs(along * gain - before).max())
