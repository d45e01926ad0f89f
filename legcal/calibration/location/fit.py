"""Rows that disagree with the others, found from the inside out (forward search).

The search starts at the rows that agree best and takes in one after the other, the next best
first, as long as it lies where those inside foretell it, at the scatter that they show. What stays
outside is named. One wrong row never decides about another.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy import stats
from scipy.spatial.transform import Rotation

from legcal import estimation
from legcal.calibration.location.model import (
    N_FRAME,
    Frames,
    Noise,
    PosePairs,
    jacobian,
    residuals,
    stacked,
)
from legcal.calibration.location.problem import PlatformMotions
from legcal.estimation import Factor, GaussianPrior, Rows, Variables, all_free, minimise
from legcal.geometry import Array, BoolArray, IntArray, nearest_rotation

System = Callable[[Frames], tuple[Array, Array]]
STEPS = 60
_SMALL = 1e-12
_RESOLVED = 1e-3  # of a unit direction


def is_resolved_by_the_tool(basis: Array) -> bool:
    """Say whether every open direction (12, k) moves the tool, so that holding it closes all."""
    s = np.linalg.svd(basis[6:], compute_uv=False)
    return bool(np.all(s > _RESOLVED)) and len(s) >= basis.shape[1]


def hold_tool(
    frames: Frames,
    pairs: PosePairs,
    basis_at: Callable[[Frames], Array],
    system: System,
    tool_position: Array,
) -> Frames:
    """Return the most likely frames whose open part is that of a tool at a given position.

    Along open directions the tool is brought as near to the given position, and to the axes of
    the platform, as they allow; all else stays most likely.

    Parameters
    ----------
    frames : Frames
        Most likely ones.
    pairs : PosePairs
        What was measured.
    basis_at : callable
        Returns the open directions (12, k) at frames.
    system : callable
        Returns whitened residuals (m,) and design (m, 12 + p) at frames.
    tool_position : (3,) array
        In the platform [m].
    """
    for _ in range(STEPS):
        N = basis_at(frames)
        turn = Rotation.from_matrix(frames.R_tool).inv().as_rotvec()
        away = np.concatenate([(tool_position - frames.t_tool) / pairs.length, turn])
        slide = N @ np.linalg.lstsq(N[6:], away, rcond=None)[0]
        y, A = system(frames)
        Z = kept_directions(N)
        A_kept = np.hstack([A[:, :N_FRAME] @ Z, A[:, N_FRAME:]])
        found = np.linalg.lstsq(A_kept, y - A[:, :N_FRAME] @ slide, rcond=None)[0]
        step = slide + Z @ found[: Z.shape[1]]
        size = float(np.linalg.norm(step[[3, 4, 5, 9, 10, 11]]))
        frames = frames.moved(step * min(1.0, 0.5 / max(size, 1e-300)) * pairs.scale)
        if np.abs(step).max() < _SMALL:
            break
    return frames


def kept_directions(basis: Array) -> Array:
    """Return the directions (12, 12 - k) that do not move the held part of the tool."""
    held = basis.copy()
    held[:6] = 0.0
    U, s, _ = np.linalg.svd(held, full_matrices=True)
    return np.asarray(U[:, int(np.sum(s > 0.0)) :])


def covariance_with(information: Array, basis: Array, *, oriented: bool) -> Array:
    """Return the covariance (12, 12) of a step, what is held counted as known.

    Parameters
    ----------
    information : (12, 12) array
        Of a step in the same units.
    basis : (12, k) array
        Open directions.
    oriented : bool
        Whether the orientation of the tool is known; else its rows are zero.
    """
    Z = kept_directions(basis) if basis.shape[1] else np.eye(N_FRAME)
    if not oriented:
        U, s, _ = np.linalg.svd(Z[:9], full_matrices=False)
        Z = np.zeros((N_FRAME, int(np.sum(s > _RESOLVED))))
        Z[:9] = U[:, s > _RESOLVED]
    return np.asarray(Z @ np.linalg.solve(Z.T @ information @ Z, Z.T))


def solve_by_opencv(pairs: PosePairs) -> Frames | None:
    """Return the frames that OpenCV finds, or None where it finds none or has no solver.

    Parameters
    ----------
    pairs : PosePairs
        Rows without an orientation are left out.
    """
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


def solve_by_kronecker(pairs: PosePairs) -> Frames:
    """Return the frames by the largest singular pair of sum_i R_i (x) M_i.

    From M_i R_tool^T R_i^T = R_base follows (R_i (x) M_i) vec(R_tool^T) = vec(R_base). Where
    rotations leave the orientations open, some solution among many is returned.

    Parameters
    ----------
    pairs : PosePairs
        Rows without an orientation serve for positions only; one row has to have one.
    """
    rows = pairs.of(pairs.oriented)
    K = np.einsum("nij,nkl->ikjl", rows.R, rows.M).reshape(9, 9)
    U, _, Vt = np.linalg.svd(K)
    R_base, R_tool = U[:, 0].reshape(3, 3).T, Vt[0].reshape(3, 3)  # columns first
    sign = 1.0 if np.linalg.det(R_tool) >= 0.0 else -1.0
    R_base, R_tool = nearest_rotation(sign * R_base), nearest_rotation(sign * R_tool)
    return with_positions(R_base, R_tool, pairs)


def with_positions(R_base: Array, R_tool: Array, pairs: PosePairs) -> Frames:
    """Return frames of known orientations with the positions of linear least squares.

    Parameters
    ----------
    R_base, R_tool : (..., 3, 3) array
        Orientations of T_world_base and T_platform_tool.
    pairs : PosePairs
        What the positions are to agree with; the smallest ones where these leave some open.
    """
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


ROUNDS = 30  # of frames and variances in turn
REML_STEPS = 300
SINGULAR = 1e-9  # of the largest singular value: what is below is open
_SAME_FACTOR = 1e-7
_LARGEST_TURN = (0.5, 0.5, 0.5, np.inf, np.inf, np.inf)  # [rad] in one step


@dataclass(frozen=True, eq=False)
class Fit:
    """The most likely frames.

    Attributes
    ----------
    frames : Frames
        Where the base and the tool are.
    noise : Noise
        With the factors that were stated or estimated.
    residuals : (n, 6) array
        What is left of the rows, along world axes [m, rad], errors of the model taken out.
    whitened : (n, 6) array
        The same in standard deviations.
    design : (n * 6 + k, 12 + k) array
        Whitened derivative by a step in units of ``pairs.scale``, and by the k errors of the
        model, whose priors are the last rows.
    chi2 : float
        Sum of the squares of whitened residuals and errors of the model.
    dof : int
        Measured numbers less those found.
    kind_dof : (2,) array
        Degrees of freedom that the variances of positions and of orientations rest on.
    """

    frames: Frames
    noise: Noise
    residuals: Array
    whitened: Array
    design: Array
    chi2: float
    dof: int
    kind_dof: Array

    @property
    def frame_design(self) -> Array:
        """The columns of the frames, errors of the model eliminated, (m, 12)."""
        return frame_design(self.design)

    @property
    def information(self) -> Array:
        """Inverse covariance of a step in units of ``pairs.scale``, (12, 12)."""
        F = self.frame_design
        return np.asarray(F.T @ F)


def frame_design(design: Array) -> Array:
    """Return the columns (m, 12) of the frames without what errors of the model can explain."""
    F, E = design[:, :N_FRAME], design[:, N_FRAME:]
    if E.shape[1] == 0:
        return F
    Q, _ = np.linalg.qr(E)
    return np.asarray(F - Q @ (Q.T @ F))


def fit(
    pairs: PosePairs, start: Frames, noise: Noise, motions: PlatformMotions | None = None
) -> Fit:
    """Return the most likely frames near a start.

    Parameters
    ----------
    pairs : PosePairs
        What was measured.
    start : Frames
        Within the basin of the answer; where the rows leave a direction open it stays there.
    noise : Noise
        Standard deviations; factors of kinds that are not stated are estimated.
    motions : PlatformMotions, optional
        What errors of the model do.

    Raises
    ------
    DidNotConverge
        If the steps do not end.
    """
    frames = start
    is_free = not all(noise.stated)
    for _ in range(ROUNDS):
        frames = _most_likely(pairs, frames, noise, motions)
        if not is_free:
            break
        factor, _ = variances(pairs, frames, noise, motions)
        settled = np.abs(factor / noise.factor - 1.0).max() < _SAME_FACTOR
        noise = noise.scaled(factor)
        if settled:
            break
    return finished(pairs, frames, noise, motions)


@dataclass(frozen=True, eq=False)
class _State:
    """What the fit moves: T_world_base, T_platform_tool, errors of the model in their sigmas."""

    base: estimation.Frames
    tool: estimation.Frames
    errors: Array


_TURN_FIRST = [3, 4, 5, 0, 1, 2]


def _most_likely(
    pairs: PosePairs, frames: Frames, noise: Noise, motions: PlatformMotions | None
) -> Frames:
    """Return the frames of least squares, variances held; open directions stay where they are."""
    n = len(pairs)

    def frames_of(state: _State) -> Frames:
        return Frames(state.base.R[0], state.base.t[0], state.tool.R[0], state.tool.t[0])

    def rows_of(state: _State) -> Rows:
        there = frames_of(state)
        r, J = -residuals(there, pairs), jacobian(there, pairs)
        by_model = np.zeros((n, 6, 0)) if motions is None else motions.of_tool(there, pairs)
        turned_first = J[..., :6][..., _TURN_FIRST], J[..., 6:][..., _TURN_FIRST]
        return Rows.of(
            r + by_model @ state.errors, np.concatenate([*turned_first, by_model], axis=-1)
        )

    k = 0 if motions is None else motions.of_tool(frames, pairs).shape[-1]
    one, whole = np.zeros(n, dtype=np.intp), slice(None)
    every = np.tile(np.arange(k, dtype=np.intp), (n, 1))
    standard = GaussianPrior(np.arange(k, dtype=np.intp), np.zeros(k), np.ones(k))
    problem = estimation.Problem[_State](
        variables=(
            Variables("errors", all_free(k, 1), prior=standard),
            Variables("base", all_free(1, 6), estimation.Frames.moved, largest=_LARGEST_TURN),
            Variables("tool", all_free(1, 6), estimation.Frames.moved, largest=_LARGEST_TURN),
        ),
        eliminated=None,
        factors=(
            Factor(
                "poses",
                rows_of,
                (("base", one, whole), ("tool", one, whole), ("errors", every, whole)),
                n,
                6,
                whitening=noise.whitening(pairs.oriented),
            ),
        ),
        name="fit of the frames",
        remedy="check that readings and poses belong together",
    )
    start = _State(
        estimation.Frames(frames.R_base[None], frames.t_base[None]),
        estimation.Frames(frames.R_tool[None], frames.t_tool[None]),
        np.zeros(k),
    )
    return frames_of(minimise(problem, start).state)


def _least_squares(A: Array, y: Array) -> Array:
    """Return the smallest solution of least squares; open directions do not move."""
    return np.asarray(np.linalg.lstsq(A, y, rcond=SINGULAR)[0])


def system(
    pairs: PosePairs, frames: Frames, noise: Noise, motions: PlatformMotions | None = None
) -> tuple[Array, Array]:
    """Return whitened residuals and their design, priors of errors of the model below."""
    return _whitened(*_unweighted(pairs, frames, motions), noise.whitening(pairs.oriented))


def _unweighted(
    pairs: PosePairs, frames: Frames, motions: PlatformMotions | None
) -> tuple[Array, Array]:
    """Return residuals (n, 6) and their design (n, 6, 12 + k)."""
    design = jacobian(frames, pairs) * pairs.scale
    if motions is not None:
        design = np.concatenate([design, motions.of_tool(frames, pairs)], axis=2)
    return residuals(frames, pairs), design


def _whitened(r: Array, design: Array, W: Array) -> tuple[Array, Array]:
    """Return residuals and design in standard deviations, with the priors below."""
    y, A = (W @ r[:, :, None]).ravel(), (W @ design).reshape(r.size, -1)
    k = A.shape[1] - N_FRAME
    if k == 0:
        return y, A
    priors = np.hstack([np.zeros((k, N_FRAME)), np.eye(k)])
    return np.concatenate([y, np.zeros(k)]), np.vstack([A, priors])


def variances(
    pairs: PosePairs, frames: Frames, noise: Noise, motions: PlatformMotions | None = None
) -> tuple[Array, Array]:
    """Return the factors of restricted likelihood (2,), and their degrees of freedom (2,).

    With P = S^-1 - S^-1 A (A^T S^-1 A)^-1 A^T S^-1 a variance v of kind D is where
    y^T P D P y = tr(P D): v is multiplied with the ratio of both until that is one. Stated ones
    stay.
    """
    factor, dof = noise.factor, np.zeros(2)
    base = np.repeat(noise.sigma, 3, axis=1)
    floor = noise.floor
    raw = _unweighted(pairs, frames, motions)
    for _ in range(REML_STEPS):
        W = noise.scaled(factor).whitening(pairs.oriented)
        y, A = _whitened(*raw, W)
        U, s, _ = np.linalg.svd(A, full_matrices=False)
        U = U[:, s > SINGULAR * s[0]]
        left = (y - U @ (U.T @ y))[: base.size].reshape(base.shape)
        back = np.swapaxes(W, 1, 2)
        Py = (back @ left[:, :, None])[:, :, 0] * base
        spread = back @ U[: base.size].reshape(*base.shape, -1) * base[:, :, None]
        diagonal = (W**2).sum(axis=1) * base**2 - (spread**2).sum(axis=2)
        squares = (Py**2).reshape(-1, 2, 3).sum(axis=(0, 2))
        traces = diagonal.reshape(-1, 2, 3).sum(axis=(0, 2))
        dof = factor**2 * traces
        ratio = np.sqrt(squares / np.maximum(traces, 1e-300))
        ratio[list(noise.stated)] = 1.0
        ratio[dof < 1e-6] = 1.0
        after = np.maximum(factor * ratio, np.where(noise.stated, factor, floor))
        done = bool(np.abs(after / factor - 1.0).max() < 0.1 * _SAME_FACTOR)
        factor = after
        if done:
            break
    return factor, dof


def finished(
    pairs: PosePairs, frames: Frames, noise: Noise, motions: PlatformMotions | None = None
) -> Fit:
    """Return the fit that has come to rest at frames and noise."""
    y, A = system(pairs, frames, noise, motions)
    n = 6 * len(pairs)
    found = _least_squares(A, y)
    left = y - A @ found
    _, dof = variances(pairs, frames, replace(noise, stated=(True, True)), motions)
    s = np.linalg.svd(A, compute_uv=False)
    rank = int(np.sum(s > SINGULAR * s[0])) - (A.shape[1] - N_FRAME)
    r = residuals(frames, pairs)
    if motions is not None:
        r = r - (motions.of_tool(frames, pairs) @ found[N_FRAME:])
    return Fit(
        frames=frames,
        noise=noise,
        residuals=r,
        whitened=left[:n].reshape(-1, 6),
        design=A,
        chi2=float(left @ left),
        dof=3 * len(pairs) + 3 * int(pairs.oriented.sum()) - rank,
        kind_dof=dof,
    )


MOST_ROWS = 40  # that starts are tried on
SUBSETS = 30
SUBSET = 4  # rows
AT_FIRST = 8  # steps on the rows that a start came from, and for all starts
MOST_PROMISING = 12  # starts that go on
STEPS_search = 30
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
    frames = _descend(pairs, frames.at(order), STEPS_search, n_kept)
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


FALSE_ALARM = 1e-3  # probability that a row of a good file is left out
_LIKELY = 0.05  # rows at least as likely come in together
_OPEN = 1e-15  # of the largest information: directions that those inside do not know
_ENOUGH = 1.0  # degrees of freedom for a scatter


@dataclass(frozen=True, eq=False)
class Agreement:
    """Which rows agree, and how far off the others are.

    Attributes
    ----------
    agrees : (n,) array of bool
        The rows to use.
    distance, angle : (n,) array
        How far each row is from where the agreeing ones foretell it [m, rad].
    frames : Frames
        The frames by the agreeing rows.
    factor : (2,) array
        The scatter of the agreeing rows, as a factor of :class:`Noise`.
    """

    agrees: BoolArray
    distance: Array
    angle: Array
    frames: Frames
    factor: Array


def find_agreement(pairs: PosePairs, start: Frames, noise: Noise, fewest: int) -> Agreement:
    """Return which rows agree with each other.

    Parameters
    ----------
    pairs : PosePairs
        What was measured.
    start : Frames
        What most rows agree with.
    noise : Noise
        Standard deviations; a row is never left out for what the stated ones allow.
    fewest : int
        Rows that determine the frames.
    """
    n = len(pairs)
    units = np.repeat([1.0 / pairs.length, 1.0], 3)
    apart = (residuals(start, pairs) * units) ** 2
    inside = np.zeros(n, dtype=np.bool_)
    inside[np.argsort(apart.sum(axis=1), kind="stable")[: kept_rows(n, fewest)]] = True
    frames = start
    while True:
        found = _fit_to(pairs.of(inside), frames, noise.of(inside))
        frames = found.frames
        outside: IntArray = np.flatnonzero(~inside)
        if not len(outside):
            break
        likely = _probability(pairs.of(outside), noise.of(outside), found, noise.stated)
        best = int(np.argmax(likely))
        if likely[best] < FALSE_ALARM / n:
            break
        inside[outside[likely > _LIKELY]] = True
        inside[outside[best]] = True
    r = residuals(frames, pairs)
    return Agreement(
        inside,
        np.linalg.norm(r[:, :3], axis=1),
        np.linalg.norm(r[:, 3:], axis=1),
        frames,
        found.noise.factor,
    )


def _fit_to(pairs: PosePairs, start: Frames, noise: Noise) -> Fit:
    """Return the fit of some rows at the scatter that they show, at least at the stated one."""
    found = fit(pairs, start, replace(noise, stated=(False, False), readings=None))
    least = np.where(noise.stated, noise.factor, 0.0)
    return replace(found, noise=found.noise.scaled(np.maximum(found.noise.factor, least)))


def _probability(pairs: PosePairs, noise: Noise, found: Fit, stated: tuple[bool, bool]) -> Array:
    """Return how probable rows as far off as these are, given those of a fit, (n,)."""
    sigma = noise.scaled(found.noise.factor).standard_deviations()
    H = found.information
    H = H + _OPEN * float(np.linalg.norm(H, 2)) * np.eye(len(H))
    J = jacobian(found.frames, pairs) * pairs.scale
    covariance = J @ np.linalg.solve(H, np.swapaxes(J, 1, 2))
    covariance[:, range(6), range(6)] += sigma**2
    r = residuals(found.frames, pairs)
    least = np.ones(len(pairs))
    for kind, rows in enumerate((slice(0, 3), slice(3, 6))):
        dof = float(found.kind_dof[kind])
        at_stated = stated[kind] and bool(found.noise.factor[kind] <= noise.factor[kind])
        if dof < _ENOUGH and not at_stated:
            continue
        part = np.linalg.solve(covariance[:, rows, rows], r[:, rows, None])[:, :, 0]
        distance = (part * r[:, rows]).sum(axis=1)
        # Not F with infinite degrees of freedom: SciPy has no number for that.
        here = stats.chi2.sf(distance, 3) if at_stated else stats.f.sf(distance / 3.0, 3, dof)
        least = np.minimum(least, np.where(pairs.oriented | (kind == 0), here, 1.0))
    return np.minimum(1.0, 2.0 * least)
