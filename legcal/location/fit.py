"""Maximum likelihood: the frames that the measured poses make most likely, and REML variances.

The frames move by Gauss-Newton steps on whitened residuals; errors of the model, if it comes with
a covariance, are looked for beside them with unit priors. Unknown variances are those that the
residuals show once what the fit has taken out of them is allowed for (restricted likelihood).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array
from legcal.location.model_errors import PlatformMotions
from legcal.location.noise import Noise
from legcal.location.pose_pairs import N_FRAME, Frames, PosePairs, jacobian, residuals

STEPS = 50
ROUNDS = 30  # of frames and variances in turn
REML_STEPS = 300
SINGULAR = 1e-9  # of the largest singular value: what is below is open
_SMALL = 1e-12  # [m / length, rad]
_SAME_FACTOR = 1e-7
_HALVINGS = 12
_WORSE = 1e-3  # a sum of squares may become before a step is halved


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


def _most_likely(
    pairs: PosePairs, frames: Frames, noise: Noise, motions: PlatformMotions | None
) -> Frames:
    """Return the frames after Gauss-Newton, variances held; steps that do not help are halved."""
    y, A = system(pairs, frames, noise, motions)
    for _ in range(STEPS):
        step, before = _least_squares(A, y)[:N_FRAME], _profile(A, y)
        for _ in range(_HALVINGS):
            tried = frames.moved(step * pairs.scale)
            y_tried, A_tried = system(pairs, tried, noise, motions)
            if _profile(A_tried, y_tried) <= (1.0 + _WORSE) * before + _WORSE:
                break
            step = 0.5 * step
        frames, y, A = tried, y_tried, A_tried
        if np.abs(step).max() < _SMALL + 1e-8 * _typical(A):
            return frames
    raise DidNotConverge(
        "The frames could not be found: the fit still moved after "
        f"{STEPS} steps, needed a minimum; check that readings and poses belong together."
    )


def _profile(A: Array, y: Array) -> float:
    """Return the sum of squares at some frames, the likeliest errors of the model taken out."""
    E = A[:, N_FRAME:]
    left = y - E @ np.linalg.lstsq(E, y, rcond=None)[0] if E.shape[1] else y
    return float(left @ left)


def _typical(A: Array) -> float:
    """Return a typical standard deviation of what is best known."""
    return float(1.0 / max(np.linalg.norm(A[:, :N_FRAME], axis=0).max(), 1e-300))


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
