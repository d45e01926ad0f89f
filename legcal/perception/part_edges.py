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

from legcal.geometry import Array, BoolArray, IntArray
from legcal.perception.light import Samples
from legcal.vision import Band, Camera, Grey, PredictedLeg, Segment

BLOCK_LENGTH = 8.0  # along the part [px]
ROWS, ROWS_NEAR = 4, 2  # of samples in a block, and where all windows are small
NEAR_WINDOW = 4  # such a window, at most [px]
MAX_BLOCKS = 80  # of a part
MARGIN = 6  # columns beyond the search window, to judge what an edge is [px]
MAX_LINES = 8  # near an edge
WIDTH_TOLERANCE = (1.0, 0.02)  # [px] and share of the width: one standard deviation
MIN_SCORE = 0.15  # of an edge of a pair: mean sharpness of its blocks
MIN_LONE_SCORE = 0.5  # of an edge that may stand alone
MIN_LONE_SCORE_GUIDED = 0.35  # the same near a fit to other legs
MAX_RIVAL = 0.6  # of its score, which no other line may reach
MIN_RIVAL_DISTANCE = 3.0  # from which on a line is another one, in the middle [px]
NOISE_LEVELS = 4.0  # an edge this many times as steep as the median counts half
BESIDE_WEIGHT = 0.8  # what an edge counts in the columns beside it
MAX_PREDICTION_ERROR = 1.0  # an edge that was found to a pixel may be where it is predicted [px]


@dataclass(frozen=True, eq=False)
class EdgePair:
    """The two edges of a part, good to about a pixel."""

    v: Array  # (2, 2) offsets of edge 1 and edge 2 at both ends of the band [px]
    found: BoolArray  # (2,) False for an edge that is put where the width of the part has it
    alone: BoolArray  # (2,) whether each edge is convincing without the other

    def suits(self, width: Array) -> bool:
        """Say whether both edges were found at the distance of the part's outlines (2,) [px]."""
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
    def half_width(self) -> float:
        """Half of the width that the edges have in the middle [px]."""
        return float(0.5 * np.mean(self.edges.v[1] - self.edges.v[0]))

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
    lines = _edge_lines(grey, camera, parts)
    return [_pair(*one) for one in zip(parts, lines[::2], lines[1::2], strict=True)]


def _pair(part: LegPart, *lines: tuple[Array, Array]) -> EdgePair | None:
    """Return the two outlines of a part among lines near each of them."""
    predicted = part.predicted
    together = _best_pair(lines[0], lines[1], predicted[1] - predicted[0], part.window)
    least = MIN_LONE_SCORE_GUIDED if part.guided else MIN_LONE_SCORE
    lone = [_alone(*candidates, least) for candidates in lines]
    if together is not None:
        shifts = np.stack([lines[edge][0][i] for edge, i in enumerate(together)])
        alone = np.array([i == k for i, k in zip(together, lone, strict=True)])
        return EdgePair(predicted + shifts, np.ones(2, dtype=np.bool_), alone)
    scores = [0.0 if i is None else lines[edge][1][i] for edge, i in enumerate(lone)]
    edge = int(np.argmax(scores))
    i = lone[edge]
    rivalled = max(lines[1 - edge][1], default=0.0) >= MIN_LONE_SCORE
    if i is None or (rivalled and not part.guided):
        return None  # two clear edges at another distance are not those of this part
    found = np.arange(2) == edge
    return EdgePair(predicted + lines[edge][0][i], found, found)


def _best_pair(
    one: tuple[Array, Array], two: tuple[Array, Array], width: Array, window: float
) -> tuple[int, int] | None:
    """Return which of the lines near both edges are a pair, None if no two are convincing."""
    (shift1, score1), (shift2, score2) = one, two
    if not len(score1) or not len(score2):
        return None
    mismatch = (shift2[None, :, :] - shift1[:, None, :]) / (
        WIDTH_TOLERANCE[0] + WIDTH_TOLERANCE[1] * width
    )
    drift = (0.5 / window) * (shift1[:, None, :] + shift2[None, :, :])
    square = mismatch**2
    value = score1[:, None] + score2[None, :] - 0.05 * (square + drift**2).sum(axis=-1)
    value[square.max(axis=-1) > 9.0] = -np.inf
    i, j = divmod(int(value.argmax()), len(score2))
    if not np.isfinite(value[i, j]) or min(score1[i], score2[j]) < MIN_SCORE:
        return None
    return i, j


def _alone(shift: Array, score: Array, least: float) -> int | None:
    """Return the best line near an edge if it has no rival."""
    if not len(score) or score[0] < least:
        return None
    middle = 0.5 * (shift[:, 0] + shift[:, 1])
    other = np.abs(middle - middle[0]) > MIN_RIVAL_DISTANCE
    return None if np.any(score[other] > MAX_RIVAL * score[0]) else 0


