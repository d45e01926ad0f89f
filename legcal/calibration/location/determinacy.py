"""What the poses leave open: refused where other poses of the machine would show it, else fixed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from legcal.calibration.location.document import (
    LocatedFrame,
    OpenPart,
    PoseComponent,
    direction_of,
    direction_words,
    open_parts_in_words,
)
from legcal.calibration.location.fit import (
    RANK_TOLERANCE,
    FrameFit,
    frame_design_at,
    hold_tool,
)
from legcal.calibration.location.frames import N_STEP, PosePairs, jacobian
from legcal.calibration.location.tool_poses import ToolMeasurements
from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array, BoolArray
from legcal.machine.configurations import random_poses

_MAX_SIGMA = 0.1  # [rad], and of the length of the machine: what is known worse is open
_MACHINE_TOLERANCE = 2e-3  # of the best singular value: what no pose of a machine shows better
_PART_TOLERANCE = 0.03  # of a unit direction: what is less is not named
_AXIS_TOLERANCE = 0.02  # of the largest rotations: what is less is about the same axis
_RESOLVED = 1e-3  # of a unit direction
_N_POSES, _SEED = 30, 1  # of the workspace
_WEAK = 25.0  # times worse known than by one measured pose
_BLOCKS: tuple[tuple[slice, LocatedFrame, PoseComponent], ...] = (
    (slice(0, 3), "base", "position"),
    (slice(3, 6), "base", "orientation"),
    (slice(6, 9), "tool", "position"),
    (slice(9, 12), "tool", "orientation"),
)  # of a step


@dataclass(frozen=True, eq=False)
class Determinacy:
    """The most likely frames, and how well each part of them is known."""

    fit: FrameFit  # at the frames, the open part held
    # (12, 12): of a step: displacement and rotation of the base about world axes, of the tool about
    # platform axes [m, rad]; zero along what is held
    covariance: Array
    held: tuple[OpenPart, ...]  # what no pose of the machine determines
    words: str  # the same for people; "" where everything is determined
    weak: tuple[str, ...]  # what is known badly, one sentence each


def determine(
    measurements: ToolMeasurements,
    found: FrameFit,
    # (3,): where the tool is taken in the platform where the machine leaves that open [m]
    tool_position: Array,
    name: str,  # what the poses are called in messages
) -> Determinacy:
    """Return what a fit determines.

    Raises NotIdentifiable if other poses of the machine would determine what these leave open, or
    if more than the tool would have to be fixed.
    """
    pairs, oriented = measurements.pairs, measurements.is_oriented
    basis = _open_directions(found.frame_design, oriented=oriented)
    parts: list[OpenPart] = []
    words = ""
    if basis.shape[1]:
        workspace = _workspace(measurements)
        _check_machine(measurements, found, basis, workspace, name)
        found = hold_open_part(measurements, found, tool_position)
        basis = _open_at(measurements, found, basis.shape[1], found.frames)
        parts = _open_parts(basis, found.frames)
        words = _held_words(parts, workspace, tool_position)
    scale = pairs.scale
    unit = _covariance_with(found.information, basis, oriented=oriented)
    covariance = unit * np.outer(scale, scale)
    return Determinacy(
        found, covariance, tuple(parts), words, _weak(covariance, found, pairs, oriented=oriented)
    )


def hold_open_part(
    measurements: ToolMeasurements, found: FrameFit, tool_position: Array
) -> FrameFit:
    """Return a fit moved along what it leaves open until the tool is where it is held."""
    k = _open_directions(found.frame_design, oriented=measurements.is_oriented).shape[1]
    if k == 0:
        return found
    return hold_tool(
        measurements, found, lambda frames: _open_at(measurements, found, k, frames), tool_position
    )


def _open_directions(
    # (m, 12): whitened derivatives by a step in units of the machine's length and radians
    design: Array,
    *,
    # whether orientations of the tool were measured at all; without, that of the tool in the
    # platform is not estimated
    oriented: bool,
) -> Array:
    """Return an orthonormal basis (12, k) of the directions that a design leaves open."""
    return _unseen(design, oriented, lambda s: (s < RANK_TOLERANCE * s[0]) | (s * _MAX_SIGMA < 1.0))


def _shown_elsewhere(
    basis: Array,  # (12, k): what the measured poses leave open
    # (m, 12): derivatives of poses all over the workspace by a step, both in units of the machine's
    # length and radians: geometry alone, whatever the noise
    jacobian: Array,
    *,
    oriented: bool,
) -> Array:
    """Return those open directions (12, k) that the machine's workspace would show."""
    never = _unseen(jacobian, oriented, lambda s: s < _MACHINE_TOLERANCE * s[0])
    U, s, _ = np.linalg.svd(basis - never @ (never.T @ basis), full_matrices=False)
    return np.asarray(U[:, s > 0.5])


