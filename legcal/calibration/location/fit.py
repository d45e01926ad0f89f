"""The most likely frames, the noise of the measurement, and the inliers among the rows.

Frames and variances are estimated in turn: frames, and errors of the model that all rows share, by
least squares with the covariance of the rows; standard deviations that were not stated by
restricted maximum likelihood, which accounts for the degrees of freedom of the frames.

Outliers are found by forward search: it starts at the rows that agree best and adds the next best
row as long as its residual is compatible with the fit of the rows inside and their scatter. One
wrong row never decides about another.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc, fdtrc

from legcal.calibration.location.document import (
    LocatedFrame,
    OpenPart,
    PoseComponent,
    open_parts_in_words,
    signed,
)
from legcal.calibration.location.frames import (
    N_STEP,
    PosePairs,
    frames_after,
    frames_from,
    jacobian,
    kept_rows,
    residuals,
    tool_motions,
    tool_motions_by_step,
)
from legcal.calibration.location.tool_poses import MIN_SIGMA, PoseNoise, ToolMeasurements
from legcal.errors import NotIdentifiable
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
from legcal.geometry.motions import cross_matrices
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.configurations import random_poses

RANK_TOLERANCE = 1e-9  # smallest singular value of a determined direction, relative to the largest
_MAX_ROUNDS = 30  # alternations of frames and variances
_MAX_REML_ITERATIONS = 300
_SIGMA_TOLERANCE = 1e-7
_MAX_STEP = (0.5, 0.5, 0.5, np.inf, np.inf, np.inf)  # turn [rad], displacement [m]
_TURN_FIRST = [3, 4, 5, 0, 1, 2]  # components of a step in the order of estimation.Frames
_MAX_HOLD_ROUNDS = 60
_HOLD_TOLERANCE = 1e-12
FALSE_ALARM = 1e-3  # probability that a row of a good file is left out
_LIKELY = 0.05  # rows of at least this probability are added together
_UNKNOWN = 1e-15  # information added to undetermined directions, relative to the largest
_MIN_DOF = 1.0  # smallest degrees of freedom for an estimated scatter


@dataclass(frozen=True, eq=False)
class FrameFit:
    """The most likely frames."""

    frames: Array  # (2, 3, 4)
    noise: PoseNoise  # stated or estimated
    whitened: Array  # (n, 6): residuals in standard deviations, errors of the model subtracted
    # (n * 6 + k, 12 + k): whitened derivative by a step in units of ``pairs.scale``, and by the k
    # errors of the model, whose priors are the last rows
    design: Array
    chi2: float  # sum of the squares of whitened residuals and errors of the model
    dof: int  # degrees of freedom
    kind_dof: Array  # (2,): degrees of freedom of the variances of positions and orientations

    @property
    def frame_design(self) -> Array:
        """The columns of the frames, errors of the model eliminated, (m, 12)."""
        F, E = self.design[:, :N_STEP], self.design[:, N_STEP:]
        Q, _ = np.linalg.qr(E)
        return np.asarray(F - Q @ (Q.T @ F))

    @property
    def information(self) -> Array:
        """Inverse covariance of a step in units of ``pairs.scale``, (12, 12)."""
        F = self.frame_design
        return np.asarray(F.T @ F)


def fit(
    pairs: PosePairs,
    # within the basin of convergence; undetermined directions stay there
    start: Array,
    noise: PoseNoise,  # standard deviations; those that were not stated are estimated
    motions: Array | None = None,  # (n, 6, k): platform motions by errors of the model
) -> FrameFit:
    """Return the most likely frames near a start.

    Raises DidNotConverge if the steps do not converge.
    """
    frames = start
    for _ in range(_MAX_ROUNDS):
        frames = _most_likely(pairs, frames, noise, motions)
        if all(noise.stated):
            break
        sigma, _ = _variances(pairs, frames, noise, motions)
        converged = np.abs(sigma / noise.sigma - 1.0).max() < _SIGMA_TOLERANCE
        noise = replace(noise, sigma=sigma)
        if converged:
            break
    return fit_at(pairs, frames, noise, motions)


def fit_at(
    pairs: PosePairs, frames: Array, noise: PoseNoise, motions: Array | None = None
) -> FrameFit:
    """Return the fit at frames and noise that have converged."""
    y, A = _whitened(pairs, frames, noise, motions)  # at errors of the model of zero
    remaining = y - A @ np.linalg.lstsq(A, y, rcond=RANK_TOLERANCE)[0]
    _, dof = _variances(pairs, frames, replace(noise, stated=(True, True)), motions)
    s = np.linalg.svd(A, compute_uv=False)
    rank = int(np.sum(s > RANK_TOLERANCE * s[0])) - (A.shape[1] - N_STEP)
    return FrameFit(
        frames=frames,
        noise=noise,
        whitened=remaining[: 6 * len(pairs)].reshape(-1, 6),
        design=A,
        chi2=float(remaining @ remaining),
        dof=3 * len(pairs) + 3 * int(pairs.oriented.sum()) - rank,
        kind_dof=dof,
    )


@dataclass(frozen=True, eq=False)
class _State:
    """T_world_base, T_platform_tool, errors of the model in their standard deviations."""

    base: Frames
    tool: Frames
    errors: Array

    @property
    def frames(self) -> Array:
        """The frames (2, 3, 4)."""
        return frames_from(self.base.R[0], self.base.t[0], self.tool.R[0], self.tool.t[0])


def _most_likely(
    pairs: PosePairs,
    frames: Array,
    noise: PoseNoise,
    motions: Array | None,
    held: Array | None = None,  # (12, k): directions without a step, in units of ``pairs.scale``
) -> Array:
    """Return the least-squares frames at given variances; undetermined directions stay."""

    def rows_of(state: _State) -> Residuals:
        by_step, by_model = _derivatives(pairs, state.frames, motions)
        if motions is not None:
            by_step = by_step + tool_motions_by_step(motions @ state.errors, state.frames, pairs)
        left = residuals(state.frames, pairs)
        by_step[:, 3:] += 0.5 * cross_matrices(left[:, 3:]) @ by_step[:, 3:]
        blocks = by_step[..., :6][..., _TURN_FIRST], by_step[..., 6:][..., _TURN_FIRST], by_model
        r = by_model @ state.errors - left
        return Residuals.of(r, np.concatenate(blocks, axis=-1))

    n, k = len(pairs), 0 if motions is None else motions.shape[-1]
    first, errors, everything = np.zeros(n, dtype=np.intp), np.arange(k), slice(None)
    none = np.zeros((N_STEP, 0)) if held is None else held / pairs.scale[:, None]
    poses = Factor(
        "poses",
        rows_of,
        (
            ("base", first, everything),
            ("tool", first, everything),
            ("errors", np.tile(errors, (n, 1)), everything),
        ),
        n,
        6,
        whitening=noise.weights(pairs.oriented)[..., None] * np.eye(6),
    )
    problem = EstimationProblem[_State](
        variables=(
            Variables("base", all_free(1, 6), Frames.moved, max_step=_MAX_STEP),
            Variables("tool", all_free(1, 6), Frames.moved, max_step=_MAX_STEP),
            Variables(
                "errors", all_free(k, 1), prior=GaussianPrior(errors, np.zeros(k), np.ones(k))
            ),
        ),
        eliminated=None,
        factors=(poses,),
        held_directions=none.T.reshape(-1, 2, 6)[..., _TURN_FIRST].reshape(-1, N_STEP),
        name="fit of the frames",
        remedy="check that readings and poses belong together",
    )
    base, tool = (Frames(F[None, :, :3], F[None, :, 3]) for F in frames)
    return minimise(problem, _State(base, tool, np.zeros(k))).state.frames


def _variances(
    pairs: PosePairs, frames: Array, noise: PoseNoise, motions: Array | None
) -> tuple[Array, Array]:
    """Return sigmas by restricted maximum likelihood, (2,), and their degrees of freedom (2,).

    With P = S^-1 - S^-1 A (A^T S^-1 A)^-1 A^T S^-1 the estimate of a variance v with dS/dv = D
    satisfies y^T P D P y = tr(P D): v is multiplied by the ratio of both sides until it is one.
    Stated sigmas stay.
    """
    n = len(pairs)
    for _ in range(_MAX_REML_ITERATIONS):
        sigma = noise.sigma
        y, A = _whitened(pairs, frames, noise, motions)
        U, s, _ = np.linalg.svd(A, full_matrices=False)
        U = U[:, s > RANK_TOLERANCE * s[0]]
        w, remaining = noise.weights(pairs.oriented), (y - U @ (U.T @ y))[: 6 * n].reshape(n, 6)
        left = 1.0 - np.sum(U[: 6 * n] ** 2, axis=1).reshape(n, 6)
        squares, traces = (
            (w**2 * of_rows).reshape(n, 2, 3).sum(axis=(0, 2)) for of_rows in (remaining**2, left)
        )
        dof = sigma**2 * traces
        ratio = np.sqrt(squares / np.maximum(traces, 1e-300))
        ratio[list(noise.stated)] = 1.0
        ratio[dof < 1e-6] = 1.0
        least = np.where(noise.stated, sigma, MIN_SIGMA)
        noise = replace(noise, sigma=np.maximum(sigma * ratio, least))
        if np.abs(noise.sigma / sigma - 1.0).max() < 0.1 * _SIGMA_TOLERANCE:
            break
    return noise.sigma, dof


def _derivatives(pairs: PosePairs, frames: Array, motions: Array | None) -> tuple[Array, Array]:
    """Return derivatives of the poses by a step (n, 6, 12) and by errors of the model (n, 6, k)."""
    by_model = np.zeros((len(pairs), 6, 0))
    if motions is not None:
        by_model = tool_motions(motions, frames, pairs)
    return jacobian(frames, pairs), by_model


def _whitened(
    pairs: PosePairs, frames: Array, noise: PoseNoise, motions: Array | None
) -> tuple[Array, Array]:
    """Return residuals (6n + k,) and design (6n + k, 12 + k) in standard deviations.

    The priors of the k errors of the model stand below.
    """
    by_step, by_model = _derivatives(pairs, frames, motions)
    w, k = noise.weights(pairs.oriented), by_model.shape[2]
    design = w[..., None] * np.concatenate([by_step * pairs.scale, by_model], axis=2)
    y = np.append(w * residuals(frames, pairs), np.zeros(k))
    return y, np.vstack([design.reshape(-1, N_STEP + k), np.eye(k, N_STEP + k, N_STEP)])


@dataclass(frozen=True, eq=False)
class Inliers:
    """Inliers among the rows, and the residuals of all rows from their fit."""

    is_inlier: BoolArray  # (n,)
    # distance, angle: (n,): residual of each row from the prediction by the inliers [m, rad]
    distance: Array
    angle: Array
    frames: Array  # frames estimated from the inliers
    sigma: Array  # (2,): the scatter of the inliers, see :class:`PoseNoise`


def find_inliers(measurements: ToolMeasurements, start: Array) -> Inliers:
    """Return the inliers by forward search from frames that most rows agree with.

    A row is never left out if the stated standard deviations explain its residual.
    """
    pairs, noise = measurements.pairs, measurements.noise
    n = len(pairs)
    distance = ((residuals(start, pairs) * pairs.unit) ** 2).sum(axis=1)
    inside = np.zeros(n, dtype=np.bool_)
    inside[np.argsort(distance, kind="stable")[: kept_rows(n, measurements.fewest)]] = True
    frames = start
    while True:
        # With the estimated scatter, or the stated one if it is larger
        frame_fit = fit(pairs.of(inside), frames, replace(noise, stated=(False, False)))
        least = np.where(noise.stated, noise.sigma, 0.0)
        scatter = replace(frame_fit.noise, sigma=np.maximum(frame_fit.noise.sigma, least))
        frame_fit = replace(frame_fit, noise=scatter)
        frames = frame_fit.frames
        outside: IntArray = np.flatnonzero(~inside)
        if not len(outside):
            break
        likely = _probability(pairs.of(outside), noise, frame_fit)
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
        frame_fit.noise.sigma,
    )


def _probability(pairs: PosePairs, noise: PoseNoise, frame_fit: FrameFit) -> Array:
    """Return the probability of residuals as large as those of the given rows, (n,)."""
    sigma = frame_fit.noise.sigma
    H = frame_fit.information
    H = H + _UNKNOWN * float(np.linalg.norm(H, 2)) * np.eye(len(H))
    J = jacobian(frame_fit.frames, pairs) * pairs.scale
    covariance = J @ np.linalg.solve(H, np.swapaxes(J, 1, 2))
    covariance[:, range(6), range(6)] += np.repeat(sigma**2, 3)
    r = residuals(frame_fit.frames, pairs)
    smallest = np.ones(len(pairs))
    for kind, rows in enumerate((slice(0, 3), slice(3, 6))):
        dof = float(frame_fit.kind_dof[kind])
        at_stated = noise.stated[kind] and bool(sigma[kind] <= noise.sigma[kind])
        if dof < _MIN_DOF and not at_stated:
            continue
        part = np.linalg.solve(covariance[:, rows, rows], r[:, rows, None])[:, :, 0]
        distance = (part * r[:, rows]).sum(axis=1)
        # Not F with infinite degrees of freedom: SciPy has no number for that.
        probability = chdtrc(3, distance) if at_stated else fdtrc(3, dof, distance / 3.0)
        smallest = np.minimum(smallest, np.where(pairs.oriented | (kind == 0), probability, 1.0))
    return np.minimum(1.0, 2.0 * smallest)


# Directions that measured poses leave open


_MAX_SIGMA = 0.1  # largest sigma of a determined direction [rad, machine lengths]
# smallest singular value, relative to the largest, of a direction that the workspace determines
_MACHINE_TOLERANCE = 2e-3
_PART_TOLERANCE = 0.03  # smallest component of a unit direction that messages name
_RESOLVED = 1e-3  # smallest motion of the tool along a unit direction that holding it fixes
_N_POSES, _SEED = 30, 1  # random poses of the workspace
_BLOCKS: tuple[tuple[slice, LocatedFrame, PoseComponent], ...] = (
    (slice(0, 3), "base", "position"),
    (slice(3, 6), "base", "orientation"),
    (slice(6, 9), "tool", "position"),
    (slice(9, 12), "tool", "orientation"),
)  # components of a step


@dataclass(frozen=True, eq=False)
class Determinacy:
    """The most likely frames with their covariance and their undetermined parts."""

    fit: FrameFit  # evaluated at the frames, with the undetermined directions held
    # (12, 12): covariance of a step: displacement and rotation of the base about world axes, of the
    # tool about platform axes [m, rad]; zero along held directions
    covariance: Array
    held: tuple[OpenPart, ...]  # parts that no pose of the machine determines
    words: str  # description of the held parts; "" if everything is determined


def determine(
    measurements: ToolMeasurements,
    fit: FrameFit,
    # (3,): position of the tool in the platform, used where the machine does not determine it [m]
    tool_position: Array,
    name: str,  # name of the poses in messages
) -> Determinacy:
    """Split a fit into determined and held parts.

    Raises NotIdentifiable if other poses of the machine would determine more than these, or if
    holding the tool does not fix all undetermined directions.
    """
    pairs, oriented = measurements.pairs, measurements.is_oriented
    basis = _open_directions(fit.frame_design, oriented=oriented)
    parts: list[OpenPart] = []
    words = ""
    if basis.shape[1]:
        _check_machine(measurements, fit, basis, name)
        fit = hold_open_part(measurements, fit, tool_position)
        basis = _least_determined(measurements, fit, basis.shape[1])
        parts = _open_parts(basis, fit.frames)
        words = _held_words(parts, tool_position)
    scale = pairs.scale
    unit = _covariance_with(fit.information, basis, oriented=oriented)
    covariance = unit * np.outer(scale, scale)
    return Determinacy(fit, covariance, tuple(parts), words)


def hold_open_part(measurements: ToolMeasurements, fit: FrameFit, tool_position: Array) -> FrameFit:
    """Return the most likely frames with the tool (3,) held where nothing determines it.

    Along undetermined directions the tool is moved as near to the given position, and to the axes
    of the platform, as possible; all other directions stay most likely.
    """
    k = _open_directions(fit.frame_design, oriented=measurements.is_oriented).shape[1]
    pairs, by_model = measurements.pairs, measurements.by_model
    for _ in range(_MAX_HOLD_ROUNDS if k else 0):
        basis = _least_determined(measurements, fit, k)
        turn = Rotation.from_matrix(fit.frames[1, :, :3]).inv().as_rotvec()
        offset = np.concatenate([(tool_position - fit.frames[1, :, 3]) / pairs.length, turn])
        slide = basis @ np.linalg.lstsq(basis[6:], offset, rcond=None)[0]
        size = float(np.linalg.norm(slide[[3, 4, 5, 9, 10, 11]]))
        step = slide * min(1.0, 0.5 / max(size, 1e-300)) * pairs.scale
        of_tool = np.concatenate([np.zeros_like(basis[:6]), basis[6:]])
        frames = frames_after(fit.frames, step)
        frames = _most_likely(pairs, frames, fit.noise, by_model, of_tool)
        fit = fit_at(pairs, frames, fit.noise, by_model)
        if np.abs(slide).max() < _HOLD_TOLERANCE:
            break
    return fit


def _open_directions(
    # (m, 12): whitened derivatives by a step in units of the machine's length and radians
    design: Array,
    *,
    # whether any orientation of the tool was measured; if not, the orientation of the tool in the
    # platform is not estimated
    oriented: bool,
) -> Array:
    """Return an orthonormal basis (12, k) of the undetermined directions of a design."""
    s, V = _directions(design, oriented)
    return V[:, (s < RANK_TOLERANCE * s[0]) | (s * _MAX_SIGMA < 1.0)]


def _least_determined(measurements: ToolMeasurements, fit: FrameFit, k: int) -> Array:
    """Return the k least determined directions (12, k) of a fit."""
    V = _directions(fit.frame_design, measurements.is_oriented)[1]
    return V[:, V.shape[1] - k :]


def _directions(design: Array, oriented: bool) -> tuple[Array, Array]:
    """Return singular values (n,), the largest first, and singular vectors (12, n) of a design."""
    n = N_STEP if oriented else 9
    _, s, Vt = np.linalg.svd(design[:, :n], full_matrices=True)
    return np.append(s, np.zeros(n - len(s))), np.pad(Vt.T, ((0, N_STEP - n), (0, 0)))


def _open_parts(basis: Array, frames: Array) -> list[OpenPart]:
    """Return the parts of the frames that undetermined directions (12, k) move."""
    parts = []
    for block, frame, kind in _BLOCKS:
        rows = basis[block]
        if frame == "base":
            rows = frames[0, :, :3].T @ rows
        U, s, _ = np.linalg.svd(rows, full_matrices=False)
        directions = [signed(u).tolist() for u in U[:, s > _PART_TOLERANCE].T]
        if directions:
            parts.append(OpenPart(frame=frame, kind=kind, directions=directions))
    return parts


def _workspace(measurements: ToolMeasurements) -> PosePairs:
    """Return random poses of the workspace, measured like the actual poses."""
    _, poses = random_poses(measurements.machine, _N_POSES, _SEED)
    matrices = np.array([T.as_matrix() for T in poses])
    return PosePairs(
        R=matrices[:, :3, :3],
        t=matrices[:, :3, 3],
        M=np.tile(np.eye(3), (_N_POSES, 1, 1)),
        p=np.zeros((_N_POSES, 3)),
        oriented=np.full(_N_POSES, measurements.is_oriented),
        length=measurements.pairs.length,
    )


def _check_machine(measurements: ToolMeasurements, fit: FrameFit, basis: Array, name: str) -> None:
    """Refuse directions that other poses would determine or that holding the tool does not fix."""
    pairs = measurements.pairs
    # Derivatives of poses all over the workspace; the noise does not enter
    design = jacobian(fit.frames, _workspace(measurements)) * pairs.unit[:, None] * pairs.scale
    s, V = _directions(design.reshape(-1, N_STEP), measurements.is_oriented)
    open_everywhere = V[:, s < _MACHINE_TOLERANCE * s[0]]
    shown = basis - open_everywhere @ (open_everywhere.T @ basis)
    U, s, _ = np.linalg.svd(shown, full_matrices=False)
    resolvable = np.asarray(U[:, s > 0.5])
    start = f"{name}: base and tool could not be located, because"
    if resolvable.shape[1]:
        raise NotIdentifiable(
            f"{start} {open_parts_in_words(_open_parts(resolvable, fit.frames))} cannot be told "
            f"from these {len(pairs)} poses; add some that turn about another axis, that are "
            "displaced in another direction or further apart, from all over the workspace, or "
            "measure them better."
        )
    by_tool = np.linalg.svd(basis[6:], compute_uv=False)
    if np.any(by_tool <= _RESOLVED) or len(by_tool) < basis.shape[1]:
        raise NotIdentifiable(
            f"{start} no pose of this machine tells "
            f"{open_parts_in_words(_open_parts(basis, fit.frames))}, even with the tool held in "
            "the platform; measure orientations too, or the base itself."
        )


def _held_words(parts: list[OpenPart], tool_position: Array) -> str:
    """Return a sentence that names the held parts."""
    tool = [part for part in parts if part.frame == "tool"]
    base = [part for part in parts if part.frame == "base"]
    position = ", ".join(f"{x:g}" for x in tool_position)
    with_it = f" from {open_parts_in_words(base)}" if base else ""
    assumptions = [
        f"the tool is taken at ({position}) m in the platform"
        if part.kind == "position"
        else "the tool is taken along the axes of the platform"
        for part in tool
    ]
    return (
        f"No pose of this machine tells {open_parts_in_words(tool)} apart{with_it}: "
        f"{' and '.join(assumptions)} there, "
        "and the base follows; where the tool is in the world does not depend on it."
    )


def _covariance_with(
    information: Array,  # (12, 12): inverse covariance of a step in the same units
    basis: Array,  # (12, k): undetermined directions
    *,
    oriented: bool,  # whether the orientation of the tool is known; else its rows are zero
) -> Array:
    """Return the covariance (12, 12) of a step; zero along the held directions of the tool."""
    Z = null_space(np.vstack([np.zeros_like(basis[:6]), basis[6:]]).T)
    if not oriented:
        U, s, _ = np.linalg.svd(Z[:9], full_matrices=False)
        Z = np.zeros((N_STEP, int(np.sum(s > _RESOLVED))))
        Z[:9] = U[:, s > _RESOLVED]
    return np.asarray(Z @ np.linalg.solve(Z.T @ information @ Z, Z.T))
