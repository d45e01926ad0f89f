"""The two outlines of every part of every leg in one image: found, measured, judged (3.1).

Reading order: where the parts should be and what hides them; the pair of edges; the limb model
fitted to all outlines of the image together; the verdict on each part, with the reason.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from legcal.geometry import Array, BoolArray, IntArray
from legcal.perception.limb_fit import MeasuredEdge, measure_edges
from legcal.perception.pairs import Pair, PairSearch, block_positions, find_pairs
from legcal.perception.picture import Grey
from legcal.perception.profiles import Edge
from legcal.vision import EPSILON, Band, Camera, Piece, PredictedLeg, band_of_leg, hidden_by

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


OUTSIDE = "outside the image"  # a reason
HIDDEN = "hidden by"  # the beginning of one
MARGIN = 4.0  # beside a leg in front [px]
NARROWEST = 5.0  # [px]
NARROW = 0.8  # of the width, up to which a window tells both outlines apart
NEAR_PREDICTION = 1.0  # an edge that was found to a pixel may be where it is predicted [px]


def _unknown() -> Array:
    return np.full(2, np.nan)


@dataclass(frozen=True, eq=False)
class PartOutlines:
    """Both outlines of a part in an image.

    Attributes
    ----------
    leg : int
        The leg.
    part : str
        The URDF link of the cylinder.
    h : (2, 3) array
        Unit normals h1, h2 of eq (3); NaN where nothing was found.
    ends : (2, 2, 2) array
        Both ends of both used pieces [px], the first nearer to the base joint.
    covariance : (2, 2, 2) array
        Of the normal offsets at these ends [px^2].
    reasons : tuple of two str
        Why each outline was rejected, "" if it is to be used.
    contrast, length, residual : (2,) array
        How well each was seen, as in :class:`legcal.data.outlines.Outlines` [grey levels,
        px, px]; NaN where nothing was found.
    blur : float
        Standard deviation of the blur of the image [px]; NaN if it was not measured.
    by_gamma : (2,) array
        How far each moves towards the inside with ln gamma [px]; NaN where that is not known.
    """

    leg: int
    part: str
    h: Array
    ends: Array
    covariance: Array
    reasons: tuple[str, str]
    contrast: Array = field(default_factory=_unknown)
    length: Array = field(default_factory=_unknown)
    residual: Array = field(default_factory=_unknown)
    blur: float = math.nan
    by_gamma: Array = field(default_factory=_unknown)


@dataclass(frozen=True, eq=False)
class FoundPart:
    """A part on its way: where it is predicted, and where its edges were found to a pixel.

    Attributes
    ----------
    leg, piece : PredictedLeg, Piece
        The leg and its part.
    band : Band
        The frame along the part.
    predicted : (2, 2) array
        Predicted offsets of edge 1 and 2 at both ends of the band [px].
    hidden : (n_blocks,) array of bool
        Which of the :func:`legcal.perception.pairs.block_positions` other legs hide.
    pair : Pair
        The edges.
    window : float or None
        How far the outlines are from their prediction at most, where other legs vouch for it [px].
    """

    leg: PredictedLeg
    piece: Piece
    band: Band
    predicted: Array
    hidden: BoolArray
    pair: Pair
    window: float | None = None

    @property
    def half_width(self) -> float:
        """Half of the width that the edges have in the middle [px]."""
        return float(0.5 * np.mean(self.pair.v[1] - self.pair.v[0]))

    @property
    def near(self) -> Array:
        """Offsets as predicted if an edge was found no farther than it is known, (2, 2) [px].

        One is enough: the width says where the other outline is, which shading hides.
        """
        is_near = np.abs(self.pair.v - self.predicted).max(axis=1) <= NEAR_PREDICTION
        return self.predicted if np.any(is_near & self.pair.found) else self.pair.v

    def outlines(
        self, camera: Camera, lines: Sequence[tuple[Array, Array, Array] | None]
    ) -> PartOutlines:
        """Return the outlines with these lines, not judged yet.

        Parameters
        ----------
        camera : Camera
            The camera.
        lines : sequence of two tuples or None
            Of edge 1 and edge 2: offsets (2,) at both ends of the band [px], where the used piece
            begins and ends (2,) as fractions of the band, covariance (2, 2) there [px^2].
        """
        result = _rejected(self.leg, self.piece, "")
        found = [i for i, line in enumerate(lines) if line is not None]
        if found:
            v, place, covariance = (
                np.array(x) for x in zip(*(line for line in lines if line is not None), strict=True)
            )
            offset = v[:, :1] + (v[:, 1:] - v[:, :1]) * place
            result.h[found] = self.band.line(v[:, 0], v[:, 1])
            result.ends[found] = camera.distort(self.band.points(place * self.band.length, offset))
            result.covariance[found] = covariance
        return result


def outline_parts(
    grey: Grey,
    camera: Camera,
    legs: Sequence[PredictedLeg],
    names: Sequence[str],
    wanted: BoolArray,
    window: Array,
    *,
    together: bool = True,
    blur: float | None = None,
    foretold: bool = False,
) -> list[PartOutlines]:
    """Find and measure the outlines of all parts in one image.

    Parameters
    ----------
    grey : Grey
        The image.
    camera : Camera
        Its camera.
    legs : sequence of PredictedLeg
        All legs that the image should show; also the unwanted ones hide others.
    names : sequence of str, length n_legs
        Names of the legs, for reasons.
    wanted : (n_legs,) array of bool
        The legs to look for, by their index.
    window : (n_legs,) array
        Largest distance of an outline from its prediction [px].
    together, blur
        As for :func:`legcal.perception.limb_fit.measure_edges`; with a blur that is known, outlines
        are taken to be where they are predicted, where an edge is seen there.
    foretold : bool
        Whether other legs vouch for the predictions: then one edge near its own is enough.

    Returns
    -------
    list of PartOutlines
        One for every part of every wanted leg, found or not, from base to platform.
    """
    parts, results = find_parts(grey, camera, legs, names, wanted, window, foretold=foretold)
    if parts:
        results.extend(_measure(grey, camera, parts, together, blur))
    return sorted(results, key=lambda result: result.leg)


def find_parts(
    grey: Grey,
    camera: Camera,
    legs: Sequence[PredictedLeg],
    names: Sequence[str],
    wanted: BoolArray,
    window: Array,
    *,
    foretold: bool = False,
) -> tuple[list[FoundPart], list[PartOutlines]]:
    """Find the edges of all parts in one image to about a pixel.

    Parameters
    ----------
    grey, camera, legs, names, wanted, window, foretold
        As for :func:`outline_parts`.

    Returns
    -------
    parts : list of FoundPart
        The parts to measure.
    rejected : list of PartOutlines
        The others, with the reason.
    """
    sought: list[_Sought] = []
    rejected: list[PartOutlines] = []
    for leg in legs:
        if not wanted[leg.leg]:
            continue
        for piece, h in zip(leg.pieces, leg.outlines, strict=True):
            one = _seek(camera, leg, piece, h)
            if isinstance(one, str):
                rejected.append(_rejected(leg, piece, one))
            else:
                sought.append(one)
    searches: list[PairSearch] = []
    free: list[_Sought] = []
    for one, front in zip(sought, _in_front(legs, sought), strict=True):
        hidden = np.any(front >= 0, axis=0)
        if np.mean(~hidden) * one.band.length < one.least:
            values, counts = np.unique(front[front >= 0], return_counts=True)
            why = f"{HIDDEN} {names[values[np.argmax(counts)]]}"
            rejected.append(_rejected(one.leg, one.piece, why))
            continue
        reach = float(window[one.leg.leg])
        vouched = foretold and reach <= NARROW * one.width
        free.append(one)
        searches.append(PairSearch(one.band, one.predicted, hidden, reach, vouched))
    parts: list[FoundPart] = []
    pairs = find_pairs(grey, camera, searches)
    for one, search, pair in zip(free, searches, pairs, strict=True):
        if pair is None:
            rejected.append(_rejected(one.leg, one.piece, "no convincing pair of edges"))
            continue
        near = search.window if search.foretold else None
        hidden = search.hidden
        parts.append(FoundPart(one.leg, one.piece, one.band, one.predicted, hidden, pair, near))
    return parts, rejected


@dataclass(frozen=True, eq=False)
class _Sought:
    """A part that should be in the image, as :class:`FoundPart` has it."""

    leg: PredictedLeg
    piece: Piece
    h: Array  # (2, 3) its predicted outlines
    band: Band
    predicted: Array

    @property
    def width(self) -> float:
        """Predicted width in the middle of the band [px]."""
        return float(np.mean(self.predicted[1] - self.predicted[0]))

    @property
    def least(self) -> float:
        """How much of the part must be seen [px]."""
        return max(LEAST_LENGTH[0], LEAST_LENGTH[1] * self.width)


def _seek(camera: Camera, leg: PredictedLeg, piece: Piece, h: Array) -> _Sought | str:
    """Return where a part should be, or say why it cannot be found."""
    band: Band | None = leg.band
    if len(leg.pieces) > 1:
        band = band_of_leg(camera, leg.A_camera, leg.B_camera, piece.start, piece.end)
    if band is None:
        return OUTSIDE
    one = _Sought(leg, piece, h, band, band.offsets(h[:, None, :], np.array([0.0, band.length])))
    if one.width < NARROWEST:
        return f"too narrow, {one.width:.1f} px wide"
    if band.length < one.least:
        return f"too short, {band.length:.0f} px in the image"
    return one


def _in_front(legs: Sequence[PredictedLeg], sought: Sequence[_Sought]) -> list[IntArray]:
    """Return which leg hides the outlines (2, n_blocks) of each part, -1 where they are free."""
    if not sought:
        return []
    points = []
    for one in sought:
        leg, h = one.leg, one.h
        s = leg.distance_along(one.band, block_positions(one.band))
        axis = leg.A_camera + s[:, None] * leg.u
        radius = EPSILON * (h @ leg.A_camera)
        points.append((axis - (EPSILON * radius)[:, None, None] * h[:, None]).reshape(-1, 3))
    n = [len(of_part) for of_part in points]
    own = np.repeat([one.leg.leg for one in sought], n)
    margin = np.repeat([MARGIN / one.band.scale for one in sought], n)
    front = hidden_by(legs, own, np.concatenate(points), margin)
    return [of_part.reshape(2, -1) for of_part in np.split(front, np.cumsum(n)[:-1])]


def _measure(
    grey: Grey,
    camera: Camera,
    parts: Sequence[FoundPart],
    together: bool,
    blur: float | None,
) -> list[PartOutlines]:
    """Measure and judge the outlines of parts whose edges are known to a pixel."""
    near = blur is not None
    edges = [
        Edge(part.band, v, float(epsilon), part.half_width, part.hidden)
        for part in parts
        for v, epsilon in zip(part.near if near else part.pair.v, EPSILON, strict=True)
    ]
    measured, blur = measure_edges(grey, camera, edges, together, blur)
    return [
        replace(_judge(camera, part, one, two, near=near), blur=blur)
        for part, one, two in zip(parts, measured[::2], measured[1::2], strict=True)
    ]


def _judge(
    camera: Camera,
    part: FoundPart,
    one: MeasuredEdge | None,
    two: MeasuredEdge | None,
    *,
    near: bool,
) -> PartOutlines:
    """Turn the measured edges of a part into outlines with verdicts."""
    judged = verdict(
        part.pair, part.predicted, part.band.length, (one, two), part.window, near_fit=near
    )
    lines = [
        None
        if edge is None
        else (
            edge.v,
            np.array([edge.line.first, edge.line.last]),
            edge.covariance + judged.bias**2,
        )
        for edge in (one, two)
    ]
    contrast, length, residual = np.transpose(
        [qualities(edge, part.band.length) for edge in (one, two)]
    )
    return replace(
        part.outlines(camera, lines),
        reasons=judged.reasons,
        contrast=contrast,
        length=length,
        residual=residual,
        by_gamma=np.array([math.nan if e is None else e.by_gamma for e in (one, two)]),
    )


def _rejected(leg: PredictedLeg, piece: Piece, reason: str) -> PartOutlines:
    """Return a part of which nothing was found."""
    nothing = np.full((2, 3), np.nan)
    square = np.full((2, 2, 2), np.nan)
    return PartOutlines(leg.leg, piece.link, nothing, square, square.copy(), (reason, reason))
