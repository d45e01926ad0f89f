"""Detection, measurement and judgement of the outlines of all legs in images (section 3.1).

:func:`measure_outlines` does it in all images near a placement, :func:`measure` in one: what that
should show goes in, outlines with covariance and verdict come out. Reading order: where the parts
should be and what hides them; the pair of edges; the limb model fitted to all outlines of the
image; the verdict on each part, with the reason; all images.

The two edges of a part are found to a pixel near where they are predicted (:func:`find_pairs`).
Each edge is searched by itself, as straight lines near their predictions on which many blocks
of the picture have an edge; then the pair is chosen whose distance suits the radius at
both ends. Shading inside the leg and clutter beside it make lines as well, seldom at that
distance. Where one side of a leg is as bright as what is behind it there is no pair: an edge
that no other line near its prediction rivals may stand alone.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from numpy.lib.stride_tricks import as_strided

from legcal.data.outlines import Outlines, join_outlines, no_outlines
from legcal.data.reasons import USED, Reason, Rejection
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.shapes import PlacedOccluders
from legcal.perception.placement import Placement, Search, predict_legs_and_arms
from legcal.perception.profiles import Edge, Samples
from legcal.perception.subpixel_edges import (
    FIRST_BLUR,
    LostEdge,
    MeasuredEdge,
    limb_shifts,
    measure_edges,
)
from legcal.perception.tuning import CONTRAST, EDGE_SCORE, INLIER_SHARE, RIVAL, SCATTER_PX, WIDTH_PX
from legcal.vision.camera import Camera
from legcal.vision.cylinder import EPSILON
from legcal.vision.image_file import Grey
from legcal.vision.visibility import (
    MIN_WIDTH,
    Band,
    PredictedLeg,
    Segment,
    hidden_by,
    least_length,
)
from legcal.workers import Run, in_turn

BLOCK_LENGTH = 8.0  # along the part [px]
ROWS, ROWS_NEAR = 4, 2  # of samples in a block, and where all windows are small
NEAR_WINDOW = 4  # such a window, at most [px]
MAX_BLOCKS = 80  # of a part
EDGE_MARGIN = 6  # columns beyond the search window, to judge edges [px]
MAX_LINES = 8  # near an edge
SIZES = 4  # windows are worked on together whose half widths are equal in steps of so much [px]
MAX_WINDOW = 0.05  # of the longer side of an image
MOST_VOTES = 2_000_000  # that are added at once, of a few patches
OUTER_GAP, OUTER_PART = 2, 0.5  # columns between parallel lines; and what the outer one takes
LEAST_LEFT = 1e-3  # of the score of a line
SEPARATION = 2  # columns and differences of ends up to which a line is the same as a better one
WIDTH_TOLERANCE = (1.0, 0.02)  # [px] and share of the width: one standard deviation
LONE_SCORE = 0.5  # of an edge that may stand alone
LONE_SCORE_GUIDED = 0.35  # the same near a fit to other legs
MIN_RIVAL_DISTANCE = 3.0  # from which on a line is another one, in the middle [px]
NOISE_LEVELS = 4.0  # an edge this many times as steep as the median counts half
BESIDE_WEIGHT = 0.8  # weight of an edge in the columns beside it
# An edge that was found a pixel off may be where it is predicted [px]. Found ones are off by
# multiples of half a pixel: between two of these, rounding decides nothing.
MAX_PREDICTION_ERROR = 1.25


@dataclass(frozen=True, eq=False)
class EdgePair:
    """The two edges of a part, good to about a pixel."""

    v: Array  # (2, 2) offsets of edge 1 and edge 2 at both ends of the band [px]
    found: BoolArray  # (2,) False for an edge that is put where the width of the part has it
    alone: BoolArray  # (2,) whether each edge is convincing without the other

    def suits(self, width: Array) -> bool:
        """Return whether both edges are at the distance of the part's outlines (2,) [px]."""
        off = np.abs(self.v[1] - self.v[0] - width)
        tolerance = WIDTH_TOLERANCE[0] + WIDTH_TOLERANCE[1] * width
        return bool(np.all(self.found) and np.all(off <= tolerance))


@dataclass(frozen=True, eq=False)
class LegPart:
    """A part of a leg where it is predicted in an image, and its edges once they are found."""

    leg: PredictedLeg
    segment: Segment
    band: Band  # the frame along the part
    h: Array  # (2, 3) its outlines
    predicted: Array  # (2, 2) offsets of edge 1 and 2 at both ends of the band [px]
    window: float  # largest distance of an edge from its prediction, at either end [px]
    guided: bool  # whether a fit to other legs predicts it: one edge near there is enough
    # (n_blocks,) which of the block_positions other legs hide; none before that is asked
    hidden: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    pair: EdgePair | None = None

    @property
    def width(self) -> float:
        """Predicted width in the middle [px]."""
        return 0.5 * float((self.predicted[1] - self.predicted[0]).sum())

    @property
    def edges(self) -> EdgePair:
        """The edges of a part that has been found."""
        if self.pair is None:
            raise ValueError("the edges of this part were not found")
        return self.pair

    @property
    def near(self) -> Array:
        """Offsets as predicted if an edge was found no farther than it is known, (2, 2) [px].

        One is enough: the width says where the other outline is, which shading hides.
        """
        is_near = np.abs(self.edges.v - self.predicted).max(axis=1) <= MAX_PREDICTION_ERROR
        return self.predicted if np.any(is_near & self.edges.found) else self.edges.v


def find_pairs(grey: Grey, camera: Camera, parts: Sequence[LegPart]) -> list[EdgePair | None]:
    """Find both edges of parts; None where no two edges are convincing, nor one alone."""
    if not parts:
        return []
    shift, merit, score = _edge_lines(grey, camera, parts)
    of_parts = (x.reshape(-1, 2, MAX_LINES) for x in (merit, score))
    return _pairs(parts, shift.reshape(-1, 2, *shift.shape[1:]), *of_parts)


