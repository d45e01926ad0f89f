"""Two unknown frames: T_world_tool = T_world_base T_base_platform(q) T_platform_tool.

Frames are arrays (..., 2, 3, 4): rotation beside position [m] of T_world_base and T_platform_tool;
leading dimensions make a batch. They move by steps (..., 12): displacement of the base in the world
[m], its rotation vector about world axes [rad], and the same of the tool in the platform.

The search needs no start: closed forms on subsets of rows, and robust descent from them. If no
frames explain the poses, common mistakes (units, mirrored axes, orders) are undone one by one to
name the likeliest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.motions import cross_matrices, moved_poses, nearest_rotation
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.solver import solve

N_STEP = 12
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


@dataclass(frozen=True, eq=False)
class PosePairs:
    """Measured tool poses and the platform poses at their readings."""

    R: Array  # R, t: (n, 3, 3) and (n, 3): T_base_platform [m]
    t: Array
    # M, p: (n, 3, 3) and (n, 3): measured T_world_tool [m]; M is the identity if not measured
    M: Array
    p: Array
    oriented: BoolArray  # (n,): whether the orientation of the tool was measured
    length: float  # length of the machine, equivalent to a rotation by one radian [m]

    def __len__(self) -> int:
        return len(self.t)

    def of(self, rows: BoolArray | IntArray) -> PosePairs:
        """Return the pairs of selected rows."""
        R, t, M, p = (x[rows] for x in (self.R, self.t, self.M, self.p))
        return PosePairs(R, t, M, p, self.oriented[rows], self.length)

    @property
    def scale(self) -> Array:
        """Unit of each component of a step, (12,): the length [m], or one radian."""
        return np.tile(np.repeat([self.length, 1.0], 3), 2)

    @property
    def unit(self) -> Array:
        """Factors that make residuals (..., 6) dimensionless, (6,)."""
        return np.repeat([1.0 / self.length, 1.0], 3)


def frames_from(R_base: Array, t_base: Array, R_tool: Array, t_tool: Array) -> Array:
    """Return frames (..., 2, 3, 4) from rotations (..., 3, 3) and positions (..., 3)."""
    base = np.concatenate([R_base, t_base[..., None]], axis=-1)
    return np.stack([base, np.concatenate([R_tool, t_tool[..., None]], axis=-1)], axis=-3)


def components_of(frames: Array) -> tuple[Array, Array, Array, Array]:
    """Return R_base, t_base, R_tool, t_tool of frames."""
    base, tool = frames[..., 0, :, :], frames[..., 1, :, :]
    return base[..., :3], base[..., 3], tool[..., :3], tool[..., 3]


def transforms(frames: Array) -> tuple[RigidTransform, RigidTransform]:
    """Return T_world_base and T_platform_tool of frames (2, 3, 4)."""
    base, tool = (
        RigidTransform.from_components(F[:, 3], Rotation.from_matrix(F[:, :3])) for F in frames
    )
    return base, tool


def frames_after(frames: Array, step: Array) -> Array:
    """Return frames after steps (..., 12)."""
    steps = step.reshape(*step.shape[:-1], 2, 6)
    R, t = moved_poses(frames[..., :3], frames[..., 3], steps[..., 3:], steps[..., :3])
    return np.concatenate([R, t[..., None]], axis=-1)


def predicted(frames: Array, pairs: PosePairs) -> tuple[Array, Array]:
    """Return orientations (..., n, 3, 3) and positions (..., n, 3) [m] of the tool in the world."""
    R_base, t_base, R_tool, t_tool = components_of(frames)
    tip = np.einsum("nij,...j->...ni", pairs.R, t_tool) + pairs.t
    p = np.einsum("...ij,...nj->...ni", R_base, tip) + t_base[..., None, :]
    M = R_base[..., None, :, :] @ pairs.R @ R_tool[..., None, :, :]
    return M, p


def residuals(frames: Array, pairs: PosePairs) -> Array:
    """Return measured minus predicted poses, (..., n, 6): position [m], rotation vector [rad].

    Both are along world axes; a rotation that was not measured counts as zero.
    """
    M, p = predicted(frames, pairs)
    rotation = pairs.M @ np.swapaxes(M, -1, -2)
    turn = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_rotvec().reshape(p.shape)
    turn[..., ~pairs.oriented, :] = 0.0
    return np.concatenate([pairs.p - p, turn], axis=-1)


def jacobian(frames: Array, pairs: PosePairs) -> Array:
    """Return the derivative of predicted poses by a step, (..., n, 6, 12)."""
    R_base, t_base, _, t_tool = components_of(frames)
    tip = np.einsum("nij,...j->...ni", pairs.R, t_tool) + pairs.t
    arm = np.einsum("...ij,...nj->...ni", R_base, tip)
    carried = R_base[..., None, :, :] @ pairs.R
    J = np.zeros((*t_base.shape[:-1], len(pairs), 6, N_STEP))
    J[..., :3, :3] = np.eye(3)
    J[..., :3, 3:6] = -cross_matrices(arm)
    J[..., :3, 6:9] = carried
    J[..., 3:, 3:6] = np.eye(3) * pairs.oriented[:, None, None]
    J[..., 3:, 9:] = carried * pairs.oriented[:, None, None]
    return J


def tool_motions(motions: Array, frames: Array, pairs: PosePairs) -> Array:
    """Return the motions of the tool in the world by platform motions, (n, 6, k).

    Displacements [m] come first, then rotation vectors [rad].

    *motions* (n, 6, k) are rotation vectors [rad] and displacements of the platform link [m] in the
    base link.
    """
    R_base, _, _, t_tool = components_of(frames)
    arm = cross_matrices(pairs.R @ t_tool)
    shift = R_base @ (motions[:, 3:] - arm @ motions[:, :3])
    turn = R_base @ motions[:, :3] * pairs.oriented[:, None, None]
    return np.concatenate([shift, turn], axis=1)


def tool_motions_by_step(motion: Array, frames: Array, pairs: PosePairs) -> Array:
    """Return the derivative of tool motions by platform motions (n, 6) by a step, (n, 6, 12).

    Without it the fit creeps where measurements are far more precise than the model.
    """
    moved = tool_motions(motion[..., None], frames, pairs)[..., 0]
    R_base, _, _, _ = components_of(frames)
    J = np.zeros((len(pairs), 6, N_STEP))
    J[:, :3, 3:6], J[:, 3:, 3:6] = -cross_matrices(moved[:, :3]), -cross_matrices(moved[:, 3:])
    J[:, :3, 6:9] = R_base @ cross_matrices(motion[:, :3]) @ pairs.R
    return J


# The search


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
    starts = list(_with_positions(everywhere, _tool_orientation(everywhere, pairs), pairs))
    if pairs.oriented.any():
        starts.append(_solve_by_kronecker(pairs))
    rows: list[BoolArray] = [np.ones(n, dtype=np.bool_)] * len(starts)
    size = max(_SUBSET, fewest)
    for k in range(subsets if n > size else 0):
        chosen = np.sort(rng.choice(n, size, replace=False)).astype(np.intp)
        subset, R_base = pairs.of(chosen), everywhere[k % len(everywhere)]
        if subset.oriented.sum() >= 3:
            starts.append(_solve_by_kronecker(subset))
        else:
            starts.append(_with_positions(R_base, _tool_orientation(R_base, subset), subset))
        rows.append(np.isin(np.arange(n), chosen))
    return np.array(starts), np.array(rows)


def _solve_by_kronecker(
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
    return _with_positions(R_base, R_tool, pairs)


def _with_positions(
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
    of_readings: Callable[[IntArray], Iterable[tuple[PosePairs, str, str]]],  # in some rows
) -> tuple[str, str] | None:
    """Return a description of the likeliest mistake and its remedy, or None."""
    best, mistake = cost / _spread(pairs) / _BETTER**2, None
    rows = np.linspace(0, len(pairs) - 1, min(len(pairs), _MISTAKE_ROWS)).astype(np.intp)
    for changed, looks_like, remedy in chain(_alternatives(pairs.of(rows)), of_readings(rows)):
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
    """Yield the poses with each mistake in them undone, what it is, and its remedy."""
    has_orientations = bool(pairs.oriented.any())
    for size, unit, remedy in _LENGTHS:
        yield replace(pairs, p=size * pairs.p), f"positions in {unit}", remedy
    mirror = np.diag([1.0, 1.0, -1.0])
    name = "left-handed axes, a mirror image", "give poses in right-handed axes"
    yield replace(pairs, p=pairs.p @ mirror, M=mirror @ pairs.M @ mirror), *name
    if not has_orientations:
        return
    wrong_order = "quaternions in the order w, x, y, z", "write qx, qy, qz, qw under their names"
    as_read = Rotation.from_matrix(pairs.M).as_quat()
    reordered = Rotation.from_quat(as_read[:, [1, 2, 3, 0]]).as_matrix()
    yield replace(pairs, M=reordered), *wrong_order
    back = np.swapaxes(pairs.M, 1, 2)
    world = replace(pairs, M=back, p=-np.einsum("nij,nj->ni", back, pairs.p))
    yield world, "poses of the world in the tool", "give those of the tool in the world"
