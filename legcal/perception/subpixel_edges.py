"""Sub-pixel lines of all outlines of an image, from edges known to about a pixel.

First rounds on a few blocks pull the lines in, with a wide blur and then with that of the image as
its best blocks show it: where it is wrong, lines lie beside their outlines, and where they do, the
blur seems wide. Then lines converge robustly on blocks that are fitted apart. At last all blocks of
an outline that lie on its line are fitted together, and the blur to all outlines.

Stripes that a polished rod reflects run along it as its limbs do, often with more contrast, while
the limb shows only where what is behind ends. The limb model tells them apart: inside it may be any
surface, outside is a background, even along short pieces. :func:`limb_shifts` fits it to the same
pixels with the limb at every distance near a line, and the likelihoods of blocks vote; both edges
of a part together, by its width.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from legcal.geometry.types import Array
from legcal.perception.blocks import BLURS, MAX_DEPTH, ROWS, BlockLine, Blocks, depth_for_blur
from legcal.perception.limb import (
    N_AMPLITUDES,
    POLISHED,
    powers,
    profile_functions,
)
from legcal.perception.pooled_fit import COMMON, MIN_SAMPLES, PooledLines, fit_pooled
from legcal.perception.profiles import Edge, PixelBins, applied, medians, read_profiles, to_light
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
    blur: float | None = None,
    *,
    near_fit: bool = False,
    in_brief: bool = False,
) -> tuple[list[MeasuredEdge | LostEdge], float]:
    """Fit the limb model and straight lines to all edges of an image; return its blur as well [px].

    In brief, blocks are not fitted together in the end: lines are good to a few hundredths of a
    pixel, in half the time. The blur may be known roughly. Near a fit it is that of other images,
    and edges are known to a few tenths of a pixel.
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
        if in_brief and abs(np.log(blur / first)) < BLUR_CONVERGED:
            blocks.fit(blur, LAST_ROUNDS)
            return _measured(edges, v, blocks, blur, None), blur
        v = [_moved(edge, at, line) for edge, at, line in zip(edges, v, blocks.lines, strict=True)]
    for _ in range(MAX_BLUR_TRIALS):
        tried = blur
        blocks = Blocks.read(grey, camera, edges, v, tried, FIRST_BLOCKS if in_brief else None)
        if len(blocks.moved) == 0:
            return [LostEdge(tried)] * len(edges), tried
        blocks.fit(tried, LAST_ROUNDS)
        if in_brief:
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


SHIFTS = np.arange(-4.0, 4.25, 0.5)  # places of a limb that are tried, inwards [px]
DEPTHS = 7.0, 3.0  # range of pixels outside and inside a line [px]
MOST_BLOCKS = 16  # most blocks of an outline
MIN_NOISE, NOISE_ROUNDS = 0.1, 3  # variance [grey levels^2]
MOST_VOTE = 10.0  # log likelihood by which a block speaks against a place at most
MIN_GAIN, MIN_SHIFT = 8.0, 1.0  # in log likelihood, and [px], for which another edge is taken


def limb_shifts(
    grey: Grey, camera: Camera, edges: Sequence[Edge], blur: float, narrower: Array, sigma: Array
) -> Array:
    """Return the shifts of limbs from lines, positive inwards, (n_edges,) [px].

    Edges are edge 1 and edge 2 of each part; a part is *narrower* (n_parts,) than its edges are
    apart [px], by a standard deviation *sigma*; the blur is known roughly [px].
    """
    evidence = _evidence(grey, camera, edges, blur).reshape(-1, 2, len(SHIFTS))
    width = (SHIFTS[:, None] + SHIFTS - narrower[:, None, None]) / sigma[:, None, None]
    both = evidence[:, 0, :, None] + evidence[:, 1, None] - 0.5 * width**2
    best = np.stack(np.divmod(both.reshape(len(both), -1).argmax(axis=1), len(SHIFTS)), axis=1)
    near = np.where(np.abs(SHIFTS) < MIN_SHIFT, 0.0, -np.inf)
    here = (both + near[:, None] + near).max(axis=(1, 2))
    is_other = both.max(axis=(1, 2)) - here > MIN_GAIN
    return np.asarray(np.where(is_other[:, None], SHIFTS[best], 0.0).ravel())