def _pairs(
    parts: Sequence[LegPart], shift: Array, merit: Array, score: Array
) -> list[EdgePair | None]:
    """Return the two outlines of each part, of lines near them, best first.

    Shifts of lines (n_parts, 2, n_lines, 2) [px], their merits (n_parts, 2, n_lines) among lines
    beside them, and their scores, 0 of none.
    """
    predicted = np.array([part.predicted for part in parts])
    i, j, together = _best_pairs(parts, predicted, shift, merit, score)
    guided = np.array([part.guided for part in parts])
    alone = _alone(shift, merit, np.where(guided, LONE_SCORE_GUIDED, LONE_SCORE))
    best = merit[..., 0]
    edge = np.argmax(np.where(alone, best, 0.0), axis=1)
    every = np.arange(len(parts))
    rivalled = (best[every, 1 - edge] >= LONE_SCORE) & ~guided
    single = alone[every, edge] & ~rivalled  # two clear edges are not those of another distance
    of_pair = predicted + np.stack([shift[every, 0, i], shift[every, 1, j]], axis=1)
    convincing = alone & (np.stack([i, j], axis=1) == 0)
    of_single = predicted + shift[every, edge, 0][:, None]
    pairs: list[EdgePair | None] = []
    for k in every.tolist():
        if together[k]:
            pairs.append(EdgePair(of_pair[k], np.ones(2, dtype=np.bool_), convincing[k]))
        elif single[k]:
            own = np.arange(2) == edge[k]
            pairs.append(EdgePair(of_single[k], own, own))
        else:
            pairs.append(None)
    return pairs


def _best_pairs(
    parts: Sequence[LegPart], predicted: Array, shift: Array, merit: Array, score: Array
) -> tuple[IntArray, IntArray, BoolArray]:
    """Return the best pair of lines near both edges of each part, and whether it is convincing."""
    one, two = shift[:, 0, :, None], shift[:, 1, None]
    width = (predicted[:, 1] - predicted[:, 0])[:, None, None]
    window = np.array([part.window for part in parts])[:, None, None, None]
    mismatch = ((two - one) / (WIDTH_TOLERANCE[0] + WIDTH_TOLERANCE[1] * width)) ** 2
    drift = ((0.5 / window) * (one + two)) ** 2
    scores = merit[:, 0, :, None], merit[:, 1, None]
    value = scores[0] + scores[1] - 0.05 * (mismatch + drift).sum(axis=-1)
    good = (mismatch.max(axis=-1) <= 9.0) & (scores[0] > 0.0) & (scores[1] > 0.0)
    value[~good] = -np.inf
    best = value.reshape(len(parts), -1).argmax(axis=1)
    i, j = np.divmod(best, score.shape[2])
    every = np.arange(len(parts))
    weaker = np.minimum(score[every, 0, i], score[every, 1, j])
    return i, j, good[every, i, j] & (weaker >= EDGE_SCORE)


def _alone(shift: Array, score: Array, least: Array) -> BoolArray:
    """Return whether the best line near each edge (n_parts, 2) is good enough without rivals."""
    middle = shift.sum(axis=-1)
    other = np.abs(middle - middle[..., :1]) > 2.0 * MIN_RIVAL_DISTANCE  # sums of both ends
    best = score[..., 0]
    rivalled = np.any(other & (score > RIVAL * best[..., None]), axis=-1)
    return np.asarray((best >= least[:, None]) & (best > 0.0) & ~rivalled)


