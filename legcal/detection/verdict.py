"""The verdict on both outlines of a part: how well they were seen, and whether to use them."""

import math

import numpy as np

from legcal.detection.measure import MeasuredEdge
from legcal.detection.pairs import Pair
from legcal.geometry.types import Array

LEAST_LENGTH = (30.0, 1.0)  # of an outline: [px] and in widths of the leg
LEAST_CONTRAST = 4.0  # [grey levels]
LEAST_AGREEMENT = 0.6  # share of the blocks with an edge that must lie on the line
LEAST_KEPT = 0.25  # share of all unhidden blocks that must
LONE_KEPT = 0.5  # the same of an edge without its partner
LARGEST_SCATTER = (0.6, 1.2)  # of the blocks of an edge: [px] and in blurs
LARGEST_SIGMA = 0.5  # [px]
WIDTH_TOLERANCE = (0.7, 0.035)  # [px] and share of the predicted width


def verdicts(
    pair: Pair,
    expected: Array,
    length: float,
    measured: tuple[MeasuredEdge | None, MeasuredEdge | None],
) -> tuple[str, str]:
    """Return why each edge of a part cannot be trusted, "" if it can.

    Two edges vouch for each other by their distance. One whose partner fails must be
    convincing by itself.

    Parameters
    ----------
    pair : Pair
        How the edges were found.
    expected : (2,) array
        The width of the part at both ends of the band, by its radius [px].
    length : float
        Length of the band [px].
    measured : tuple of two MeasuredEdge or None
        Edge 1 and edge 2; None where no straight line fits.
    """
    one, two = measured
    width = float(np.mean(pair.v[1] - pair.v[0]))
    reasons = [
        _reason(edge, length, width) if seen else "no convincing edge"
        for edge, seen in zip(measured, pair.found, strict=True)
    ]
    stands = [
        bool(may) and edge is not None and edge.is_step and np.mean(edge.line.kept) >= LONE_KEPT
        for edge, may in zip(measured, pair.alone, strict=True)
    ]
    if one is not None and two is not None and not any(reasons):
        widths = two.v - one.v
        mismatch = np.abs(widths - expected) / (WIDTH_TOLERANCE[0] + WIDTH_TOLERANCE[1] * expected)
        if mismatch.max() > 1.0:
            i = int(np.argmax(mismatch))
            found = f"{widths[i]:.1f} px for {expected[i]:.1f} px"
            return (f"width inconsistent with the radius, {found}",) * 2
    partners = reasons[::-1]
    first, second = (
        reason or ("" if not partner or alone else f"its other outline: {partner}")
        for reason, partner, alone in zip(reasons, partners, stands, strict=True)
    )
    return first, second


def qualities(edge: MeasuredEdge | None, length: float) -> tuple[float, float, float]:
    """Return how well an edge was seen; NaN if it was not.

    Parameters
    ----------
    edge : MeasuredEdge or None
        The edge; None where no straight line fits.
    length : float
        Length of the band [px].

    Returns
    -------
    contrast, length, residual : float
        Median step [grey levels], how much of the edge lies on the line, without gaps [px], and
        the robust standard deviation of its blocks about the line [px]; rounded to what says
        something.
    """
    if edge is None:
        return math.nan, math.nan, math.nan
    line = edge.line
    visible = (len(line.position) - 1) * _spacing(line.position) * length
    return round(edge.contrast, 2), round(visible, 1), round(line.scatter, 4)


def _spacing(position: Array) -> float:
    """Return how far apart neighbouring blocks are; hidden and wrong ones leave gaps."""
    return float(np.min(np.diff(np.sort(position))))


def _reason(edge: MeasuredEdge | None, length: float, width: float) -> str:
    """Return why an edge cannot be trusted whatever its partner, "" if it can."""
    if edge is None:
        return "edge hardly visible"
    line = edge.line
    least = max(LEAST_LENGTH[0], LEAST_LENGTH[1] * width)
    visible = (line.last - line.first) * length
    if visible < least:
        return f"too short, {visible:.0f} px visible"
    if line.agreement < LEAST_AGREEMENT:
        return f"edge not straight, {100 * line.agreement:.0f} % of it on one line"
    kept = float(np.mean(line.kept))
    if kept < LEAST_KEPT:
        return f"edge hardly visible, found on {100 * kept:.0f} % of it"
    if edge.contrast < LEAST_CONTRAST:
        return f"low contrast, {edge.contrast:.1f} grey levels"
    if line.scatter > max(LARGEST_SCATTER[0], LARGEST_SCATTER[1] * edge.blur):
        return f"edge too rough, scatter {line.scatter:.2f} px"
    sigma = float(np.sqrt(np.diag(edge.covariance).max()))
    if sigma > LARGEST_SIGMA:
        return f"edge too uncertain, sigma {sigma:.2f} px"
    return ""
