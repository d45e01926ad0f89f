"""The pair of edges that are the two outlines of a part, near an aligned prediction.

Both edges are looked for apart, as straight lines near their predictions on which many blocks
of the picture have an edge; then the pair is chosen whose distance suits the radius at
both ends. Shading inside the leg and clutter beside it make lines as well, seldom at that
distance. Where one side of a leg is as bright as what is behind it there is no pair: an edge
that no other line near its prediction rivals may stand alone.
"""

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from legcal.detection.band import Band
from legcal.detection.picture import Grey, sample
from legcal.detection.sharpness import edge_sharpness
from legcal.geometry.types import Array, BoolArray
from legcal.vision.camera import Camera

BLOCK_LENGTH = 8.0  # [px]
ROWS = 4  # rows of a block
MAX_BLOCKS = 80
MARGIN = 6  # columns beyond the search window, to judge what an edge is
KEPT = 8
WIDTH_TOLERANCE = (1.0, 0.02)  # [px] and share of the width: one standard deviation
LEAST_SCORE = 0.15
LONE_SCORE = 0.5  # of an edge that may stand alone
RIVAL = 0.6  # of its score, which no other line may reach
RIVAL_DISTANCE = 3.0  # from which on a line is another one, in the middle [px]


@dataclass(frozen=True, eq=False)
class Pair:
    """Two edges of a band.

    Attributes
    ----------
    v : (2, 2) array
        Offsets of edge 1 and edge 2 at both ends of the band [px], good to about a pixel.
    found : (2,) array of bool
        False for an edge that was not found and is put where the width of the part demands.
    alone : (2,) array of bool
        Whether each edge is convincing without the other.
    """

    v: Array
    found: BoolArray
    alone: BoolArray

    def suits(self, width: Array) -> bool:
        """Say whether both edges were found at the distance of the part's outlines (2,) [px]."""
        off = np.abs(self.v[1] - self.v[0] - width)
        tolerance = WIDTH_TOLERANCE[0] + WIDTH_TOLERANCE[1] * width
        return bool(np.all(self.found) and np.all(off <= tolerance))


def find_pair(
    grey: Grey, camera: Camera, band: Band, predicted: Array, hidden: BoolArray, window: float
) -> Pair | None:
    """Find the two outlines of a part.

    Parameters
    ----------
    grey : Grey
        The image.
    camera : Camera
        The camera.
    band : Band
        Frame along the part.
    predicted : (2, 2) array
        Offsets v of edge 1 and edge 2 at both ends of the band [px].
    hidden : (n_blocks,) array of bool
        Which of the :func:`block_positions` other legs hide.
    window : float
        Largest distance of an edge from its prediction, at either end [px].

    Returns
    -------
    Pair or None
        None where no two edges are convincing, nor one alone.
    """
    lines = [_edge_lines(grey, camera, band, v, hidden, window) for v in predicted]
    width = predicted[1] - predicted[0]
    together = _best_pair(lines[0], lines[1], width, window)
    lone = [_alone(*candidates) for candidates in lines]
    if together is not None:
        shifts = np.stack([lines[edge][0][i] for edge, i in enumerate(together)])
        alone = np.array([i == k for i, k in zip(together, lone, strict=True)])
        return Pair(predicted + shifts, np.ones(2, dtype=np.bool_), alone)
    scores = [0.0 if i is None else lines[edge][1][i] for edge, i in enumerate(lone)]
    edge = int(np.argmax(scores))
    i = lone[edge]
    if i is None or max(lines[1 - edge][1], default=0.0) >= LONE_SCORE:
        return None  # two clear edges at another distance are not those of this part
    found = np.arange(2) == edge
    return Pair(predicted + lines[edge][0][i], found, found)


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
    drift = 0.5 * (shift1[:, None, :] + shift2[None, :, :]) / window
    value = score1[:, None] + score2[None, :]
    value = value - 0.1 * np.mean(mismatch**2, axis=-1) - 0.1 * np.mean(drift**2, axis=-1)
    value[np.abs(mismatch).max(axis=-1) > 3.0] = -np.inf
    i, j = np.unravel_index(int(np.argmax(value)), value.shape)
    if not np.isfinite(value[i, j]) or min(score1[i], score2[j]) < LEAST_SCORE:
        return None
    return int(i), int(j)


def _alone(shift: Array, score: Array) -> int | None:
    """Return the best line near an edge if it has no rival."""
    if not len(score) or score[0] < LONE_SCORE:
        return None
    middle = shift.mean(axis=1)
    other = np.abs(middle - middle[0]) > RIVAL_DISTANCE
    return None if np.any(score[other] > RIVAL * score[0]) else 0


def block_positions(band: Band) -> Array:
    """Return the positions t of the blocks of a band [px]."""
    n = int(np.clip(band.length // BLOCK_LENGTH, 4, MAX_BLOCKS))
    return np.asarray((np.arange(n) + 0.5) * (band.length / n))


def _edge_lines(
    grey: Grey, camera: Camera, band: Band, predicted: Array, hidden: BoolArray, window: float
) -> tuple[Array, Array]:
    """Return lines near a predicted edge: shifts at both ends (n, 2) [px], and scores (n,)."""
    half = int(np.ceil(window))
    n_blocks = len(hidden)
    rows = (np.arange(n_blocks * ROWS) + 0.5) / (n_blocks * ROWS)
    centre = predicted[0] + (predicted[1] - predicted[0]) * rows
    v = centre[:, None] + np.arange(-half - MARGIN, half + MARGIN + 1.0)
    xy = band.points(rows[:, None] * band.length, v)
    values, inside = sample(grey, 1, camera, xy)
    shape = (n_blocks, ROWS, v.shape[1])
    seen = inside.reshape(shape).all(axis=1) & ~hidden[:, None]
    votes = edge_sharpness(values.reshape(shape).mean(axis=1), seen)
    votes = votes[:, MARGIN:-MARGIN] * seen[:, MARGIN:-MARGIN]
    return _lines(votes / max(1, int(seen.any(axis=1).sum())), half)


def _lines(votes: Array, half: int) -> tuple[Array, Array]:
    """Add votes (n_blocks, 2 half + 1) along lines; return shifts and scores of separate maxima."""
    position = (np.arange(len(votes)) + 0.5) / len(votes) - 0.5
    differences = np.arange(-half, half + 1)
    reach = half // 2 + 1
    padded = np.pad(votes, ((0, 0), (reach, reach)))
    columns = np.rint(differences[:, None] * position).astype(np.intp) + reach
    runs = sliding_window_view(padded, votes.shape[1], axis=1)
    score = runs[np.arange(len(votes)), columns].sum(axis=1)
    shifts, scores = [], []
    for _ in range(KEPT):
        i, j = divmod(int(np.argmax(score)), score.shape[1])
        if score[i, j] <= 0.0:
            break
        shifts.append((j - half - 0.5 * differences[i], j - half + 0.5 * differences[i]))
        scores.append(float(score[i, j]))
        score[max(0, i - 2) : i + 3, max(0, j - 2) : j + 3] = 0.0
    return np.array(shifts, dtype=np.float64).reshape(-1, 2), np.array(scores)
