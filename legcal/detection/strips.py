"""Candidate strips: where a leg may be, near its prediction but tens of pixels off.

A patch of the image is straightened along the predicted leg and cut into short blocks. Every
block votes for the sideways shifts at which both outlines of the leg, a known distance apart,
fall on edges of the picture; edges count by sharpness against the noise of the patch, and
in full or in part by polarity: most legs of a view are brighter than what is behind them, or most
are darker, but a lit leg may be brighter on one side and darker on the other. Votes are added along
straight lines (shift at one end, shift at the other), and the best few are kept: which of them is
the leg is decided by all images of the view together.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from legcal.detection.picture import Grey, sample
from legcal.detection.prediction import PredictedLeg
from legcal.geometry.types import Array
from legcal.vision.camera import Camera

COLUMNS = 70  # columns to each side that a search window is reduced to
NARROWEST = 6.0  # pixels that the width of a leg keeps in the reduced image
BLOCK = 4  # rows of a block
ROW_STEP = 2.0  # reduced pixels between rows
MAX_BLOCKS = 100
NOISE_LEVELS = 4.0  # an edge this many times as steep as the median counts half
ASIDE = 4  # columns from an edge to where the picture should be less steep, at least on one side
OTHER_WAY = 0.5  # what an edge counts that is dark where it should be bright
GENTLE = 2.0  # what that steepness counts against the edge
BESIDE = 0.8  # what an edge counts in the columns beside it
TILT_STEP = 2  # columns between tilts, at the end of the leg
KEPT = 6
NEIGHBOURS = (3, 3)  # suppressed around a kept strip: tilts, columns


@dataclass(frozen=True, eq=False)
class Strips:
    """Candidates for one leg in one image, best first.

    Attributes
    ----------
    shift : (n, 2) array
        Sideways shift against the prediction at both ends of the leg's band [px].
    score : (n,) array
        Share of the visible length whose both outlines fall on edges, 0 to 1.
    if_brighter, if_darker : (n,) array
        The same where legs are brighter or darker than what is behind them, so that edges the
        other way round count less; as ``score`` unless given.
    """

    shift: Array
    score: Array
    if_brighter: Array = field(default_factory=lambda: np.zeros(0))
    if_darker: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        """Fill in what was not given."""
        for name in ("if_brighter", "if_darker"):
            if len(getattr(self, name)) != len(self.score):
                object.__setattr__(self, name, self.score)


def reduction(half_window: float, width: float) -> int:
    """Return the whole factor by which an image may be reduced for a search.

    Parameters
    ----------
    half_window : float
        Largest sideways shift [px].
    width : float
        Width of the narrowest leg [px].
    """
    return max(1, int(min(half_window / COLUMNS, width / NARROWEST)))


def find_strips(
    small: Grey, factor: int, camera: Camera, leg: PredictedLeg, window: float, tilt: float
) -> Strips:
    """Find the strips that a leg may be.

    Parameters
    ----------
    small : Grey
        The image, reduced by ``factor``.
    factor : int
        See :func:`reduction`.
    camera : Camera
        The camera.
    leg : PredictedLeg
        Where the leg should be.
    window : float
        Largest shift against the prediction in the middle of the leg [px].
    tilt : float
        Largest difference of the shifts at its ends [px].

    Returns
    -------
    Strips
        At most ``KEPT`` candidates.
    """
    votes, reach = _votes(small, factor, camera, leg, window, tilt)
    n_tilts = int(np.ceil(tilt / factor / TILT_STEP))
    differences = TILT_STEP * np.arange(-n_tilts, n_tilts + 1)
    n_shifts = int(np.ceil(window / factor))
    position = (np.arange(votes.shape[1]) + 0.5) / votes.shape[1] - 0.5
    columns = np.rint(differences[:, None] * position).astype(np.intp) + reach - n_shifts
    runs = sliding_window_view(votes, 2 * n_shifts + 1, axis=2)
    scores = runs[:, np.arange(votes.shape[1]), columns].sum(axis=2)
    return _peaks(scores, differences, n_shifts, factor)


def _votes(
    small: Grey, factor: int, camera: Camera, leg: PredictedLeg, window: float, tilt: float
) -> tuple[NDArray[np.float32], int]:
    """Return the votes of blocks for shifts, and the reach [columns].

    The votes (2, n_blocks, 2 reach + 1) are those if legs are brighter, and if they are darker.
    """
    band = leg.band
    n_rows = int(band.length / (ROW_STEP * factor))
    n_blocks = int(np.clip(n_rows // BLOCK, 3, MAX_BLOCKS))
    t = (np.arange(n_blocks * BLOCK) + 0.5) / (n_blocks * BLOCK) * band.length
    t_block = t.reshape(n_blocks, BLOCK).mean(axis=1)
    edges = leg.edge_offsets(t_block)
    reach = int(np.ceil((window + 0.5 * tilt) / factor)) + 2
    outer = reach + int(np.ceil(np.abs(edges).max() / factor)) + 3
    v = factor * np.arange(-outer, outer + 1.0)
    values, inside = sample(small, factor, camera, band.points(t[:, None], v))
    profiles = values.reshape(n_blocks, BLOCK, -1).mean(axis=1)
    seen = np.asarray(inside.reshape(n_blocks, BLOCK, -1).all(axis=1))
    rising, falling = edge_sharpness(profiles, seen, GENTLE)
    brighter = np.maximum(rising, OTHER_WAY * falling), np.maximum(falling, OTHER_WAY * rising)
    start = np.rint(edges / factor).astype(np.intp) + outer - reach
    block, n_columns = np.arange(n_blocks), 2 * reach + 1
    weight = ((leg.piece_at(t_block) >= 0) / np.float32(n_blocks)).astype(np.float32)[:, None]
    votes = np.empty((2, n_blocks, n_columns), dtype=np.float32)
    for i, sides in enumerate((brighter, brighter[::-1])):
        one, two = (
            sliding_window_view(side, n_columns, axis=1)[block, first]
            for side, first in zip(sides, start, strict=True)
        )
        votes[i] = weight * (np.float32(0.5) * one * two + np.float32(0.25) * (one + two))
    return votes, reach


def edge_sharpness(
    profiles: NDArray[np.float32], seen: NDArray[np.bool_], gentle: float = 0.0
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return how much each column of profiles (n_blocks, n) looks like an edge, 0 to 1.

    Two answers: for edges at which the picture gets brighter along the profile, and darker.

    The maxima of the smoothed gradient along each profile, against the median of the patch and,
    as far as ``gentle`` says, against the gentler of both sides (shading of a surface is steep over
    many columns, an edge is not), widened by one column to each side, where they count less.
    """
    smooth = cv2.GaussianBlur(profiles, (5, 1), 0.8)
    slope = np.zeros_like(profiles)
    slope[:, 1:-1] = (smooth[:, 2:] - smooth[:, :-2]) * (seen[:, 2:] & seen[:, :-2])
    gradient = np.abs(slope)
    wide = np.asarray(cv2.dilate(gradient, np.ones((1, 3), dtype=np.uint8)), dtype=np.float32)
    peak = np.where(gradient >= wide, gradient, np.float32(0.0))
    typical = float(np.median(gradient[seen])) if np.any(seen) else 0.0
    level = np.float32((NOISE_LEVELS * typical) ** 2 + 1e-3)
    aside = np.pad(cv2.blur(gradient, (3, 1)), ((0, 0), (ASIDE, ASIDE)), mode="edge")
    around = np.minimum(aside[:, : -2 * ASIDE], aside[:, 2 * ASIDE :])
    sharpness = peak**2 / (peak**2 + level + np.float32(gentle**2) * around**2)
    none = np.float32(0.0)
    rising = _widened(np.where(slope > 0.0, sharpness, none))
    return rising, _widened(np.where(slope < 0.0, sharpness, none))


