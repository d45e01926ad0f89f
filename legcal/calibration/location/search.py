"""The frames without a start: closed forms on subsets of rows, and robust descent from them.

If no frames explain the poses, common mistakes (units, mirrored axes, orders) are undone one by one
to name the likeliest.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from legcal.calibration.location.frames import (
    N_STEP,
    PosePairs,
    frames_after,
    frames_from,
    jacobian,
    residuals,
)
from legcal.geometry.rotations import nearest_rotation
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.solver import solve

_MAX_ROWS = 40  # rows used in the search
_SUBSETS = 30
_SUBSET = 4  # rows
_FIRST_ITERATIONS = 8  # iterations of all starts, each on the rows of its subset
_N_CONTINUED = 12  # best starts, which are continued
_MAX_ITERATIONS = 30
_MAX_TURN = 0.5  # [rad] in one step
_MAX_STALLED = 4  # iterations without a clear decrease of the cost
# Mistakes
_BETTER = 10.0  # ratio of residuals before and after a mistake is undone
_CLEAR = 0.01  # residual, relative to the spread of positions, that ends the search for mistakes
_MISTAKE_ROWS, _MISTAKE_SUBSETS = 12, 8
_LENGTHS = (
    (1e-3, "millimetres", "divide x, y and z by 1000"),
    (1e-2, "centimetres", "divide x, y and z by 100"),
    (0.0254, "inches", "multiply x, y and z by 0.0254"),
)
_MIRRORS = (
    ("x reversed", np.diag([-1.0, 1.0, 1.0])),
    ("y reversed", np.diag([1.0, -1.0, 1.0])),
    ("z reversed", np.diag([1.0, 1.0, -1.0])),
    ("x and y swapped", np.eye(3)[[1, 0, 2]]),
    ("y and z swapped", np.eye(3)[[0, 2, 1]]),
    ("x and z swapped", np.eye(3)[[2, 1, 0]]),
)


class FrameCandidates(NamedTuple):
    """End points of the search, the best first."""

    frames: Array  # (k, 2, 3, 4)
    # (k,): mean square residual of the best rows, lengths in units of ``pairs.length``
    cost: Array


def search(
    pairs: PosePairs,
    fewest: int,  # rows that determine the frames
    *,
    subsets: int = _SUBSETS,  # number of starts from small subsets of rows
) -> FrameCandidates:
    """Return the frames that agree best with most rows, from starts all over SO(3)."""
    if len(pairs) > _MAX_ROWS:
        pairs = pairs.of(np.linspace(0, len(pairs) - 1, _MAX_ROWS).astype(np.intp))
    n_kept = kept_rows(len(pairs), fewest)
    starts, rows = _starts(pairs, fewest, subsets)
    frames = _descended(pairs, starts, rows.astype(np.float64), _FIRST_ITERATIONS)
    order = np.argsort(_trimmed_cost(frames, pairs, n_kept), kind="stable")[:_N_CONTINUED]
    frames = _descended(pairs, frames[order], n_kept, _MAX_ITERATIONS)
    cost = _trimmed_cost(frames, pairs, n_kept)
    order = np.argsort(cost, kind="stable")
    return FrameCandidates(frames[order], cost[order] / n_kept)


def kept_rows(n: int, fewest: int) -> int:
    """Return the number of n rows that must agree: the fewest and half of the redundant rows."""
    return max(min(n, fewest), (n + fewest + 1) // 2)


def _starts(pairs: PosePairs, fewest: int, subsets: int) -> tuple[Array, BoolArray]:
    """Return k starts and a mask (k, n) of the rows of each."""
    n = len(pairs)
    rng = np.random.default_rng(0)
    everywhere = Rotation.create_group("O").as_matrix()
    starts = list(with_positions(everywhere, _tool_orientation(everywhere, pairs), pairs))
    if pairs.oriented.any():
        closed = [solve_by_opencv(pairs), solve_by_kronecker(pairs)]
        starts += [frames for frames in closed if frames is not None]
    rows: list[BoolArray] = [np.ones(n, dtype=np.bool_)] * len(starts)
    size = max(_SUBSET, fewest)
    for k in range(subsets if n > size else 0):
        chosen = np.sort(rng.choice(n, size, replace=False)).astype(np.intp)
        subset, R_base = pairs.of(chosen), everywhere[k % len(everywhere)]
        if subset.oriented.sum() >= 3:
            starts.append(solve_by_kronecker(subset))
        else:
            starts.append(with_positions(R_base, _tool_orientation(R_base, subset), subset))
        rows.append(np.isin(np.arange(n), chosen))
    return np.array(starts), np.array(rows)


def solve_by_opencv(
    pairs: PosePairs,  # rows without an orientation are left out
) -> Array | None:
    """Return the frames of OpenCV's robot-world/hand-eye solver, or None if it fails."""
    solver = getattr(cv2, "calibrateRobotWorldHandEye", None)
    rows = pairs.of(pairs.oriented)
    if solver is None or len(rows) < 3:
        return None
    A, B = np.swapaxes(rows.M, 1, 2), np.swapaxes(rows.R, 1, 2)
    try:
        solution = solver(
            list(A),
            [-a @ p for a, p in zip(A, rows.p, strict=True)],
            list(B),
            [-b @ t for b, t in zip(B, rows.t, strict=True)],
            method=cv2.CALIB_ROBOT_WORLD_HAND_EYE_SHAH,
        )
    except cv2.error:
        return None
    R_X, t_X, R_Z, t_Z = (np.asarray(part, dtype=np.float64) for part in solution)
    if not all(np.isfinite(part).all() for part in (R_X, t_X, R_Z, t_Z)):
        return None
    R_tool = nearest_rotation(R_Z).T
    return frames_from(nearest_rotation(R_X), t_X.ravel(), R_tool, -R_tool @ t_Z.ravel())