def _unseen(design: Array, oriented: bool, is_open: Callable[[Array], BoolArray]) -> Array:
    """Return the right singular vectors (12, k) whose singular values are too small."""
    n = 12 if oriented else 9
    _, s, Vt = np.linalg.svd(design[:, :n], full_matrices=True)
    s = np.concatenate([s, np.zeros(n - len(s))])
    chosen = is_open(s)
    basis = np.zeros((12, int(chosen.sum())))
    basis[:n] = Vt[chosen].T
    return basis


def _open_parts(basis: Array, frames: Array) -> list[OpenPart]:
    """Return which parts of the frames some open directions (12, k) move."""
    parts = []
    for block, frame, kind in _BLOCKS:
        rows = basis[block]
        if frame == "base":
            rows = frames[0, :, :3].T @ rows
        U, s, _ = np.linalg.svd(rows, full_matrices=False)
        found = [direction_of(u) for u in U[:, s > _PART_TOLERANCE].T]
        if found:
            parts.append(OpenPart(frame, kind, tuple(found)))
    return parts


@dataclass(frozen=True, eq=False)
class _PoseSpread:
    """How platform poses differ."""

    # (r, 3): independent axes that they are turned about, in the base link, the first ones first
    axes: Array
    n_shifts: int  # independent directions in which they are displaced

    @property
    def words(self) -> str:
        """How they differ, after "poses that"."""
        turns = (
            "do not turn",
            f"all turn about one axis, {direction_words(self.axes[0])} of the base"
            if len(self.axes)
            else "",
            "turn about two axes",
            "turn about all axes",
        )[len(self.axes)]
        shifts = ("stay in place", "move along a line", "move in a plane", "move in space")
        return f"{turns} and {shifts[self.n_shifts]}"


def _pose_spread(R: Array, t: Array, length: float) -> _PoseSpread:
    """Return how poses R (n, 3, 3), t (n, 3) [m] differ; a length makes rotations comparable."""
    turns = (Rotation.from_matrix(R) * Rotation.from_matrix(R).mean().inv()).as_rotvec()
    _, s, Vt = np.linalg.svd(turns, full_matrices=False)
    size = np.sqrt(len(t))
    axes = Vt[(s > _AXIS_TOLERANCE * s[0]) & (s / size > 1e-6)]
    moves = np.linalg.svd(t - t.mean(axis=0), compute_uv=False)
    n_shifts = int(np.sum((moves > _AXIS_TOLERANCE * moves[0]) & (moves / size > 1e-6 * length)))
    return _PoseSpread(axes, n_shifts)


def _needed_words(found: _PoseSpread, possible: _PoseSpread, scatter: str) -> str:
    """Return how the poses scatter if that matters, what they need and what to do."""
    if len(found.axes) < min(2, len(possible.axes)):
        several = "two axes" if len(possible.axes) > 1 else "an axis"
        more = "tilted about another axis too" if len(found.axes) else "turned against each other"
        return f", needed rotations about {several}; add poses that are {more}"
    if found.n_shifts < possible.n_shifts:
        return (
            f", needed displacements in {possible.n_shifts} directions; add poses that are "
            "displaced in another direction too"
        )
    return (
        f", with a scatter of {scatter}, needed more or better ones, further apart; add some from "
        "all over the workspace"
    )


def _open_at(measurements: ToolMeasurements, found: FrameFit, k: int, frames: Array) -> Array:
    """Return the k directions (12, k) that are known least at some frames."""
    n = 12 if measurements.is_oriented else 9
    design = frame_design_at(measurements.pairs, frames, found.noise, measurements.by_model)
    _, _, Vt = np.linalg.svd(design[:, :n], full_matrices=True)
    basis = np.zeros((12, k))
    basis[:n] = Vt[n - k :].T
    return basis


def _workspace(measurements: ToolMeasurements) -> PosePairs:
    """Return poses all over the workspace, as if each had been measured."""
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