def _widened(sharpness: NDArray[np.float32]) -> NDArray[np.float32]:
    """Let edges count in the columns beside them, too."""
    beside = np.asarray(cv2.dilate(sharpness, np.ones((1, 3), dtype=np.uint8)), dtype=np.float32)
    return np.asarray(np.maximum(sharpness, np.float32(BESIDE) * beside), dtype=np.float32)


def _peaks(
    both: NDArray[np.float32], differences: NDArray[np.intp], n_shifts: int, factor: int
) -> Strips:
    """Return the highest separate maxima of scores (2, n_tilts, n_shifts), brighter or darker."""
    score = both.max(axis=0)
    shifts, scores = [], []
    for _ in range(KEPT):
        i, j = divmod(int(np.argmax(score)), score.shape[1])
        if score[i, j] <= 0.0:
            break
        middle, half = j - n_shifts, 0.5 * differences[i]
        shifts.append((factor * (middle - half), factor * (middle + half)))
        scores.append(both[:, i, j].astype(np.float64))
        tilts, columns = NEIGHBOURS
        score[max(0, i - tilts) : i + tilts + 1, max(0, j - columns) : j + columns + 1] = 0.0
    brighter, darker = np.array(scores).reshape(-1, 2).T
    return Strips(np.array(shifts).reshape(-1, 2), np.maximum(brighter, darker), brighter, darker)
