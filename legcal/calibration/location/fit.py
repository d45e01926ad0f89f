"""The most likely frames, and how precise the measurement is (restricted maximum likelihood).

Frames and variances are estimated in turn: frames by Gauss-Newton with the covariance of the rows;
the standard deviations that nobody stated, and errors of the model that all rows share, so that
residuals are most likely given what the frames take away (REML).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from legcal import estimation
from legcal.calibration.location.frames import (
    N_FRAME,
    Frames,
    Noise,
    PosePairs,
    jacobian,
    residuals,
)
from legcal.calibration.location.problem import PlatformMotions
from legcal.estimation import Factor, GaussianPrior, Rows, Variables, all_free, minimise
from legcal.geometry import Array

System = Callable[[Frames], tuple[Array, Array]]
HOLD_STEPS = 60
_SMALL = 1e-12
_RESOLVED = 1e-3  # of a unit direction
ROUNDS = 30  # of frames and variances in turn
REML_STEPS = 300
SINGULAR = 1e-9  # of the largest singular value: what is below is open
_SAME_FACTOR = 1e-7
_LARGEST_TURN = (0.5, 0.5, 0.5, np.inf, np.inf, np.inf)  # [rad] in one step
_TURN_FIRST = [3, 4, 5, 0, 1, 2]


@dataclass(frozen=True, eq=False)
class Fit:
    """The most likely frames."""

    frames: Frames  # where the base and the tool are
    noise: Noise  # with the factors that were stated or estimated
    # (n, 6): what is left of the rows, along world axes [m, rad], errors of the model taken out
    residuals: Array
    whitened: Array  # (n, 6): the same in standard deviations
    # (n * 6 + k, 12 + k): whitened derivative by a step in units of ``pairs.scale``, and by the k
    # errors of the model, whose priors are the last rows
    design: Array
    chi2: float  # sum of the squares of whitened residuals and errors of the model
    dof: int  # measured numbers less those found
    # (2,): degrees of freedom that the variances of positions and of orientations rest on
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


def fit(
    pairs: PosePairs,
    # within the basin of the answer; where the rows leave a direction open it stays there
    start: Frames,
    noise: Noise,  # standard deviations; factors of kinds that are not stated are estimated
    motions: PlatformMotions | None = None,  # what errors of the model do
) -> Fit:
    """Return the most likely frames near a start.

    Raises DidNotConverge if the steps do not end.
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


@dataclass(frozen=True, eq=False)
class _State:
    """What the fit moves: T_world_base, T_platform_tool, errors of the model in their sigmas."""

    base: estimation.Frames
    tool: estimation.Frames
    errors: Array


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


def system(
    pairs: PosePairs, frames: Frames, noise: Noise, motions: PlatformMotions | None = None
) -> tuple[Array, Array]:
    """Return whitened residuals and their design, priors of errors of the model below."""
    return _whitened(*_unweighted(pairs, frames, motions), noise.whitening(pairs.oriented))


def frame_design(design: Array) -> Array:
    """Return the columns (m, 12) of the frames without what errors of the model can explain."""
    F, E = design[:, :N_FRAME], design[:, N_FRAME:]
    if E.shape[1] == 0:
        return F
    Q, _ = np.linalg.qr(E)
    return np.asarray(F - Q @ (Q.T @ F))


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


def _least_squares(A: Array, y: Array) -> Array:
    """Return the smallest solution of least squares; open directions do not move."""
    return np.asarray(np.linalg.lstsq(A, y, rcond=SINGULAR)[0])


def hold_tool(
    frames: Frames,
    pairs: PosePairs,
    basis_at: Callable[[Frames], Array],  # returns the open directions (12, k) at frames
    system: System,  # returns whitened residuals (m,) and design (m, 12 + p) at frames
    tool_position: Array,  # (3,): in the platform [m]
) -> Frames:
    """Return the most likely frames whose open part is that of a tool at a given position.

    Along open directions the tool is brought as near to the given position, and to the axes of the
    platform, as they allow; all else stays most likely.
    """
    for _ in range(HOLD_STEPS):
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


def is_resolved_by_the_tool(basis: Array) -> bool:
    """Say whether every open direction (12, k) moves the tool, so that holding it closes all."""
    s = np.linalg.svd(basis[6:], compute_uv=False)
    return bool(np.all(s > _RESOLVED)) and len(s) >= basis.shape[1]


def kept_directions(basis: Array) -> Array:
    """Return the directions (12, 12 - k) that do not move the held part of the tool."""
    held = basis.copy()
    held[:6] = 0.0
    U, s, _ = np.linalg.svd(held, full_matrices=True)
    return np.asarray(U[:, int(np.sum(s > 0.0)) :])


def covariance_with(
    information: Array,  # (12, 12): of a step in the same units
    basis: Array,  # (12, k): open directions
    *,
    oriented: bool,  # whether the orientation of the tool is known; else its rows are zero
) -> Array:
    """Return the covariance (12, 12) of a step, what is held counted as known."""
    Z = kept_directions(basis) if basis.shape[1] else np.eye(N_FRAME)
    if not oriented:
        U, s, _ = np.linalg.svd(Z[:9], full_matrices=False)
        Z = np.zeros((N_FRAME, int(np.sum(s > _RESOLVED))))
        Z[:9] = U[:, s > _RESOLVED]
    return np.asarray(Z @ np.linalg.solve(Z.T @ information @ Z, Z.T))
