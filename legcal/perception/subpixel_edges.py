"""Sub-pixel lines of all outlines of an image, from edges known to about a pixel.

First rounds on a few blocks pull the lines in, with a wide blur and then with that of the image as
its best blocks show it: where it is wrong, lines lie beside their outlines, and where they do, the
blur seems wide. Then lines converge robustly on blocks that are fitted apart. At last all blocks of
an outline that lie on its line are fitted together, and the blur to all outlines.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from legcal.geometry.types import Array
from legcal.perception.blocks import BLURS, BlockLine, Blocks, depth_for_blur
from legcal.perception.pixel_sums import medians
from legcal.perception.pooled_fit import PooledLines, fit_pooled
from legcal.perception.profiles import Edge
from legcal.vision.camera import Camera
from legcal.vision.image_file import Grey

FIRST_BLUR = 1.0  # [px]
MIN_CHI2_GAIN = 30  # by an edge, from which on a block shows one
FIRST_BLOCKS = 16  # most blocks of an outline in the first rounds
ROUNDS, ROUNDS_NEAR = (1, 2), (2,)  # of estimates of the blur, and of one near a rough one
LAST_ROUNDS = 2  # most rounds of lines
MAX_BLUR_TRIALS, BLUR_CONVERGED = 3, 0.25  # until its logarithm changes by less
SHADING = 0.5  # that the model leaves out [grey levels]
WIDENING = 1.3  # of the standard deviations of a fit of all blocks, whose errors are correlated
POOLED_COMMON_BIAS, POOLED_TILT_BIAS = 0.012, 0.02  # of such a fit: of both ends, of each [px]


@dataclass(frozen=True, eq=False)
class MeasuredEdge:
    """The line of an outline."""

    v: Array  # (2,) offsets at both ends of the band [px]
    line: BlockLine  # how the blocks lie about it
    contrast: float  # median step from the background to the leg, without sign [grey levels]
    is_step: bool  # whether most blocks show a step or a limb, not only a bend of the shading
    blur: float  # standard deviation of the blur of the image [px]
    covariance: Array  # (2, 2) of the offsets at both ends of the used piece [px^2]
    clipped: float = -math.inf  # depth to which the background saturates most blocks [blurs]
    by_gamma: float = math.nan  # how far it moves inside with ln gamma [px]; NaN where not known
    polish: float = math.nan  # log likelihood ratio of a polished surface over a matte one

    @property
    def sigma(self) -> float:
        """Standard deviation at the worse end [px]."""
        return float(np.sqrt(np.diag(self.covariance).max()))


class LostEdge(NamedTuple):
    """An edge that no straight line fits."""

    blur: float  # standard deviation of the blur of the image [px]
    clipped: float = -math.inf  # depth to which the background saturates most blocks [blurs]


def measure_edges(
    grey: Grey,
    camera: Camera,
    edges: Sequence[Edge],
    together: bool = True,
    blur: float | None = None,
    *,
    near_fit: bool = False,
) -> tuple[list[MeasuredEdge | LostEdge], float]:
    """Fit the limb model and straight lines to all edges of an image; return its blur as well [px].

    Unless all blocks are fitted together in the end,
    lines are good to a few hundredths of a pixel, in half the time. The blur may be known roughly.
    Near a fit it is that of other images, and edges are known to a few tenths of a pixel.
    """
    v, joint = [edge.v for edge in edges], None
    n_rounds = ROUNDS if blur is None else ROUNDS_NEAR
    blur = FIRST_BLUR if blur is None else blur
    if not near_fit:
        blur = first = float(np.clip(blur, *BLURS[:2]))
        blocks = Blocks.read(grey, camera, edges, v, first, FIRST_BLOCKS)
        if len(blocks.moved) == 0:
            return [LostEdge(first)] * len(edges), first
        for n in n_rounds:
            blocks.fit(blur, 1)
            blur = blocks.estimate_blur(n)
        if not together and abs(np.log(blur / first)) < BLUR_CONVERGED:
            blocks.fit(blur, LAST_ROUNDS)
            return _measured(edges, v, blocks, blur, None), blur
        v = [_moved(edge, at, line) for edge, at, line in zip(edges, v, blocks.lines, strict=True)]
    for _ in range(MAX_BLUR_TRIALS):
        tried = blur
        blocks = Blocks.read(grey, camera, edges, v, tried, None if together else FIRST_BLOCKS)
        if len(blocks.moved) == 0:
            return [LostEdge(tried)] * len(edges), tried
        blocks.fit(tried, LAST_ROUNDS)
        if not together:
            break
        if near_fit:
            blocks.unmove()
            blocks.narrow(tried)
        joint = fit_pooled(blocks, blocks.shares(), tried, depth_for_blur(tried))
        blur = joint.blur
        if abs(np.log(blur / tried)) < BLUR_CONVERGED:
            break
    return _measured(edges, v, blocks, blur, joint), blur


def _measured(
    edges: Sequence[Edge],
    v: Sequence[Array],
    blocks: Blocks,
    blur: float,
    joint: PooledLines | None,
) -> list[MeasuredEdge | LostEdge]:
    """Return the lines of edges by their blocks, one by one or all together."""
    lines: list[MeasuredEdge | LostEdge] = []
    kept = blocks.kept()
    edge_of = blocks.edge[kept]
    bounds = np.searchsorted(edge_of, np.arange(len(edges) + 1)).tolist()
    of_blocks = (np.abs(blocks.contrast), blocks.sharp, blocks.clipped - blocks.moved)
    typical = [medians(values[kept], edge_of, bounds).tolist() for values in of_blocks]
    for i, (edge, at, line, contrast, sharp, clipped) in enumerate(
        zip(edges, v, blocks.lines, *typical, strict=True)
    ):
        if line is None:
            depths = (blocks.clipped - blocks.moved)[blocks.edge == i]
            clipped = float(np.median(depths)) / blur if len(depths) else -math.inf
            lines.append(LostEdge(blur, clipped))
            continue
        is_step = sharp > MIN_CHI2_GAIN
        # How far shading moves an outline: its grey levels over the slope of the step.
        bias = float(SHADING * np.sqrt(2.0 * np.pi) * blur / max(contrast, 1e-3))
        moved = _moved(edge, at, line)
        if joint is None:
            covariance = line.covariance + bias**2
            lines.append(MeasuredEdge(moved, line, contrast, is_step, blur, covariance))
            continue
        to_piece = np.array([[1.0 - place, place] for place in (line.first, line.last)])
        covariance = WIDENING**2 * to_piece @ joint.covariance[i] @ to_piece.T
        covariance = 0.5 * (covariance + covariance.T)
        covariance += POOLED_COMMON_BIAS**2 + POOLED_TILT_BIAS**2 * np.eye(2) + bias**2
        ends = joint.ends[i]
        depth = (clipped - float(ends.mean())) / blur
        lines.append(
            MeasuredEdge(
                moved + edge.epsilon * ends,
                line,
                contrast,
                is_step,
                blur,
                covariance,
                depth,
                float(joint.by_gamma[i]),
                float(joint.polish[i]),
            )
        )
    return lines


def _moved(edge: Edge, v: Array, line: BlockLine | None) -> Array:
    """Return the offsets of an edge moved by a line of shifts towards the inside."""
    return v if line is None else np.asarray(v + edge.epsilon * line.ends)
