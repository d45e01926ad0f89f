"""Frames from any start: many starts at once, each fitted to the rows that agree best with it.

Starts are the closed forms, 24 orientations of the base from which every other one is at most
63 degrees away, and fits to a few rows each, so that wrong rows do not spoil all of them.
Each goes on by Levenberg-Marquardt on its best rows (least trimmed squares).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.location.closed_form import (
    solve_by_kronecker,
    solve_by_opencv,
    tool_orientation,
    with_positions,
)
from legcal.location.pose_pairs import (
    N_FRAME,
    Frames,
    PosePairs,
    jacobian,
    residuals,
    stacked,
)

MOST_ROWS = 40  # that starts are tried on
SUBSETS = 30
SUBSET = 4  # rows
AT_FIRST = 8  # steps on the rows that a start came from, and for all starts
MOST_PROMISING = 12  # starts that go on
STEPS = 30
_SETTLED = 1e-9  # relative change of the cost


@dataclass(frozen=True, eq=False)
class Candidates:
    """Where the search has ended, the best first.

    Attributes
    ----------
    frames : Frames
        A batch.
    cost : (k,) array
        Mean square over the rows that agree best, lengths in units of ``pairs.length``.
    """

    frames: Frames
    cost: Array


def kept_rows(n: int, fewest: int) -> int:
    """Return how many of n rows a start must agree with: more than half of what can be spared."""
    return max(min(n, fewest), (n + fewest + 1) // 2)


def search(pairs: PosePairs, fewest: int, *, subsets: int = SUBSETS) -> Candidates:
    """Return the frames that agree best with most rows, from starts all over the rotations.

    Parameters
    ----------
    pairs : PosePairs
        What was measured.
    fewest : int
        Rows that determine the frames.
    subsets : int
        How many starts come from a few rows each.
    """
    if len(pairs) > MOST_ROWS:
        pairs = pairs.of(np.linspace(0, len(pairs) - 1, MOST_ROWS).astype(np.intp))
    n = len(pairs)
    n_kept = kept_rows(n, fewest)
    start, chosen = _starts(pairs, fewest, subsets)
    frames = _descend(pairs, start, AT_FIRST, chosen.astype(np.float64))
    order = np.argsort(_trimmed(frames, pairs, n_kept), kind="stable")[:MOST_PROMISING]
    frames = _descend(pairs, frames.at(order), STEPS, n_kept)
    cost = _trimmed(frames, pairs, n_kept)
    order = np.argsort(cost, kind="stable")
    return Candidates(frames.at(order), cost[order] / n_kept)


def _starts(pairs: PosePairs, fewest: int, subsets: int) -> tuple[Frames, BoolArray]:
    """Return starts and the rows (k, n) that each came from."""
    n = len(pairs)
    chance = np.random.default_rng(0)
    everywhere = Rotation.create_group("O").as_matrix()
    everything = np.ones(n, dtype=np.bool_)
    batch = with_positions(everywhere, tool_orientation(everywhere, pairs), pairs)
    found = [batch.at(i) for i in range(len(everywhere))]
    rows: list[BoolArray] = [everything] * len(found)
    if pairs.oriented.any():
        closed = [solve_by_opencv(pairs), solve_by_kronecker(pairs)]
        found += [frames for frames in closed if frames is not None]
        rows += [everything] * (len(found) - len(rows))
    size = max(SUBSET, fewest)
    for k in range(subsets if n > size else 0):
        chosen = np.sort(chance.choice(n, size, replace=False)).astype(np.intp)
        found.append(_start_of(pairs.of(chosen), everywhere[k % len(everywhere)]))
        rows.append(np.isin(np.arange(n), chosen))
    return stacked(found), np.array(rows)


def _start_of(pairs: PosePairs, R_base: Array) -> Frames:
    """Return a start from a few rows."""
    if pairs.oriented.sum() >= 3:
        return solve_by_kronecker(pairs)
    return with_positions(R_base, tool_orientation(R_base, pairs), pairs)


def _descend(pairs: PosePairs, frames: Frames, steps: int, rows: Array | int) -> Frames:
    """Return each start after Levenberg-Marquardt on given rows, or on so many of its best."""
    damping = np.full(len(frames.t_base), 1e-3)
    r = _relative(frames, pairs)
    settled = False
    while steps > 0 and not settled:
        weight = _best(r, rows) if isinstance(rows, int) else rows
        before = _cost(r, weight)
        tried = frames.moved(_step(frames, pairs, r, weight, damping))
        r_tried = _relative(tried, pairs)
        cost = _cost(r_tried, weight)
        better = cost <= before
        settled = bool(np.all(np.abs(before - cost) <= _SETTLED * before + 1e-26))
        frames, r = _where(better, tried, frames), np.where(better[:, None, None], r_tried, r)
        damping = np.where(better, np.maximum(0.1 * damping, 1e-14), np.minimum(10 * damping, 1e3))
        steps -= 1
    return frames


def _step(frames: Frames, pairs: PosePairs, r: Array, weight: Array, damping: Array) -> Array:
    """Return the damped steps (k, 12), none turning by more than half a radian."""
    A = jacobian(frames, pairs) * _units(pairs)[:, None] * pairs.scale
    A = (A * weight[:, :, None, None]).reshape(len(weight), -1, N_FRAME)
    y = (r * weight[:, :, None]).reshape(len(weight), -1, 1)
    H = np.swapaxes(A, 1, 2) @ A
    size = np.trace(H, axis1=1, axis2=2) / N_FRAME
    H += (damping * size)[:, None, None] * np.eye(N_FRAME)
    change = np.linalg.solve(H, np.swapaxes(A, 1, 2) @ y)[..., 0] * pairs.scale
    turn = np.linalg.norm(change[:, [3, 4, 5, 9, 10, 11]], axis=1)
    return np.asarray(change * np.minimum(1.0, 0.5 / np.maximum(turn, 1e-300))[:, None])


def _units(pairs: PosePairs) -> Array:
    """Return what residuals are multiplied with, (6,)."""
    return np.repeat([1.0 / pairs.length, 1.0], 3)


def _relative(frames: Frames, pairs: PosePairs) -> Array:
    """Return residuals without a unit, (k, n, 6)."""
    return residuals(frames, pairs) * _units(pairs)


def _trimmed(frames: Frames, pairs: PosePairs, n_kept: int) -> Array:
    """Return the sums of squares of the best rows, (k,)."""
    r = _relative(frames, pairs)
    return _cost(r, _best(r, n_kept))


def _cost(r: Array, weight: Array) -> Array:
    """Return the weighted sums of squares, (k,)."""
    return np.asarray(np.einsum("kni,kni,kn->k", r, r, weight))


def _best(r: Array, n_kept: int) -> Array:
    """Return one for the rows of each start with the smallest residuals, else zero, (k, n)."""
    rank: IntArray = np.argsort(np.argsort((r**2).sum(axis=2), axis=1, kind="stable"), axis=1)
    return (rank < n_kept).astype(np.float64)


def _where(chosen: BoolArray, one: Frames, other: Frames) -> Frames:
    """Return some of a batch from one and the others from another."""
    c = chosen[:, None]
    return Frames(
        np.where(c[..., None], one.R_base, other.R_base),
        np.where(c, one.t_base, other.t_base),
        np.where(c[..., None], one.R_tool, other.R_tool),
        np.where(c, one.t_tool, other.t_tool),
    )