def solve_by_kronecker(
    # rows without an orientation serve for positions only; one row has to have one
    pairs: PosePairs,
) -> Array:
    """Return the frames by the largest singular pair of sum_i R_i (x) M_i.

    From M_i R_tool^T R_i^T = R_base follows (R_i (x) M_i) vec(R_tool^T) = vec(R_base). If the
    rotations do not determine the orientations, one of many solutions is returned.
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
    pairs: PosePairs,  # undetermined positions get the minimum norm
) -> Array:
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
    return frames_from(R_base, x[..., :3], R_tool, x[..., 3:])


def _tool_orientation(R_base: Array, pairs: PosePairs) -> Array:
    """Return the orientations (..., 3, 3) of the tool in the platform, given the base's."""
    carried = R_base[..., None, :, :] @ pairs.R
    votes = np.swapaxes(carried, -1, -2) @ pairs.M * pairs.oriented[:, None, None]
    return nearest_rotation(votes.sum(axis=-3) + 1e-12 * np.eye(3))


def _descended(pairs: PosePairs, frames: Array, rows: Array | int, max_iterations: int) -> Array:
    """Return the starts after damped steps on given rows (k, n), or on a number of best rows."""

    def equations(frames: Array) -> tuple[Array, Array]:
        r = residuals(frames, pairs) * pairs.unit
        weight = _best(r, rows) if isinstance(rows, int) else rows
        J = -jacobian(frames, pairs) * pairs.unit[:, None] * weight[..., None, None]
        return (r * weight[..., None]).reshape(len(r), -1), J.reshape(len(r), -1, N_STEP)

    def retract(frames: Array, step: Array) -> Array:
        turn = np.linalg.norm(step[:, [3, 4, 5, 9, 10, 11]], axis=1)
        return frames_after(
            frames, step * np.minimum(1.0, _MAX_TURN / np.maximum(turn, 1e-300))[:, None]
        )

    return solve(
        equations,
        retract,
        frames,
        tolerance=0.0,
        unit=pairs.scale,
        damped=True,
        steps=max_iterations,
        max_stalled=_MAX_STALLED,
    ).points


def _trimmed_cost(frames: Array, pairs: PosePairs, n_kept: int) -> Array:
    """Return the sums of squares over the best rows, (k,)."""
    r = residuals(frames, pairs) * pairs.unit
    return np.asarray(np.einsum("kni,kni,kn->k", r, r, _best(r, n_kept)))


def _best(r: Array, n_kept: int) -> Array:
    """Return weights (k, n): one for the rows of each start with the smallest residuals."""
    rank: IntArray = np.argsort(np.argsort((r**2).sum(axis=2), axis=1, kind="stable"), axis=1)
    return (rank < n_kept).astype(np.float64)


def likely_mistake(
    pairs: PosePairs,
    cost: float,  # cost of the best candidate
    fewest: int,  # rows that determine the frames
) -> tuple[str, str] | None:
    """Return a description of the likeliest mistake and its remedy, or None."""
    best, mistake = cost / _spread(pairs) / _BETTER**2, None
    selected = pairs.of(
        np.linspace(0, len(pairs) - 1, min(len(pairs), _MISTAKE_ROWS)).astype(np.intp)
    )
    for changed, looks_like, remedy in _alternatives(selected):
        other = float(search(changed, fewest, subsets=_MISTAKE_SUBSETS).cost[0]) / _spread(changed)
        if other < best:
            best, mistake = other / _BETTER**2, (looks_like, remedy)
            if other < _CLEAR**2:
                break
    return mistake


def _spread(pairs: PosePairs) -> float:
    """Return the total variance of the positions in units of ``pairs.length``."""
    return float(pairs.p.var(axis=0).sum()) / pairs.length**2 + 1e-300


def _alternatives(pairs: PosePairs) -> Iterator[tuple[PosePairs, str, str]]:
    """Yield the poses with each mistake undone, a description of the mistake, and its remedy."""
    has_orientations = bool(pairs.oriented.any())
    reordered = _reordered(pairs.M)
    wrong_order = "quaternions in the order w, x, y, z", "write qx, qy, qz, qw under their names"
    for size, unit, remedy in _LENGTHS:
        metres = replace(pairs, p=size * pairs.p)
        yield metres, f"positions in {unit}", remedy
        if has_orientations:
            corrected = replace(metres, M=reordered)
            yield (
                corrected,
                f"positions in {unit} and {wrong_order[0]}",
                f"{remedy}, and {wrong_order[1]}",
            )
    mirror = _MIRRORS[2][1]
    name = "left-handed axes, a mirror image", "give poses in right-handed axes"
    yield replace(pairs, p=pairs.p @ mirror, M=mirror @ pairs.M @ mirror), *name
    if not has_orientations:
        return
    yield replace(pairs, M=reordered), *wrong_order
    back = np.swapaxes(pairs.M, 1, 2)
    inverse = "the orientation of the world in the tool", "invert the quaternions"
    yield replace(pairs, M=back), *inverse
    world = replace(pairs, M=back, p=-np.einsum("nij,nj->ni", back, pairs.p))
    yield world, "poses of the world in the tool", "give those of the tool in the world"
    for words, S in _MIRRORS:
        yield (
            replace(pairs, p=pairs.p @ S.T),
            f"positions along left-handed axes ({words})",
            "give positions and orientations along the same right-handed axes",
        )


def _reordered(M: Array) -> Array:
    """Return orientations with quaternions w, x, y, z that were read as x, y, z, w."""
    quaternions = Rotation.from_matrix(M).as_quat()
    return Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_matrix()
