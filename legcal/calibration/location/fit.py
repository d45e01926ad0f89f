"""The most likely frames, how precise the measurement is, and which rows are inliers.

Frames and variances are estimated in turn: frames by least squares with the covariance of the rows;
the standard deviations that nobody stated, and errors of the model that all rows share, so that
residuals are most likely given what the frames take away (restricted maximum likelihood).

Outliers are found from the inside out (forward search): the search starts at the rows that agree
best and takes in one after the other, the next best first, as long as it lies where those inside
predict it, at the scatter that they show. One wrong row never decides about another.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc, fdtrc

from legcal.calibration.location.frames import (
    N_STEP,
    PosePairs,
    frames_after,
    frames_from,
    jacobian,
    residuals,
    tool_motions,
)
from legcal.calibration.location.search import kept_rows
from legcal.calibration.location.tool_poses import PoseNoise, ToolMeasurements
from legcal.estimation.problem import (
    EstimationProblem,
    Factor,
    Frames,
    GaussianPrior,
    Residuals,
    Variables,
    all_free,
)
from legcal.estimation.solver import minimise
from legcal.geometry.types import Array, BoolArray, IntArray

RANK_TOLERANCE = 1e-9  # of the largest singular value: what is below is open
_MAX_ROUNDS = 30  # of frames and variances in turn
_READING_ROUNDS = 3  # of frames and what errors of the readings do to the tool
_MAX_REML_ITERATIONS = 300
_FACTOR_TOLERANCE = 1e-7
_MAX_STEP = (0.5, 0.5, 0.5, np.inf, np.inf, np.inf)  # turn [rad], displacement [m]
_TURN_FIRST = [3, 4, 5, 0, 1, 2]  # components of a step as those of estimation.Frames
_MAX_HOLD_ROUNDS = 60
_HOLD_TOLERANCE = 1e-12
FALSE_ALARM = 1e-3  # probability that a row of a good file is left out
_LIKELY = 0.05  # rows at least as likely come in together
_UNKNOWN = 1e-15  # of the largest information: of directions that those inside do not know
_MIN_DOF = 1.0  # for a scatter


@dataclass(frozen=True, eq=False)
class FrameFit:
    """The most likely frames."""

    frames: Array  # (2, 3, 4)
    noise: PoseNoise  # with the factors that were stated or estimated
    whitened: Array  # (n, 6): residuals in standard deviations, errors of the model taken out
    # (n * 6 + k, 12 + k): whitened derivative by a step in units of ``pairs.scale``, and by the k
    # errors of the model, whose priors are the last rows
    design: Array
    chi2: float  # sum of the squares of whitened residuals and errors of the model
    dof: int  # measured numbers less those estimated
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


def fit_measurements(measurements: ToolMeasurements, start: Array) -> FrameFit:
    """Return the most likely frames of measurements, from a start.

    Errors of the readings move the tool through the frames that are estimated: their covariance
    follows the frames.
    """
    o = measurements
    found = fit(o.pairs, start, o.noise_at(start), o.by_model)
    for _ in range(_READING_ROUNDS if o.by_readings is not None else 0):
        found = fit(o.pairs, found.frames, o.noise_at(found.frames), o.by_model)
    return found


def fit(
    pairs: PosePairs,
    # within the basin of the answer; where the rows leave a direction open it stays there
    start: Array,
    noise: PoseNoise,  # standard deviations; factors of kinds that are not stated are estimated
    motions: Array | None = None,  # (n, 6, k): platform motions by errors of the model
) -> FrameFit:
    """Return the most likely frames near a start.

    Raises DidNotConverge if the steps do not end.
    """
    frames = start
    for _ in range(_MAX_ROUNDS):
        frames = _most_likely(pairs, frames, noise, motions)
        if all(noise.stated):
            break
        factor, _ = _variances(pairs, frames, noise, motions)
        converged = np.abs(factor / noise.factor - 1.0).max() < _FACTOR_TOLERANCE
        noise = noise.scaled(factor)
        if converged:
            break
    return fit_at(pairs, frames, noise, motions)


def fit_at(
    pairs: PosePairs, frames: Array, noise: PoseNoise, motions: Array | None = None
) -> FrameFit:
    """Return the fit at frames and noise that are most likely already."""
    y, A = _whitened(
        *_unweighted(pairs, frames, motions), noise.whitening(pairs.oriented)
    )  # errors of the model are not yet known
    left = y - A @ np.linalg.lstsq(A, y, rcond=RANK_TOLERANCE)[0]
    _, dof = _variances(pairs, frames, replace(noise, stated=(True, True)), motions)
    s = np.linalg.svd(A, compute_uv=False)
    rank = int(np.sum(s > RANK_TOLERANCE * s[0])) - (A.shape[1] - N_STEP)
    return FrameFit(
        frames=frames,
        noise=noise,
        whitened=left[: 6 * len(pairs)].reshape(-1, 6),
        design=A,
        chi2=float(left @ left),
        dof=3 * len(pairs) + 3 * int(pairs.oriented.sum()) - rank,
        kind_dof=dof,
    )


@dataclass(frozen=True, eq=False)
class _State:
    """T_world_base, T_platform_tool, errors of the model in their standard deviations."""

    base: Frames
    tool: Frames
    errors: Array


def _most_likely(
    pairs: PosePairs,
    frames: Array,
    noise: PoseNoise,
    motions: Array | None,
    fixed: Array | None = None,  # (12, k): directions in units of ``pairs.scale`` that do not move
) -> Array:
    """Return the frames of least squares at given variances; open directions stay."""
    n = len(pairs)
    k = 0 if motions is None else motions.shape[-1]

    def frames_in(state: _State) -> Array:
        return frames_from(state.base.R[0], state.base.t[0], state.tool.R[0], state.tool.t[0])

    def rows_of(state: _State) -> Residuals:
        there = frames_in(state)
        J = jacobian(there, pairs)
        by_model = np.zeros((n, 6, 0)) if motions is None else tool_motions(motions, there, pairs)
        blocks = J[..., :6][..., _TURN_FIRST], J[..., 6:][..., _TURN_FIRST], by_model
        r = by_model @ state.errors - residuals(there, pairs)
        return Residuals.of(r, np.concatenate(blocks, axis=-1))

    one, whole = np.zeros(n, dtype=np.intp), slice(None)
    errors = np.arange(k, dtype=np.intp)
    held = np.zeros((0, N_STEP))
    if fixed is not None:
        held = (fixed / pairs.scale[:, None]).T.reshape(-1, 2, 6)[..., _TURN_FIRST]
    problem = EstimationProblem[_State](
        variables=(
            Variables("base", all_free(1, 6), Frames.moved, max_step=_MAX_STEP),
            Variables("tool", all_free(1, 6), Frames.moved, max_step=_MAX_STEP),
            Variables(
                "errors", all_free(k, 1), prior=GaussianPrior(errors, np.zeros(k), np.ones(k))
            ),
        ),
        eliminated=None,
        factors=(
            Factor(
                "poses",
                rows_of,
                (
                    ("base", one, whole),
                    ("tool", one, whole),
                    ("errors", np.tile(errors, (n, 1)), whole),
                ),
                n,
                6,
                whitening=noise.whitening(pairs.oriented),
            ),
        ),
        held_directions=held.reshape(-1, N_STEP),
        name="fit of the frames",
        remedy="check that readings and poses belong together",
    )
    base, tool = (Frames(F[None, :, :3], F[None, :, 3]) for F in frames)
    return frames_in(minimise(problem, _State(base, tool, np.zeros(k))).state)


def _variances(
    pairs: PosePairs, frames: Array, noise: PoseNoise, motions: Array | None
) -> tuple[Array, Array]:
    """Return the factors of restricted likelihood (2,), and their degrees of freedom (2,).

    With P = S^-1 - S^-1 A (A^T S^-1 A)^-1 A^T S^-1 a variance v of kind D is where
    y^T P D P y = tr(P D): v is multiplied with the ratio of both until that is one. Stated ones
    stay.
    """
    factor, dof = noise.factor, np.zeros(2)
    base = np.repeat(noise.sigma, 3, axis=1)
    raw = _unweighted(pairs, frames, motions)
    for _ in range(_MAX_REML_ITERATIONS):
        W = noise.scaled(factor).whitening(pairs.oriented)
        y, A = _whitened(*raw, W)
        U, s, _ = np.linalg.svd(A, full_matrices=False)
        U = U[:, s > RANK_TOLERANCE * s[0]]
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
        after = np.maximum(factor * ratio, np.where(noise.stated, factor, noise.min_factor))
        converged = bool(np.abs(after / factor - 1.0).max() < 0.1 * _FACTOR_TOLERANCE)
        factor = after
        if converged:
            break
    return factor, dof


def frame_design_at(
    pairs: PosePairs, frames: Array, noise: PoseNoise, motions: Array | None
) -> Array:
    """Return the whitened columns (m, 12) of the frames, errors of the model eliminated."""
    raw = _unweighted(pairs, frames, motions)
    return frame_design(_whitened(*raw, noise.whitening(pairs.oriented))[1])


def frame_design(design: Array) -> Array:
    """Return the columns (m, 12) of the frames without what errors of the model can explain."""
    F, E = design[:, :N_STEP], design[:, N_STEP:]
    if E.shape[1] == 0:
        return F
    Q, _ = np.linalg.qr(E)
    return np.asarray(F - Q @ (Q.T @ F))


def _unweighted(pairs: PosePairs, frames: Array, motions: Array | None) -> tuple[Array, Array]:
    """Return residuals (n, 6) and their design (n, 6, 12 + k)."""
    design = jacobian(frames, pairs) * pairs.scale
    if motions is not None:
        design = np.concatenate([design, tool_motions(motions, frames, pairs)], axis=2)
    return residuals(frames, pairs), design


def _whitened(r: Array, design: Array, W: Array) -> tuple[Array, Array]:
    """Return residuals and design in standard deviations, with the priors below."""
    y, A = (W @ r[:, :, None]).ravel(), (W @ design).reshape(r.size, -1)
    k = A.shape[1] - N_STEP
    if k == 0:
        return y, A
    priors = np.hstack([np.zeros((k, N_STEP)), np.eye(k)])
    return np.concatenate([y, np.zeros(k)]), np.vstack([A, priors])


def hold_tool(
    measurements: ToolMeasurements,
    found: FrameFit,
    open_at: Callable[[Array], Array],  # returns the open directions (12, k) at frames
    tool_position: Array,  # (3,): in the platform [m]
) -> FrameFit:
    """Return the most likely frames whose open part is that of a tool at a given position.

    Along open directions the tool is brought as near to the given position, and to the axes of the
    platform, as they allow; all else stays most likely.
    """
    pairs, frames = measurements.pairs, found.frames
    for _ in range(_MAX_HOLD_ROUNDS):
        basis = open_at(frames)
        turn = Rotation.from_matrix(frames[1, :, :3]).inv().as_rotvec()
        away = np.concatenate([(tool_position - frames[1, :, 3]) / pairs.length, turn])
        slide = basis @ np.linalg.lstsq(basis[6:], away, rcond=None)[0]
        size = float(np.linalg.norm(slide[[3, 4, 5, 9, 10, 11]]))
        frames = frames_after(frames, slide * min(1.0, 0.5 / max(size, 1e-300)) * pairs.scale)
        of_tool = np.concatenate([np.zeros_like(basis[:6]), basis[6:]])
        frames = _most_likely(pairs, frames, found.noise, measurements.by_model, of_tool)
        if np.abs(slide).max() < _HOLD_TOLERANCE:
            break
    return fit_at(pairs, frames, found.noise, measurements.by_model)


@dataclass(frozen=True, eq=False)
class Inliers:
    """Which rows agree, and how far off the others are."""

    is_inlier: BoolArray  # (n,): the rows to use
    # distance, angle: (n,): how far each row is from where the inliers predict it [m, rad]
    distance: Array
    angle: Array
    frames: Array  # by the inliers
    factor: Array  # (2,): the scatter of the inliers, as a factor of :class:`PoseNoise`


def find_inliers(measurements: ToolMeasurements, start: Array) -> Inliers:
    """Return which rows agree with each other, from frames that most rows agree with.

    A row is never left out for what stated standard deviations allow.
    """
    pairs, noise = measurements.pairs, measurements.noise
    n = len(pairs)
    distance = ((residuals(start, pairs) * pairs.unit) ** 2).sum(axis=1)
    inside = np.zeros(n, dtype=np.bool_)
    inside[np.argsort(distance, kind="stable")[: kept_rows(n, measurements.fewest)]] = True
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
    return Inliers(
        inside,
        np.linalg.norm(r[:, :3], axis=1),
        np.linalg.norm(r[:, 3:], axis=1),
        frames,
        found.noise.factor,
    )


def _fit_to(pairs: PosePairs, start: Array, noise: PoseNoise) -> FrameFit:
    """Return the fit of some rows at the scatter that they show, at least at the stated one."""
    found = fit(pairs, start, replace(noise, stated=(False, False), readings=None))
    least = np.where(noise.stated, noise.factor, 0.0)
    return replace(found, noise=found.noise.scaled(np.maximum(found.noise.factor, least)))


def _probability(
    pairs: PosePairs, noise: PoseNoise, found: FrameFit, stated: tuple[bool, bool]
) -> Array:
    """Return how probable rows as far off as these are, given those of a fit, (n,)."""
    sigma = noise.scaled(found.noise.factor).standard_deviations()
    H = found.information
    H = H + _UNKNOWN * float(np.linalg.norm(H, 2)) * np.eye(len(H))
    J = jacobian(found.frames, pairs) * pairs.scale
    covariance = J @ np.linalg.solve(H, np.swapaxes(J, 1, 2))
    covariance[:, range(6), range(6)] += sigma**2
    r = residuals(found.frames, pairs)
    least = np.ones(len(pairs))
    for kind, rows in enumerate((slice(0, 3), slice(3, 6))):
        dof = float(found.kind_dof[kind])
        at_stated = stated[kind] and bool(found.noise.factor[kind] <= noise.factor[kind])
        if dof < _MIN_DOF and not at_stated:
            continue
        part = np.linalg.solve(covariance[:, rows, rows], r[:, rows, None])[:, :, 0]
        distance = (part * r[:, rows]).sum(axis=1)
        # Not F with infinite degrees of freedom: SciPy has no number for that.
        here = chdtrc(3, distance) if at_stated else fdtrc(3, dof, distance / 3.0)
        least = np.minimum(least, np.where(pairs.oriented | (kind == 0), here, 1.0))
    return np.minimum(1.0, 2.0 * least)
