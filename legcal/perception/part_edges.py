"""The two edges of a part of a leg, found to a pixel near where they are predicted.

Each edge is searched by itself, as straight lines near their predictions on which many blocks
of the picture have an edge; then the pair is chosen whose distance suits the radius at
both ends. Shading inside the leg and clutter beside it make lines as well, seldom at that
distance. Where one side of a leg is as bright as what is behind it there is no pair: an edge
that no other line near its prediction rivals may stand alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import cv2
import numpy as np
from numpy.lib.stride_tricks import as_strided

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.perception.profiles import Samples
from legcal.perception.tuning import EDGE_SCORE, RIVAL
from legcal.vision.camera import Camera
from legcal.vision.image_file import Grey
from legcal.vision.visibility import Band, PredictedLeg, Segment

BLOCK_LENGTH = 8.0  # along the part [px]
ROWS, ROWS_NEAR = 4, 2  # of samples in a block, and where all windows are small
NEAR_WINDOW = 4  # such a window, at most [px]
MAX_BLOCKS = 80  # of a part
MARGIN = 6  # columns beyond the search window, to judge edges [px]
MAX_LINES = 8  # near an edge
SIZES = 4  # windows are worked on together whose half widths are equal in steps of so much [px]
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
    predicted: Array  # (2, 2) offsets of edge 1 and 2 at both ends of the band [px]
    hidden: BoolArray  # (n_blocks,) which of the block_positions other legs hide
    window: float  # largest distance of an edge from its prediction, at either end [px]
    guided: bool  # whether a fit to other legs predicts it: one edge near there is enough
    pair: EdgePair | None = None

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
    reach = int(halves.max()) + MARGIN
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
    return _lines(votes[:, MARGIN:-MARGIN], n_blocks, halves)


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