def block_positions(band: Band) -> Array:
    """Return the positions t of the blocks of a band [px]."""
    n = min(max(int(band.length // BLOCK_LENGTH), 4), MAX_BLOCKS)
    return np.asarray((np.arange(n) + 0.5) * (band.length / n))


def _edge_lines(grey: Grey, camera: Camera, parts: Sequence[LegPart]) -> tuple[Array, Array, Array]:
    """Return lines near both edges of each part, best first: shifts at both ends, merits, scores.

    Shifts (2 n_parts, MAX_LINES, 2) [px]; merits and scores (2 n_parts, MAX_LINES), 0 of none.
    """
    halves = np.repeat([int(np.ceil(part.window)) for part in parts], 2)
    reach = int(halves.max()) + EDGE_MARGIN
    n_rows = ROWS if halves.max() > NEAR_WINDOW else ROWS_NEAR
    n_blocks = np.repeat([len(part.hidden) for part in parts], 2)
    bounds = np.concatenate([[0], np.cumsum(n_blocks)])
    edge = np.repeat(np.arange(len(n_blocks)), n_blocks)
    hidden = np.concatenate([part.hidden for part in parts for _ in range(2)])
    nodes = camera.distort(_node_points(parts, n_blocks, float(reach)))
    # Between nodes, and near an edge, the lens moves pixels in proportion to their distance.
    begin = np.arange(bounds[-1]) + edge
    row = (np.arange(n_rows) + 0.5)[:, None, None] / n_rows
    start = nodes[begin, None]
    pixels = start + row * (nodes[begin + 1, None] - start)
    share = np.linspace(0.0, 1.0, 2 * reach + 1, dtype=np.float32)
    first, change = (
        x.reshape(-1, 2).astype(np.float32)
        for x in (pixels[:, :, 0], pixels[:, :, 1] - pixels[:, :, 0])
    )
    x, y = (first[:, k : k + 1] + change[:, k : k + 1] * share for k in (0, 1))
    values = cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    seen = np.repeat(~hidden[:, None], len(share), axis=1)
    last = np.array([camera.width, camera.height]) - 1.5
    partly = np.any((pixels < 0.5) | (pixels > last), axis=(1, 2, 3))
    if partly.any():
        x, y = (one.reshape(-1, n_rows, len(share))[partly] for one in (x, y))
        inside = (x >= 0.5) & (x <= camera.width - 1.5) & (y >= 0.5) & (y <= camera.height - 1.5)
        seen[partly] &= inside.all(axis=1)
    by_row = np.asarray(values, dtype=np.float32).reshape(-1, n_rows, len(share))
    profiles = by_row[:, 0].copy()
    for k in range(1, n_rows):
        profiles += by_row[:, k]
    profiles *= np.float32(1.0 / n_rows)
    votes = _sharpness(profiles, seen, n_blocks) * seen
    n_seen = np.add.reduceat(seen.any(axis=1).astype(np.float32), bounds[:-1])
    votes /= np.maximum(n_seen, np.float32(1.0))[edge, None]
    return _lines(votes[:, EDGE_MARGIN:-EDGE_MARGIN], n_blocks, halves)


def _node_points(parts: Sequence[LegPart], n_blocks: IntArray, reach: float) -> Array:
    """Return points (n, 2, 2) of the sensor plane at the ends of blocks, on both sides of edges."""
    bands = [part.band for part in parts]
    of_part = np.array(
        [(*b.origin, *(b.along * (b.length / b.scale)), *(b.normal / b.scale)) for b in bands]
    ).reshape(-1, 3, 2)
    predicted = np.array([part.predicted for part in parts]).reshape(-1, 2)
    n = n_blocks + 1
    edge = np.repeat(np.arange(len(n)), n)
    node = (np.arange(len(edge)) - np.repeat(np.cumsum(n) - n, n)) / n_blocks[edge]
    v = predicted[edge, 0] + (predicted[edge, 1] - predicted[edge, 0]) * node
    origin, along, normal = of_part[edge // 2].swapaxes(0, 1)
    middle = origin + node[:, None] * along + v[:, None] * normal
    side = reach * normal
    return np.stack([middle - side, middle + side], axis=1)


def _sharpness(profiles: Samples, seen: BoolArray, n_blocks: IntArray) -> Samples:
    """Return the edge score of each column of profiles (n, n_columns), 0 to 1.

    The maxima of the smoothed gradient along each profile against the median of its patch, widened
    by one column to each side, where they count less. ``n_blocks`` are those of each patch.
    """
    smooth = cv2.GaussianBlur(profiles, (5, 1), 0.8)
    gradient = np.zeros_like(profiles)
    gradient[:, 1:-1] = np.abs(smooth[:, 2:] - smooth[:, :-2]) * (seen[:, 2:] & seen[:, :-2])
    beside = np.ones((1, 3), dtype=np.uint8)
    wide = np.asarray(cv2.dilate(gradient, beside), dtype=np.float32)
    peak = np.where(gradient >= wide, gradient, np.float32(0.0)) ** 2
    bounds = np.concatenate([[0], np.cumsum(n_blocks)]).tolist()
    typical = np.array([_median(gradient[i:j], seen[i:j]) for i, j in pairwise(bounds)])
    level = np.repeat((NOISE_LEVELS * typical) ** 2 + 1e-3, n_blocks).astype(np.float32)
    sharpness = peak / (peak + level[:, None])
    widened = np.asarray(cv2.dilate(sharpness, beside), dtype=np.float32)
    return np.asarray(np.maximum(sharpness, np.float32(BESIDE_WEIGHT) * widened), dtype=np.float32)


def _median(values: Samples, seen: BoolArray) -> float:
    """Return the middle value that is seen, the upper one of two; 0 of none."""
    some = values.ravel() if seen.all() else values[seen]
    middle = len(some) // 2
    return float(np.partition(some, middle)[middle]) if len(some) else 0.0


def _lines(votes: Samples, n_blocks: IntArray, halves: IntArray) -> tuple[Array, Array, Array]:
    """Add the votes of patches along lines; return their separate maxima.

    Votes (n, 2 max(halves) + 1) of all blocks, those in the middle count; shifts (n_patches,
    MAX_LINES, 2), merits and scores (n_patches, MAX_LINES), best first, 0 of none.
    """
    most, n = int(halves.max()), len(n_blocks)
    side, middle = 2 * (most + SEPARATION) + 1, most + SEPARATION
    score = np.zeros((n, side, side), dtype=np.float32)
    sizes = np.minimum(SIZES * -(-halves // SIZES), most)
    first = np.cumsum(n_blocks) - n_blocks
    for half in np.unique(sizes).tolist():
        inner = slice(middle - half, middle + half + 1)
        alike = np.flatnonzero(sizes == half)
        n_together = max(1, MOST_VOTES // (int(n_blocks.max()) * (2 * half + 1) ** 2))
        for k in range(0, len(alike), n_together):
            own = alike[k : k + n_together]
            rows = np.concatenate([np.arange(first[e], first[e] + n_blocks[e]) for e in own])
            of_own = votes[rows, most - half : most + half + 1]
            score[own, inner, inner] = _added(of_own, n_blocks[own], halves[own], half)
    merit = score.copy()
    _mark_down_inner(merit)
    flat, every = merit.reshape(n, -1), np.arange(n)
    around = np.arange(-SEPARATION, SEPARATION + 1)
    around = (around[:, None] * side + around).ravel()
    at, best = np.zeros((MAX_LINES, n), dtype=np.intp), np.zeros((MAX_LINES, n))
    for line in range(MAX_LINES):
        at[line] = flat.argmax(axis=1)
        best[line] = flat[every, at[line]]
        flat[every[:, None], at[line, :, None] + around] = 0.0  # of none: at the border
    tilt, place = np.divmod(at.T, side)
    change, place = 0.5 * (tilt - middle), place - middle
    shifts = np.stack([place - change, place + change], axis=-1)
    of_lines = np.where(best.T > 0.0, score.reshape(n, -1)[every[:, None], at.T], 0.0)
    return np.where(best.T[..., None] > 0.0, shifts, 0.0), best.T, of_lines


def _mark_down_inner(score: Samples) -> None:
    """Take from scores (n_patches, tilts, middles) of lines what parallel ones further out have.

    A rod reflects the room in stripes along it, and nothing behind it runs along it for long: of
    several parallel lines the outermost is the limb. Patches alternate between edges 1 and 2.
    """
    wide = score.copy()
    np.maximum(wide[:, 1:], score[:, :-1], out=wide[:, 1:])
    np.maximum(wide[:, :-1], score[:, 1:], out=wide[:, :-1])
    for first, outwards in ((0, 1), (1, -1)):  # edge 1 is outermost where places are least
        of_edge, lines = score[first::2, :, ::outwards], wide[first::2, :, ::outwards]
        further_out = np.maximum.accumulate(lines, axis=2)[:, :, :-OUTER_GAP]
        inner = of_edge[:, :, OUTER_GAP:]
        left = np.maximum(inner - OUTER_PART * further_out, LEAST_LEFT * inner)
        of_edge[:, :, OUTER_GAP:] = left


def _added(votes: Samples, n_blocks: IntArray, halves: IntArray, half: int) -> Samples:
    """Return votes (n, 2 half + 1) added along lines, by the difference of their ends and middles.

    (n_patches, 2 half + 1, 2 half + 1), 0 beyond the half width of each patch, as are votes.
    """
    n_columns, reach = 2 * half + 1, half // 2 + 1
    within = np.abs(np.arange(-half, half + 1)) <= halves[:, None]
    padded = np.zeros((len(votes), n_columns + 2 * reach), dtype=np.float32)
    np.multiply(votes, np.repeat(within, n_blocks, axis=0), out=padded[:, reach:-reach])
    columns = np.concatenate([_columns(n, half) for n in n_blocks.tolist()])
    begin = columns + (np.arange(len(votes)) * padded.shape[1])[:, None]
    shape = padded.size - n_columns + 1, n_columns
    windows = as_strided(padded, shape, 2 * padded.strides[1:], writeable=False)
    along = windows[begin]  # (n, tilts, middles)
    added = np.add.reduceat(along, np.cumsum(n_blocks) - n_blocks, axis=0)
    added *= within[:, :, None] & within[:, None, :]
    return np.asarray(added, dtype=np.float32)


@lru_cache(maxsize=512)
def _columns(n_blocks: int, half: int) -> IntArray:
    """Return the first offset of lines that counts in each block, by the difference of their ends.

    (n_blocks, 2 half + 1) columns of votes with half // 2 + 1 more on each side.
    """
    position = (np.arange(n_blocks) + 0.5) / n_blocks - 0.5
    columns = np.rint(position[:, None] * np.arange(-half, half + 1)).astype(np.intp)
    columns += half // 2 + 1
    columns.setflags(write=False)
    return columns


MARGIN = 4.0  # beside a leg in front, within which it hides others [px]
MAX_GUIDED_WINDOW = 0.8  # widest window that still separates both outlines, as a part of the width
MIN_KEPT = 0.25  # share of all unhidden blocks that must lie on the line of an outline
MIN_CLEAR_KEPT = 0.5  # the same of an outline without its partner
SCATTER_BLURS = 1.2  # largest scatter of the blocks of an edge [blurs], at least SCATTER_PX
MAX_SIGMA = 1.0  # largest standard deviation of an outline [px]
STEP_END = 1.5  # depth up to which the blurred step reaches [blurs]
MIN_STEP = 1.15  # part of the step that a saturated background must leave [px]
# Of two outlines that are predicted well, from the predicted width: [px], standard deviations
NEAR_WIDTH_PX, NEAR_WIDTH_SIGMAS = 0.2, 3.0
MAX_SIGMA_RATIO = 0.75  # largest ratio of sigma of an outline to sigma of the edge of a shade
# How far a lone outline may be from its prediction: of the window, of its partner's distance
LONE_OFFSET, LONE_RATIO = 0.5, 0.5
WIDTH_PART = 0.035  # tolerance of widths besides WIDTH_PX, as a part of the predicted width
SLACK = 0.5  # radii by which a solid before an outline is nearer; others are the part as drawn
NEAR_DOUBT = (0.6, 1.0)  # tolerances at which outlines near a fit count less, and not at all
SKEW = 0.09  # tangent of the angle, 5 deg, at which the edge of a solid passes for an outline
LEAST_DOUBTED = 0.05  # least root of the weight of an outline that is used
NARROW_BIAS = 0.15  # bias of the better of two outlines, as a part of what their width lacks


@dataclass(frozen=True, eq=False)
class ImageSearch:
    """An image, the legs that it should show, and the search window around each."""

    row: int
    grey: Grey
    camera: Camera
    legs: Sequence[PredictedLeg]  # all that it should show: also those not looked for hide others
    names: Sequence[str]  # names of all legs, for reasons
    window: Array  # (n_legs,) largest distance from a prediction [px]; NaN: not looked for
    guided: bool = False  # whether a fit to other legs predicts them: one edge is enough
    blur: float | None = None  # as other images show it, or roughly [px]
    near_fit: bool = False  # whether outlines are known to tenths of a pixel, and the blur as well
    # The legs of which arms are parts: they follow the legs, and no fit knows their widths
    arms: tuple[int, ...] = ()
    occluders: PlacedOccluders = field(default_factory=PlacedOccluders.none)  # in its frame
    polished: frozenset[tuple[int, str]] = frozenset()  # legs and parts with polished surfaces

    @property
    def n_legs(self) -> int:
        """Number of legs, arms left out."""
        return len(self.names) - len(self.arms)

    def leg_of(self, index: int) -> int:
        """Return the leg of a predicted leg or arm."""
        return index if index < self.n_legs else self.arms[index - self.n_legs]


class PartVerdict(NamedTuple):
    """Which outlines of a part are used."""

    reasons: tuple[Rejection, Rejection]  # why each outline cannot be trusted
    bias: float = 0.0  # how far used ones may be off besides their covariance [px]
    weight: float = 1.0  # of used ones, whose covariance is larger by its inverse


class JudgedPart(NamedTuple):
    """Both outlines of a part of a leg as the table has them."""

    leg: int
    part: str
    verdict: PartVerdict
    edges: Sequence[MeasuredEdge | LostEdge] = ()  # none where it was not measured
    band: Band | None = None  # their frame


def measure(search: ImageSearch, *, in_brief: bool = False) -> tuple[Outlines, float]:
    """Find, measure and judge the outlines of all parts in one image; return its blur too [px].

    Two outlines for every part of every leg that is looked for, found or not. In brief, in half the
    time, blocks are fitted alone: to a few hundredths of a pixel.
    """
    parts, lines = find_parts(search)
    blur = math.nan
    if parts:
        near = search.near_fit
        edges = [
            Edge(
                part.band,
                v,
                float(epsilon),
                0.5 * float(np.mean(pair[1] - pair[0])),
                part.hidden,
                (search.leg_of(part.leg.leg), part.segment.link) in search.polished,
            )
            for part in parts
            for pair in [part.near if near else part.edges.v]
            for v, epsilon in zip(pair, EPSILON, strict=True)
        ]
        parts, edges = _at_limbs(search, parts, edges)
        measured, blur = measure_edges(
            search.grey, search.camera, edges, search.blur, near_fit=near, in_brief=in_brief
        )
        for part, first, second in zip(parts, measured[::2], measured[1::2], strict=True):
            of_leg = near and part.leg.leg < search.n_legs
            reach = part.window if part.guided else None
            pair, band = (first, second), part.band
            judged = verdict(part.edges, part.predicted, band.length, pair, reach, near_fit=of_leg)
            lines.append(JudgedPart(part.leg.leg, part.segment.link, judged, pair, band))
    return outline_table(search, lines), blur


def _at_limbs(
    search: ImageSearch, parts: list[LegPart], edges: list[Edge]
) -> tuple[list[LegPart], list[Edge]]:
    """Return parts and edges with those of polished parts at their limbs, not at stripes."""
    polished = [i for i, one in enumerate(edges[::2]) if one.polished]
    if not polished:
        return parts, edges
    polished_edges = [edge for i in polished for edge in edges[2 * i : 2 * i + 2]]
    apart = np.array(
        [
            np.mean(two.v - one.v)
            for one, two in zip(polished_edges[::2], polished_edges[1::2], strict=True)
        ]
    )
    width = np.array([np.mean(parts[i].predicted[1] - parts[i].predicted[0]) for i in polished])
    sigma = WIDTH_TOLERANCE[0] + WIDTH_TOLERANCE[1] * width
    blur = FIRST_BLUR if search.blur is None else search.blur
    inside = limb_shifts(search.grey, search.camera, polished_edges, blur, apart - width, sigma)
    parts, edges = list(parts), list(edges)
    for i, shift in zip(polished, inside.reshape(-1, 2), strict=True):
        if not shift.any():
            continue
        pair = edges[2 * i : 2 * i + 2]
        v = np.array([e.v + e.epsilon * s for e, s in zip(pair, shift.tolist(), strict=True)])
        half_width = 0.5 * float(np.mean(v[1] - v[0]))
        edges[2 * i : 2 * i + 2] = [
            replace(e, v=own_v, half_width=half_width) for e, own_v in zip(pair, v, strict=True)
        ]
        parts[i] = replace(parts[i], pair=replace(parts[i].edges, v=v))
    return parts, edges


def used_as_before(outlines: Outlines, before: Outlines) -> Outlines:
    """Return outlines that are used as the same ones were before, if they are seen at all.

    Of the same images, measured with another gamma: it moves both edges of a part inwards or
    outwards, so that widths differ from those of a fit with the gamma before.
    """
    was = before.used_keys()
    seen = outlines.used | outlines.rejected_for(Reason.WIDTH)
    seen &= np.isfinite(outlines.covariance[:, 0, 0])
    used = seen & np.array([key in was for key in outlines.row_keys()], dtype=np.bool_)
    reason = tuple(
        USED if is_used else why or Rejection(Reason.NOT_BEFORE)
        for is_used, why in zip(used.tolist(), outlines.reason, strict=True)
    )
    return replace(outlines, used=used, reason=reason)


def find_parts(search: ImageSearch) -> tuple[list[LegPart], list[JudgedPart]]:
    """Find the edges of all parts in one image to about a pixel.

    Return the parts to measure, and the others with the reasons why their outlines are rejected.
    """
    rejected: list[JudgedPart] = []

    def reject(leg: PredictedLeg, part: str, reason: Reason, detail: str = "") -> None:
        why = Rejection(reason, detail)
        rejected.append(JudgedPart(leg.leg, part, PartVerdict((why, why))))

    searched: list[LegPart] = []
    for leg in search.legs:
        if math.isnan(search.window[leg.leg]):
            continue
        for segment, band, h in zip(leg.segments, leg.bands, leg.outlines, strict=True):
            if band is None:
                reject(leg, segment.link, Reason.OUTSIDE)
                continue
            v = band.offsets(h[:, None, :], np.array([0.0, band.length]))
            window = float(search.window[leg.leg])
            part = LegPart(leg, segment, band, h, v, window, search.guided)
            if part.width < MIN_WIDTH:
                reject(leg, segment.link, Reason.NARROW, f"{part.width:.1f}")
            elif band.length < least_length(part.width):
                reject(leg, segment.link, Reason.SHORT, f"{band.length:.0f} px in the image")
            else:
                guided = search.guided and window <= MAX_GUIDED_WINDOW * part.width
                searched.append(replace(part, guided=guided))
    free_parts: list[LegPart] = []
    names = [*search.names, *(occluder.link for occluder in search.occluders.occluders)]
    for part, front in zip(searched, _in_front(search, searched), strict=True):
        hidden = np.any(front >= 0, axis=0)
        if np.mean(~hidden) * part.band.length < least_length(part.width):
            values, counts = np.unique(front[front >= 0], return_counts=True)
            in_front = names[values[np.argmax(counts)]]
            reject(part.leg, part.segment.link, Reason.HIDDEN, in_front)
        else:
            free_parts.append(replace(part, hidden=hidden))
    parts: list[LegPart] = []
    pairs = find_pairs(search.grey, search.camera, free_parts)
    for part, pair in zip(free_parts, pairs, strict=True):
        if pair is None:
            reject(part.leg, part.segment.link, Reason.NO_PAIR)
        else:
            parts.append(replace(part, pair=pair))
    return parts, rejected


def outline_table(search: ImageSearch, parts: Sequence[JudgedPart]) -> Outlines:
    """Return both outlines of all parts of an image, NaN where there is no line."""
    parts = [part._replace(leg=search.leg_of(part.leg)) for part in parts]
    parts.sort(key=lambda part: (part.leg, part.part))
    n = 2 * len(parts)
    h, ends, quality = np.full((n, 3), np.nan), np.full((n, 2, 2), np.nan), np.full((n, 5), np.nan)
    covariance = np.full((n, 2, 2), np.nan)
    seen = [
        (2 * i + k, part.band, edge, part.verdict)
        for i, part in enumerate(parts)
        for k, edge in enumerate(part.edges)
        if part.band is not None and isinstance(edge, MeasuredEdge)
    ]
    if seen:
        at, bands, edges, verdicts = zip(*seen, strict=True)
        has = list(at)
        v, place = (
            np.array(x)
            for x in zip(*((e.v, (e.line.first, e.line.last)) for e in edges), strict=True)
        )
        covariance[has] = [
            edge.covariance / judged.weight + judged.bias**2
            for edge, judged in zip(edges, verdicts, strict=True)
        ]
        quality[has] = [_quality(e, band.length) for e, band in zip(edges, bands, strict=True)]
        origin, along, normal = (
            np.array(x) for x in zip(*((b.origin, b.along, b.normal) for b in bands), strict=True)
        )
        scale, length = np.array([(b.scale, b.length) for b in bands]).T[..., None]
        first = origin + v[:, :1] * normal / scale
        step = (length * along + (v[:, 1:] - v[:, :1]) * normal) / scale
        ray, x, y = first[:, 0] * step[:, 1] - first[:, 1] * step[:, 0], step[:, 0], step[:, 1]
        of_lines = (
            np.stack([-y, x, ray], axis=1) * np.sign(x * normal[:, 1] - y * normal[:, 0])[:, None]
        )
        h[has] = of_lines / np.linalg.norm(of_lines, axis=1, keepdims=True)
        xy = first[:, None] + place[..., None] * step[:, None]
        ends[has] = search.camera.distort(xy)
    gamma = np.where(np.isnan(quality[:, 3]), np.nan, search.camera.gamma)
    reasons = tuple(reason for part in parts for reason in part.verdict.reasons)
    return Outlines(
        row=np.full(n, search.row, dtype=np.intp),
        leg=np.repeat(np.array([part.leg for part in parts], dtype=np.intp), 2),
        part=tuple(part.part for part in parts for _ in EPSILON),
        edge=np.tile(np.array([1, 2], dtype=np.intp), len(parts)),
        h=h,
        ends=ends,
        covariance=covariance,
        used=np.array([not reason for reason in reasons], dtype=np.bool_),
        reason=reasons,
        source=("detected",) * n,
        contrast=quality[:, 0],
        length=quality[:, 1],
        residual=quality[:, 2],
        gamma=gamma,
        by_gamma=quality[:, 3],
        polish=quality[:, 4],
    )


def _in_front(search: ImageSearch, searched: Sequence[LegPart]) -> list[IntArray]:
    """Return which leg hides the outlines (2, n_blocks) of each part, -1 where they are free.

    Other solids of the machine count on from the legs and arms. Where the edge of one goes along
    most of an outline, within the window, it would be taken for it: that part counts as hidden.
    """
    if not searched:
        return []
    points = []
    for part in searched:
        leg, h = part.leg, part.h
        s = leg.distance_along(part.band, block_positions(part.band))
        axis = leg.A_camera + s[:, None] * leg.u
        radius = EPSILON * (h @ leg.A_camera)
        points.append((axis - (EPSILON * radius)[:, None, None] * h[:, None]).reshape(-1, 3))
    n = [len(of_part) for of_part in points]
    number = np.repeat([part.leg.leg for part in searched], n)
    margin = np.repeat([MARGIN / part.band.scale for part in searched], n)
    P_camera = np.concatenate(points)
    front = hidden_by(search.legs, number, P_camera, margin)
    if len(search.occluders):
        reach = margin * np.linalg.norm(P_camera, axis=1)
        along = np.where(number < search.n_legs, number, -1)
        before = SLACK * np.repeat([part.segment.radius for part in searched], n)
        solid = search.occluders.hide(P_camera, along, reach, before)
        front = np.where(solid >= 0, len(search.names) + solid, front)
    hiding = [of_part.reshape(2, -1) for of_part in np.split(front, np.cumsum(n)[:-1])]
    for i, occluder in enumerate(search.occluders.occluders):
        edges = search.occluders.silhouette(i)
        for part, of_part in zip(searched, hiding, strict=True):
            if part.leg.leg == occluder.leg or not len(edges):
                continue
            free = of_part < 0
            beside = _beside(part, edges, float(search.window[part.leg.leg])) & free
            if np.any(2 * beside.sum(axis=1) > free.sum(axis=1)):
                of_part[free] = len(search.names) + i
    return hiding


def _beside(part: LegPart, edges: Array, window: float) -> BoolArray:
    """Return which blocks (2, n_blocks) of a part have an edge of a solid near an outline.

    It is one of the edges (n, 2, 2) on the sensor plane that are as good as parallel to the part
    and within the window, where an outline cannot be told from it.
    """
    at = block_positions(part.band)
    v0, v1 = part.predicted[:, :1], part.predicted[:, 1:]
    outlines = v0 + (v1 - v0) * at / part.band.length
    t, v = part.band.coordinates(edges)
    along, across = np.diff(t, axis=1), np.diff(v, axis=1)  # (n, 1)
    is_parallel = np.abs(across) < SKEW * np.abs(along)
    share = (at - t[:, :1]) / np.where(is_parallel, along, 1.0)
    is_there = is_parallel & (share > 0.0) & (share < 1.0)
    offset = v[:, :1] + share * across - outlines[:, None]
    return np.asarray(np.any(is_there & (np.abs(offset) < window), axis=1))


def _quality(edge: MeasuredEdge, length: float) -> tuple[float, ...]:
    """Return contrast, length, residual, by_gamma and polish of Outlines; a band's length [px]."""
    line = edge.line
    position = sorted(line.position.tolist())
    # Hidden and wrong blocks leave gaps between the others.
    spacing = min(after - before for before, after in pairwise(position))
    visible = (len(position) - 1) * spacing * length
    return (
        round(edge.contrast, 2), round(visible, 1), round(line.scatter, 4),
        edge.by_gamma, round(edge.polish, 2),
    )  # fmt: skip


def verdict(
    pair: EdgePair,
    predicted: Array,
    length: float,
    measured: tuple[MeasuredEdge | LostEdge, MeasuredEdge | LostEdge],
    window: float | None = None,
    *,
    near_fit: bool = False,
) -> PartVerdict:
    """Judge both edges of a part, predicted at offsets (2, 2) [px] of a band of a length [px].

    Two edges confirm each other by their distance, as they were measured or at least as they were
    found. One whose partner fails otherwise must be convincing by itself. Where they are too
    near to each other, one is where light and shade meet on the leg: a bend that is known less
    well than the other one, which is an outline. ``window`` is how far outlines are from their
    predictions at most, where a fit to other legs predicts these [px]; ``near_fit`` that a joint
    fit has them there, so that their distance is known well.
    """
    expected = predicted[1] - predicted[0]
    width = float(np.mean(pair.v[1] - pair.v[0]))
    reasons = [
        _rejection(edge, length, width) if seen else Rejection(Reason.NO_EDGE)
        for edge, seen in zip(measured, pair.found, strict=True)
    ]
    first_edge, second_edge = measured
    if (
        isinstance(first_edge, MeasuredEdge)
        and isinstance(second_edge, MeasuredEdge)
        and not any(reasons)
    ):
        by_width = _by_width(first_edge, second_edge, expected, near_fit=near_fit)
        reach = math.inf if near_fit else window
        if reach is None or not all(by_width.reasons):
            return by_width
        measured = (first_edge, second_edge)
        off = [_off(edge, at) for edge, at in zip(measured, predicted, strict=True)]
        near = int(np.argmin(off))
        most = min(LONE_OFFSET * reach, LONE_RATIO * off[1 - near])
        if off[near] > most or not _is_clear_step(measured[near]):
            return by_width
        return PartVerdict(
            (by_width.reasons[0] if near else USED, USED if near else by_width.reasons[1])
        )
    confirmed = pair.suits(expected)
    stands = [
        isinstance(edge, MeasuredEdge)
        and _is_clear_step(edge)
        and bool(confirmed or (may if window is None else _off(edge, at) <= LONE_OFFSET * window))
        for edge, may, at in zip(measured, pair.alone, predicted, strict=True)
    ]
    first, second = (
        reason or (USED if alone else Rejection(Reason.PARTNER, partner.reason))
        for reason, partner, alone in zip(reasons, reasons[::-1], stands, strict=True)
    )
    return PartVerdict((first, second))


def _by_width(
    first: MeasuredEdge, second: MeasuredEdge, expected: Array, *, near_fit: bool
) -> PartVerdict:
    """Judge two edges that may be trusted but for their distance."""
    widths = second.v - first.v
    first_sigma, second_sigma = first.sigma, second.sigma
    tolerance = WIDTH_PX + WIDTH_PART * expected
    if near_fit:  # both are predicted well
        near = NEAR_WIDTH_PX + NEAR_WIDTH_SIGMAS * math.hypot(first_sigma, second_sigma)
        tolerance = np.minimum(tolerance, near)
    mismatch = np.abs(widths - expected) / tolerance
    if near_fit:
        # A width near its limit may be within it by another fit: weights change with it smoothly.
        begin, end = NEAR_DOUBT
        share = float((end - mismatch.max()) / (end - begin))
        if share > LEAST_DOUBTED:
            return PartVerdict((USED, USED), weight=min(share, 1.0) ** 2)
    elif mismatch.max() <= 1.0:
        return PartVerdict((USED, USED))
    i = int(np.argmax(mismatch))
    reason = Rejection(Reason.WIDTH, f"{widths[i]:.1f} px for {expected[i]:.1f} px")
    better, ratio = (
        (first, first_sigma / second_sigma)
        if first_sigma < second_sigma
        else (second, second_sigma / first_sigma)
    )
    if (
        near_fit
        or np.any(widths >= expected)
        or ratio > MAX_SIGMA_RATIO
        or not _is_clear_step(better)
    ):
        return PartVerdict((reason, reason))
    bias = NARROW_BIAS * float(np.abs(widths - expected).max())
    return PartVerdict((USED, reason) if better is first else (reason, USED), bias)


def _off(edge: MeasuredEdge, predicted: Array) -> float:
    """Return how far an edge is from its prediction (2,) at the worse end [px]."""
    return float(np.abs(edge.v - predicted).max())


def _is_clear_step(edge: MeasuredEdge) -> bool:
    """Say whether an edge is a step of the picture on most of its length."""
    return edge.is_step and float(np.mean(edge.line.kept)) >= MIN_CLEAR_KEPT


def _rejection(edge: MeasuredEdge | LostEdge, length: float, width: float) -> Rejection:
    """Return why an edge cannot be trusted whatever its partner."""
    step = (STEP_END - edge.clipped) * edge.blur
    if step < MIN_STEP:
        return Rejection(Reason.OVEREXPOSED, f"{max(step, 0.0):.1f}")
    if isinstance(edge, LostEdge):
        return Rejection(Reason.FAINT)
    line = edge.line
    visible = (line.last - line.first) * length
    if visible < least_length(width):
        return Rejection(Reason.SHORT, f"{visible:.0f} px visible")
    if line.inlier_share < INLIER_SHARE:
        return Rejection(Reason.NOT_STRAIGHT, f"{100 * line.inlier_share:.0f}")
    kept = float(np.mean(line.kept))
    if kept < MIN_KEPT:
        return Rejection(Reason.FAINT, f"{100 * kept:.0f}")
    if edge.contrast < CONTRAST:
        return Rejection(Reason.CONTRAST, f"{edge.contrast:.1f}")
    if line.scatter > max(SCATTER_PX, SCATTER_BLURS * edge.blur):
        return Rejection(Reason.ROUGH, f"{line.scatter:.2f}")
    sigma = edge.sigma
    if sigma > MAX_SIGMA:
        return Rejection(Reason.UNCERTAIN, f"{sigma:.2f}")
    return USED


def measure_outlines(
    search: Search,
    placement: Placement,
    rows: Sequence[int],
    *,
    in_brief: bool = False,
    run: Run = in_turn,
    progress: Callable[[int], None] | None = None,
) -> tuple[Outlines, Array]:
    """Find and measure the outlines of all legs in the images of rows, near a placement.

    Two outlines for each part of each leg that is looked for, by row; what was not found or cannot
    be trusted is rejected with the reason. And the blur (n_rows,) of all images [px], NaN where
    none was measured. ``progress`` is called with each row that has been searched.
    """
    if placement.window is not None:
        rows = [row for row in rows if not np.isnan(placement.window[row]).all()]
    search = replace(search, edge_pairs={}, still={})  # of no use to worker processes
    blur, tables = np.full(search.measurements.n_rows, np.nan), []
    task = partial(_of_image, search, placement, in_brief)
    for row, (outlines, blur[row]) in zip(rows, run(task, rows), strict=True):
        tables.append(outlines)
        if progress is not None:
            progress(row)
    return join_outlines(tables), blur


def _of_image(
    search: Search, placement: Placement, in_brief: bool, row: int
) -> tuple[Outlines, float]:
    """Find and measure the outlines of all wanted legs of an image; return its blur too [px]."""
    view = int(search.measurements.view[row])
    camera, T = search.measurements.views[view].camera, placement.T_base_camera[view]
    window = np.where(search.wanted[view], 0.0, np.nan)
    if placement.window is not None:
        window += placement.window[row]
    wanted = [leg for leg in np.flatnonzero(~np.isnan(window)).tolist() if search.cylinders[leg]]
    predicted: list[PredictedLeg] = []
    arms, occluders = placement.arms, PlacedOccluders.none()
    if T is not None:
        ends = placement.A_base, placement.B_base
        predicted = predict_legs_and_arms(camera, T, ends, search.cylinders, arms, row)
        here = (of_rows[row : row + 1] for of_rows in ends)
        (occluders,) = PlacedOccluders.at(search.occluders, *here)
        occluders = occluders.before(T.as_matrix())
    window = np.concatenate([window, window[list(arms)]])
    if placement.window is None:
        error = np.broadcast_to(placement.joint_error, search.wanted.shape)[view]
        error = np.concatenate([error, [arm.error for arm in arms.values()]])
        for leg in predicted:
            joint_error = search.size * error[leg.leg]
            depths = leg.A_camera[2], leg.B_camera[2]
            length = float(np.linalg.norm(leg.B_camera - leg.A_camera))
            nearest = max(min(depths), 0.2 * depths[0], 0.0025 * length)
            error_px = placement.pixel_error + joint_error * float(leg.band.scale / nearest)
            # A leg right before a camera that stands nowhere would be searched all over the image.
            window[leg.leg] += min(error_px, MAX_WINDOW * max(camera.width, camera.height))
    known = placement.blur[view] if placement.blur else np.nan
    blur = search.blur.get(row, 0.0) if np.isnan(known) else known
    one = ImageSearch(
        row,
        np.zeros((0, 0), dtype=np.float32) if T is None else search.load(row),
        camera,
        predicted,
        [*search.leg_names, *(arm.name for arm in arms.values())],
        window,
        guided=placement.window is not None,
        blur=blur or None,
        near_fit=not np.isnan(known),
        arms=tuple(arms),
        occluders=occluders,
        polished=placement.polished,
    )
    found, blur = (no_outlines(), np.nan) if T is None else measure(one, in_brief=in_brief)
    seen = {leg.leg for leg in predicted}
    why = Rejection(Reason.NOT_PLACED if T is None else Reason.OUTSIDE)
    # The longest part stands for a leg that is not looked for.
    longest = {j: max(search.cylinders[j], key=lambda c: (c.end - c.start, c.link)) for j in wanted}
    others = [
        JudgedPart(j, longest[j].link, PartVerdict((why, why))) for j in wanted if j not in seen
    ]
    return join_outlines([found, outline_table(one, others)]) if others else found, blur
