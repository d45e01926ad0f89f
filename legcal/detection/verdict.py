"""The verdict on both outlines of a part: how well they were seen, and whether to use them."""

import math
from dataclasses import dataclass

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
LARGEST_SIGMA = 1.0  # [px]
STEP_END = 1.5  # depth up to which the blurred step reaches [blurs]
LEAST_STEP = 1.15  # of it that a saturated background must leave [px]
WIDTH_TOLERANCE = (0.7, 0.035)  # [px] and share of the predicted width
NEAR_TOLERANCE = (0.2, 3.0)  # the same where both are predicted well: [px], standard deviations
WRONG_WIDTH = "width inconsistent with the radius"  # the beginning of a reason
SURER = 0.75  # by which factor an outline must be surer than the edge of a shade
NEAR, NEARER = 0.5, 0.5  # of an outline that needs no partner: part of the window, of its distance
NARROW_BIAS = 0.15  # of such an outline, in what the width is too small


@dataclass(frozen=True)
class Verdict:
    """Which outlines of a part are used.

    Attributes
    ----------
    reasons : tuple of two str
        Why each outline cannot be trusted, "" if it can.
    bias : float
        How far used ones may be off besides their covariance [px].
    """

    reasons: tuple[str, str]
    bias: float = 0.0


def verdict(
    pair: Pair,
    predicted: Array,
    length: float,
    measured: tuple[MeasuredEdge | None, MeasuredEdge | None],
    window: float | None = None,
    *,
    near_fit: bool = False,
) -> Verdict:
    """Judge both edges of a part.

    Two edges vouch for each other by their distance, as they were measured or at least as they were
    found. One whose partner fails otherwise must be convincing by itself. Where they are too
    near to each other, one is where light and shade meet on the leg: a bend that is known less
    well than the other one, which is an outline.

    Parameters
    ----------
    pair : Pair
        How the edges were found.
    predicted : (2, 2) array
        Predicted offsets of edge 1 and 2 at both ends of the band [px]: their distance is the width
        of the part, by its radius.
    length : float
        Length of the band [px].
    measured : tuple of two MeasuredEdge or None
        Edge 1 and edge 2; None where no straight line fits.
    window : float or None
        How far the outlines are from there at most, where other legs vouch for it [px].
    near_fit : bool
        Whether a fit of everything has them there, so that their distance is known well.
    """
    expected = predicted[1] - predicted[0]
    width = float(np.mean(pair.v[1] - pair.v[0]))
    reasons = [
        _reason(edge, length, width) if seen else "no convincing edge"
        for edge, seen in zip(measured, pair.found, strict=True)
    ]
    one, two = measured
    if one is not None and two is not None and not any(reasons):
        by_width = _by_width(one, two, expected, near_fit=near_fit)
        reach = math.inf if near_fit else window
        if reach is None or not all(by_width.reasons):
            return by_width
        return _by_place((one, two), predicted, reach, by_width)
    vouched = pair.suits(expected)
    stands = [
        edge is not None
        and _is_clear_step(edge)
        and bool(vouched or (may if window is None else _off(edge, at) <= NEAR * window))
        for edge, may, at in zip(measured, pair.alone, predicted, strict=True)
    ]
    first, second = (
        reason or ("" if alone else f"its other outline: {partner}")
        for reason, partner, alone in zip(reasons, reasons[::-1], stands, strict=True)
    )
    return Verdict((first, second))


def _by_width(one: MeasuredEdge, two: MeasuredEdge, expected: Array, *, near_fit: bool) -> Verdict:
    """Judge two edges that may be trusted but for their distance."""
    widths = two.v - one.v
    sigma_one, sigma_two = _sigma(one), _sigma(two)
    tolerance = WIDTH_TOLERANCE[0] + WIDTH_TOLERANCE[1] * expected
    if near_fit:
        near = NEAR_TOLERANCE[0] + NEAR_TOLERANCE[1] * math.hypot(sigma_one, sigma_two)
        tolerance = np.minimum(tolerance, near)
    mismatch = np.abs(widths - expected) / tolerance
    if mismatch.max() <= 1.0:
        return Verdict(("", ""))
    i = int(np.argmax(mismatch))
    reason = f"{WRONG_WIDTH}, {widths[i]:.1f} px for {expected[i]:.1f} px"
    surer, ratio = (
        (one, sigma_one / sigma_two) if sigma_one < sigma_two else (two, sigma_two / sigma_one)
    )
    if near_fit or np.any(widths >= expected) or ratio > SURER or not _is_clear_step(surer):
        return Verdict((reason, reason))
    bias = NARROW_BIAS * float(np.abs(widths - expected).max())
    return Verdict(("", reason) if surer is one else (reason, ""), bias)


def _by_place(
    measured: tuple[MeasuredEdge, MeasuredEdge], predicted: Array, window: float, judged: Verdict
) -> Verdict:
    """Judge two edges at a wrong distance, one of which is where an outline should be."""
    off = [_off(edge, at) for edge, at in zip(measured, predicted, strict=True)]
    near = int(np.argmin(off))
    if off[near] > min(NEAR * window, NEARER * off[1 - near]) or not _is_clear_step(measured[near]):
        return judged
    return Verdict((judged.reasons[0] if near else "", "" if near else judged.reasons[1]))


def _off(edge: MeasuredEdge, predicted: Array) -> float:
    """Return how far an edge is from its prediction (2,) at the worse end [px]."""
    return float(np.abs(edge.v - predicted).max())


def _is_clear_step(edge: MeasuredEdge) -> bool:
    """Say whether an edge is a step of the picture on most of its length."""
    return edge.is_step and float(np.mean(edge.line.kept)) >= LONE_KEPT


def _sigma(edge: MeasuredEdge) -> float:
    """Return the standard deviation of an edge at its worse end [px]."""
    return float(np.sqrt(np.diag(edge.covariance).max()))


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
    step = (STEP_END - edge.clipped) * edge.blur
    if step < LEAST_STEP:
        return f"the background is overexposed, {max(step, 0.0):.1f} px of the step are left"
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
    sigma = _sigma(edge)
    if sigma > LARGEST_SIGMA:
        return f"edge too uncertain, sigma {sigma:.2f} px"
    return ""
