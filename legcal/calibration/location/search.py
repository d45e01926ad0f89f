"""The frames without a start: closed forms on subsets of rows, and the robust descent from them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from legcal.calibration.location.frames import (
    N_FRAME,
    Frames,
    PosePairs,
    jacobian,
    residuals,
    stacked,
)
from legcal.geometry import Array, BoolArray, IntArray, nearest_rotation

MOST_ROWS = 40  # that starts are tried on
SUBSETS = 30
SUBSET = 4  # rows
AT_FIRST = 8  # steps on the rows that a start came from, and for all starts
MOST_PROMISING = 12  # starts that go on
LAST_STEPS = 30
_CONVERGED = 1e-9  # relative change of the cost


@dataclass(frozen=True, eq=False)
class Candidates:
    """Where the search has ended, the best first."""

    frames: Frames  # A batch
    # (k,): mean square over the rows that agree best, lengths in units of ``pairs.length``
    cost: Array


def search(
    pairs: PosePairs,
    fewest: int,  # rows that determine the frames
    *,
    subsets: int = SUBSETS,  # how many starts come from a few rows each
) -> Candidates:
    """Return the frames that agree best with most rows, from starts all over the rotations."""
    if len(pairs) > MOST_ROWS:
        pairs = pairs.of(np.linspace(0, len(pairs) - 1, MOST_ROWS).astype(np.intp))
    n = len(pairs)
    n_kept = kept_rows(n, fewest)
    start, chosen = _starts(pairs, fewest, subsets)
    frames = _descend(pairs, start, AT_FIRST, chosen.astype(np.float64))
    order = np.argsort(_trimmed(frames, pairs, n_kept), kind="stable")[:MOST_PROMISING]
    frames = _descend(pairs, frames.at(order), LAST_STEPS, n_kept)
    cost = _trimmed(frames, pairs, n_kept)
    order = np.argsort(cost, kind="stable")
    return Candidates(frames.at(order), cost[order] / n_kept)


def kept_rows(n: int, fewest: int) -> int:
    """Return how many of n rows a start must agree with: more than half of what can be spared."""
    return max(min(n, fewest), (n + fewest + 1) // 2)


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


def solve_by_opencv(
    pairs: PosePairs,  # rows without an orientation are left out
) -> Frames | None:
    """Return the frames that OpenCV finds, or None where it finds none or has no solver."""
    solver = getattr(cv2, "calibrateRobotWorldHandEye", None)
    rows = pairs.of(pairs.oriented)
    if solver is None or len(rows) < 3:
        return None
    A, B = np.swapaxes(rows.M, 1, 2), np.swapaxes(rows.R, 1, 2)
    try:
        found = solver(
            list(A),
            [-a @ p for a, p in zip(A, rows.p, strict=True)],
            list(B),
            [-b @ t for b, t in zip(B, rows.t, strict=True)],
            method=cv2.CALIB_ROBOT_WORLD_HAND_EYE_SHAH,
        )
    except cv2.error:
        return None
    R_X, t_X, R_Z, t_Z = (np.asarray(part, dtype=np.float64) for part in found)
    if not all(np.isfinite(part).all() for part in (R_X, t_X, R_Z, t_Z)):
        return None
    R_tool = nearest_rotation(R_Z).T
    return Frames(nearest_rotation(R_X), t_X.ravel(), R_tool, -R_tool @ t_Z.ravel())


def solve_by_kronecker(
    # rows without an orientation serve for positions only; one row has to have one
    pairs: PosePairs,
) -> Frames:
    """Return the frames by the largest singular pair of sum_i R_i (x) M_i.

    From M_i R_tool^T R_i^T = R_base follows (R_i (x) M_i) vec(R_tool^T) = vec(R_base). Where
    rotations leave the orientations open, some solution among many is returned.
    """
    rows = pairs.of(pairs.oriented)
    K = np.einsum("nij,nkl->ikjl", rows.R, rows.M).reshape(9, 9)
    U, _, Vt = np.linalg.svd(K)
    R_base, R_tool = U[:, 0].reshape(3, 3).T, Vt[0].reshape(3, 3)  # columns first
    sign = 1.0 if np.linalg.det(R_tool) >= 0.0 else -1.0
    R_base, R_tool = nearest_rotation(sign * R_base), nearest_rotation(sign * R_tool)
    return with_positions(R_base, R_tool, pairs)


def with_positions(
    R_base: Array,  # R_base, R_tool: (..., 3, 3): orientations of T_world_base and T_platform_tool
    R_tool: Array,
    # what the positions are to agree with; the smallest ones where these leave some open
    pairs: PosePairs,
) -> Frames:
    """Return frames of known orientations with the positions of linear least squares."""
    batch, n = R_base.shape[:-2], len(pairs)
    A = np.concatenate(
        [
            np.broadcast_to(np.eye(3), (*batch, n, 3, 3)),
            R_base[..., None, :, :] @ pairs.R,
        ],
        axis=-1,
    ).reshape(*batch, 3 * n, 6)
    b = (pairs.p - np.einsum("...ij,nj->...ni", R_base, pairs.t)).reshape(*batch, 3 * n, 1)
    x = (np.linalg.pinv(A, rcond=1e-9) @ b)[..., 0]
    return Frames(R_base, x[..., :3], R_tool, x[..., 3:])


def tool_orientation(R_base: Array, pairs: PosePairs) -> Array:
    """Return the orientations (..., 3, 3) of the tool in the platform, given the base's."""
    carried = R_base[..., None, :, :] @ pairs.R
    votes = np.swapaxes(carried, -1, -2) @ pairs.M * pairs.oriented[:, None, None]
    return nearest_rotation(votes.sum(axis=-3) + 1e-12 * np.eye(3))


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
        settled = bool(np.all(np.abs(before - cost) <= _CONVERGED * before + 1e-26))
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