def block_positions(band: Band) -> Array:
    """Return the positions t of the blocks of a band [px]."""
    n = int(np.clip(band.length // BLOCK_LENGTH, 4, MAX_BLOCKS))
    return np.asarray((np.arange(n) + 0.5) * (band.length / n))


def _edge_lines(grey: Grey, camera: Camera, parts: Sequence[LegPart]) -> list[tuple[Array, Array]]:
    """Return lines near both edges of each part: shifts at both ends (n, 2) [px], scores (n,)."""
    halves = [int(np.ceil(part.window)) for part in parts]
    reach = max(halves) + MARGIN
    far = np.array([-float(reach), float(reach)])
    n_rows = ROWS if max(halves) > NEAR_WINDOW else ROWS_NEAR
    ends, hidden = [], []
    for part in parts:
        n = len(part.hidden)
        node = np.linspace(0.0, 1.0, n + 1)
        centre = part.predicted[:, :1] + np.diff(part.predicted, axis=1) * node
        ends.append(part.band.points((node * part.band.length)[:, None], centre[..., None] + far))
        hidden += [part.hidden] * 2
    n_blocks = np.array([len(one) for one in hidden])
    bounds = np.concatenate([[0], np.cumsum(n_blocks)])
    nodes = camera.distort(np.concatenate([one.reshape(-1, 2, 2) for one in ends]))
    # Between nodes, and near an edge, the lens moves pixels in proportion to their distance.
    begin = np.arange(bounds[-1]) + np.repeat(np.arange(len(hidden)), n_blocks)
    row = (np.arange(n_rows) + 0.5)[:, None, None] / n_rows
    pixels = nodes[begin, None] + row * (nodes[begin + 1] - nodes[begin])[:, None]
    share = np.linspace(0.0, 1.0, 2 * reach + 1, dtype=np.float32)
    first, change = (
        x.reshape(-1, 2).astype(np.float32)
        for x in (pixels[:, :, 0], pixels[:, :, 1] - pixels[:, :, 0])
    )
    x, y = (first[:, k : k + 1] + change[:, k : k + 1] * share for k in (0, 1))
    values = np.asarray(cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    seen = np.repeat(~np.concatenate(hidden)[:, None], len(share), axis=1)
    last = np.array([camera.width, camera.height]) - 1.5
    partly = np.any((pixels < 0.5) | (pixels > last), axis=(1, 2, 3))
    if partly.any():
        x, y = (one.reshape(-1, n_rows, len(share))[partly] for one in (x, y))
        inside = (x >= 0.5) & (x <= camera.width - 1.5) & (y >= 0.5) & (y <= camera.height - 1.5)
        seen[partly] &= inside.all(axis=1)
    profiles = values.reshape(-1, n_rows, len(share)).mean(axis=1)
    votes = _sharpness(profiles, seen, bounds) * seen
    n_seen = np.maximum(np.add.reduceat(seen.any(axis=1).astype(np.intp), bounds[:-1]), 1)
    lines = []
    for k, half in enumerate(np.repeat(halves, 2).tolist()):
        own = slice(bounds[k], bounds[k + 1]), slice(reach - half, reach + half + 1)
        lines.append(_lines(votes[own] / n_seen[k], half))
    return lines


def _sharpness(profiles: Samples, seen: BoolArray, bounds: IntArray) -> Samples:
    """Return how much each column of profiles (n_blocks, n) looks like an edge, 0 to 1.

    The maxima of the smoothed gradient along each profile against the median of its patch, widened
    by one column to each side, where they count less. ``bounds`` are the first blocks of patches.
    """
    smooth = cv2.GaussianBlur(profiles, (5, 1), 0.8)
    gradient = np.zeros_like(profiles)
    gradient[:, 1:-1] = np.abs(smooth[:, 2:] - smooth[:, :-2]) * (seen[:, 2:] & seen[:, :-2])
    beside = np.ones((1, 3), dtype=np.uint8)
    wide = np.asarray(cv2.dilate(gradient, beside), dtype=np.float32)
    peak = np.where(gradient >= wide, gradient, np.float32(0.0))
    typical = [
        _median(gradient[first:last][seen[first:last]]) for first, last in pairwise(bounds.tolist())
    ]
    level = np.repeat((NOISE_LEVELS * np.array(typical)) ** 2 + 1e-3, np.diff(bounds))
    sharpness = np.asarray(peak**2 / (peak**2 + level[:, None]), dtype=np.float32)
    widened = np.asarray(cv2.dilate(sharpness, beside), dtype=np.float32)
    return np.asarray(np.maximum(sharpness, np.float32(BESIDE_WEIGHT) * widened), dtype=np.float32)


def _median(values: Samples) -> float:
    """Return the middle value, the upper one of two; 0 of none."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle]) if len(values) else 0.0


def _lines(votes: Array, half: int) -> tuple[Array, Array]:
    """Add votes (n_blocks, 2 half + 1) along lines; return shifts and scores of separate maxima."""
    n_columns, reach = 2 * half + 1, half // 2 + 1
    padded = np.zeros((len(votes), n_columns + 2 * reach), dtype=votes.dtype)
    padded[:, reach:-reach] = votes
    score = padded.take(_along_lines(len(votes), half)).sum(axis=1)
    shifts, scores = [], []
    for _ in range(MAX_LINES):
        i, j = divmod(int(score.argmax()), n_columns)
        best = float(score[i, j])
        if best <= 0.0:
            break
        middle, tilt = j - half, 0.5 * (i - half)
        shifts.append((middle - tilt, middle + tilt))
        scores.append(best)
        score[max(0, i - 2) : i + 3, max(0, j - 2) : j + 3] = 0.0
    return np.array(shifts, dtype=np.float64).reshape(-1, 2), np.array(scores)


@lru_cache(maxsize=512)
def _along_lines(n_blocks: int, half: int) -> IntArray:
    """Return where votes lie along lines, by the difference of their ends and their middle.

    (2 half + 1, n_blocks, 2 half + 1) places in a table (n_blocks, 2 (half + half // 2) + 3).
    """
    position = (np.arange(n_blocks) + 0.5) / n_blocks - 0.5
    reach = half // 2 + 1
    column = np.rint(np.arange(-half, half + 1)[:, None] * position).astype(np.intp) + reach
    row = np.arange(n_blocks) * (2 * half + 1 + 2 * reach)
    places = (row + column)[..., None] + np.arange(2 * half + 1)
    places.setflags(write=False)
    return places