def _evidence(grey: Grey, camera: Camera, edges: Sequence[Edge], blur: float) -> Array:
    """Return the log likelihoods (n_edges, n_shifts) of places of limbs, up to a constant each."""
    half_width = np.array([edge.half_width for edge in edges])
    outer, inner = DEPTHS[0], np.minimum(DEPTHS[1], MAX_DEPTH * half_width)
    read = read_profiles(
        grey, camera, edges, [edge.v for edge in edges], (outer, inner), ROWS, MOST_BLOCKS
    )
    light, weight = to_light(read.grey, read.window, camera.gamma)
    kept = np.count_nonzero(weight, axis=1) >= MIN_SAMPLES
    edge = np.repeat(np.arange(len(edges)), np.diff(read.bounds))[kept]
    bounds = np.searchsorted(edge, np.arange(len(edges) + 1)).tolist()
    evidence = np.zeros((len(edges), len(SHIFTS)))
    if len(edge) == 0:
        return evidence
    light, weight, window = light[kept], weight[kept], read.window[kept]
    light = light - (np.sum(light * weight, axis=1) / weight.sum(axis=1))[:, None]
    sums = PixelBins.of(read.d[kept], weight, blur, window=window).sums(light)
    power, count = sums.power.sum(axis=1), sums.count.sum(axis=1)
    contrast = medians(2.0 * np.sqrt(power / count) + 1.0, edge, bounds)
    prior = np.eye(N_AMPLITUDES) * ((COMMON[POLISHED] * contrast[:, None]) ** -2)[edge, None]
    blurs = np.full(len(edges), blur)
    design = profile_functions(half_width, blurs, outer, POLISHED)[0][edge]
    whole = (0, len(edge))
    normal, right = [], []
    for shift in SHIFTS:
        values, slopes = powers((sums.grid - shift) / blur)
        at_bins = values[None], slopes[None] / blur, whole
        normal.append(design @ sums.products(*at_bins) @ design.swapaxes(1, 2))
        right.append((design @ sums.with_light(*at_bins)[..., None])[..., 0])
    normals, rights = np.array(normal), np.array(right)  # (n_shifts, n, ...)
    noise = np.full(len(edges), MIN_NOISE)
    for _ in range(NOISE_ROUNDS):
        variance = noise[edge]
        amplitude = applied(np.linalg.inv(normals + variance[:, None, None] * prior), rights)
        left = power - np.sum(amplitude * (2.0 * rights - applied(normals, amplitude)), axis=-1)
        of_block = np.maximum(left.min(axis=0), 0.0) / np.maximum(count - N_AMPLITUDES, 1.0)
        noise = np.fmax(medians(of_block, edge, bounds), MIN_NOISE)
    variance = noise[edge]
    system = normals / variance[:, None, None] + prior
    pull = rights / variance[:, None]
    explained = np.sum(pull * np.linalg.solve(system, pull[..., None])[..., 0], axis=-1)
    likelihood = 0.5 * (explained - np.linalg.slogdet(system)[1])
    vote = np.logaddexp(-MOST_VOTE, likelihood - likelihood.max(axis=0))
    # Too deep inside the limb its expansion is no use, and with no surface in sight there is none.
    surface = inner[edge] - SHIFTS[:, None]
    vote[(surface > MAX_DEPTH * half_width[edge]) | (surface <= 0.0)] = -MOST_VOTE
    for k in np.unique(edge).tolist():
        evidence[k] = vote[:, bounds[k] : bounds[k + 1]].sum(axis=1)
    return evidence