def _check_machine(
    measurements: ToolMeasurements, found: FrameFit, basis: Array, workspace: PosePairs, name: str
) -> None:
    """Refuse what other poses would determine, and what holding the tool does not close."""
    pairs = measurements.pairs
    seen = jacobian(found.frames, workspace) * pairs.unit[:, None] * pairs.scale
    beyond = _shown_elsewhere(basis, seen.reshape(-1, N_STEP), oriented=measurements.is_oriented)
    here = _pose_spread(pairs.R, pairs.t, pairs.length)
    there = _pose_spread(workspace.R, workspace.t, pairs.length)
    start = f"{name}: base and tool could not be located, because"
    if beyond.shape[1]:
        raise NotIdentifiable(
            f"{start} {open_parts_in_words(_open_parts(beyond, found.frames))} cannot be told from "
            "the poses: "
            f"found {len(pairs)} poses that {here.words}"
            f"{_needed_words(here, there, _scatter(measurements, found))}."
        )
    if not _is_resolved_by_the_tool(basis):
        raise NotIdentifiable(
            f"{start} no pose of this machine tells "
            f"{open_parts_in_words(_open_parts(basis, found.frames))}: "
            f"found a platform whose poses {there.words}, needed a part that holding the tool in "
            "the platform closes; measure orientations too, or the base itself."
        )


def _scatter(measurements: ToolMeasurements, found: FrameFit) -> str:
    """Return the standard deviations of a measured component."""
    sigma = found.noise.rms
    turn = f" and {np.degrees(sigma[1]):.2g} deg" if measurements.is_oriented else ""
    return f"{1e3 * sigma[0]:.2g} mm{turn}"


def _held_words(parts: list[OpenPart], workspace: PosePairs, tool_position: Array) -> str:
    """Return what is held and why."""
    tool = [part for part in parts if part.frame == "tool"]
    base = [part for part in parts if part.frame == "base"]
    machine = _pose_spread(workspace.R, workspace.t, workspace.length)
    if len(machine.axes) == 0:
        why = "the platform of this machine does not turn"
    elif len(machine.axes) == 1:
        axis = direction_words(machine.axes[0])
        why = f"the platform of this machine turns about one axis only, {axis} of the base"
    else:
        why = f"the platform of this machine takes poses that {machine.words}"
    at = ", ".join(f"{x:g}" for x in tool_position)
    with_it = f" from {open_parts_in_words(base)}" if base else ""
    taken = [
        f"the tool is taken at ({at}) m in the platform"
        if part.kind == "position"
        else "the tool is taken along the axes of the platform"
        for part in tool
    ]
    return (
        f"No pose tells {open_parts_in_words(tool)} apart{with_it}, because {why}: "
        f"{' and '.join(taken)} there, "
        "and the base follows; where the tool is in the world does not depend on it."
    )


def _weak(
    covariance: Array, found: FrameFit, pairs: PosePairs, *, oriented: bool
) -> tuple[str, ...]:
    """Return which directions are known badly, one sentence for each part of the frames."""
    position, angle = found.noise.rms.tolist()
    one = max(position, angle * pairs.length if oriented else 0.0)
    sentences = []
    for block, frame, kind in _BLOCKS:
        values, vectors = np.linalg.eigh(covariance[block, block])
        sigma = float(np.sqrt(max(values[-1], 0.0)))
        limit = _WEAK * (one if kind == "position" else one / pairs.length)
        if sigma <= limit:
            continue
        v = vectors[:, -1] if frame == "tool" else found.frames[0, :, :3].T @ vectors[:, -1]
        part = OpenPart(frame, kind, (direction_of(v),))
        known = f"{1e3 * sigma:.2g} mm" if kind == "position" else f"{np.degrees(sigma):.2g} deg"
        sentences.append(
            f"Poorly determined: {part.words}, {known} (1 sigma); poses that differ more, above "
            "all in rotations about several axes, would determine it better."
        )
    return tuple(sentences)


def _is_resolved_by_the_tool(basis: Array) -> bool:
    """Say whether every open direction (12, k) moves the tool, so that holding it closes all."""
    s = np.linalg.svd(basis[6:], compute_uv=False)
    return bool(np.all(s > _RESOLVED)) and len(s) >= basis.shape[1]


def _kept_directions(basis: Array) -> Array:
    """Return the directions (12, 12 - k) that do not move the held part of the tool."""
    held = basis.copy()
    held[:6] = 0.0
    U, s, _ = np.linalg.svd(held, full_matrices=True)
    return np.asarray(U[:, int(np.sum(s > 0.0)) :])


def _covariance_with(
    information: Array,  # (12, 12): of a step in the same units
    basis: Array,  # (12, k): open directions
    *,
    oriented: bool,  # whether the orientation of the tool is known; else its rows are zero
) -> Array:
    """Return the covariance (12, 12) of a step, what is held counted as known."""
    Z = _kept_directions(basis) if basis.shape[1] else np.eye(N_STEP)
    if not oriented:
        U, s, _ = np.linalg.svd(Z[:9], full_matrices=False)
        Z = np.zeros((N_STEP, int(np.sum(s > _RESOLVED))))
        Z[:9] = U[:, s > _RESOLVED]
    return np.asarray(Z @ np.linalg.solve(Z.T @ information @ Z, Z.T))
