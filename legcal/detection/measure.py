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

from legcal.detection.blocks import Blocks
from legcal.detection.fit import depth_for_blur, estimate_blur
from legcal.detection.picture import Grey
from legcal.detection.pooled import fit_together
from legcal.detection.profiles import Edge
from legcal.detection.straight import StraightFit
from legcal.geometry.types import Array
from legcal.vision.camera import Camera

__all__ = ["Edge", "MeasuredEdge", "measure_edges"]

FIRST_BLUR = 1.0  # [px]
LEAST_GAIN = 30  # in chi^2, by which a block shows an edge at all
FIRST_BLOCKS = 12  # of an outline
FIRST_ROUNDS, LAST_ROUNDS = 2, 2  # the last ones at most
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
        for _ in range(FIRST_ROUNDS):
            blocks.settle(blur, 1)
            blur = estimate_blur(*blocks.samples(slice(None)), blocks.merit())
        v = [_moved(edge, at, line) for edge, at, line in zip(edges, v, blocks.lines, strict=True)]
    for _ in range(TRIALS):
        tried = blur
        blocks = Blocks.read(grey, camera, edges, v, tried)
        if len(blocks.moved) == 0:
            return [None] * len(edges), tried
        blocks.settle(tried, LAST_ROUNDS)
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
