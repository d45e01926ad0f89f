"""Undetermined directions of the frames: refused if other poses determine them, else fixed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from legcal.calibration.location.document import (
    LocatedFrame,
    OpenPart,
    PoseComponent,
    direction_of,
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
        basis = _open_at(measurements, fit, basis.shape[1], fit.frames)
        parts = _open_parts(basis, fit.frames)
        words = _held_words(parts, tool_position)
    scale = pairs.scale
    unit = _covariance_with(fit.information, basis, oriented=oriented)
    covariance = unit * np.outer(scale, scale)
    return Determinacy(fit, covariance, tuple(parts), words)


def hold_open_part(measurements: ToolMeasurements, fit: FrameFit, tool_position: Array) -> FrameFit:
    """Return the fit moved along its undetermined directions until the tool is at its position."""
    k = _open_directions(fit.frame_design, oriented=measurements.is_oriented).shape[1]
    if k == 0:
        return fit
    return hold_tool(
        measurements, fit, lambda frames: _open_at(measurements, fit, k, frames), tool_position
    )


def _open_directions(
    # (m, 12): whitened derivatives by a step in units of the machine's length and radians
    design: Array,
    *,
    # whether any orientation of the tool was measured; if not, the orientation of the tool in the
    # platform is not estimated
    oriented: bool,
) -> Array:
    """Return an orthonormal basis (12, k) of the undetermined directions of a design."""
    return _unseen(design, oriented, lambda s: (s < RANK_TOLERANCE * s[0]) | (s * _MAX_SIGMA < 1.0))


def _shown_elsewhere(
    basis: Array,  # (12, k): undetermined directions of the measured poses
    # (m, 12): derivatives of poses all over the workspace by a step, both in units of the machine's
    # length and radians; the noise does not enter
    jacobian: Array,
    *,
    oriented: bool,
) -> Array:
    """Return the undetermined directions (12, k) that other poses of the machine determine."""
    undetermined = _unseen(jacobian, oriented, lambda s: s < _MACHINE_TOLERANCE * s[0])
    U, s, _ = np.linalg.svd(basis - undetermined @ (undetermined.T @ basis), full_matrices=False)
    return np.asarray(U[:, s > 0.5])


def _unseen(design: Array, oriented: bool, is_open: Callable[[Array], BoolArray]) -> Array:
    """Return the right singular vectors (12, k) whose singular values are too small."""
    n = 12 if oriented else 9
    _, s, Vt = np.linalg.svd(design[:, :n], full_matrices=True)
    s = np.concatenate([s, np.zeros(n - len(s))])
    small = is_open(s)
    basis = np.zeros((12, int(small.sum())))
    basis[:n] = Vt[small].T
    return basis


def _open_parts(basis: Array, frames: Array) -> list[OpenPart]:
    """Return the parts of the frames that undetermined directions (12, k) move."""
    parts = []
    for block, frame, kind in _BLOCKS:
        rows = basis[block]
        if frame == "base":
            rows = frames[0, :, :3].T @ rows
        U, s, _ = np.linalg.svd(rows, full_matrices=False)
        directions = [direction_of(u) for u in U[:, s > _PART_TOLERANCE].T]
        if directions:
            parts.append(OpenPart(frame=frame, kind=kind, directions=directions))
    return parts


def _open_at(measurements: ToolMeasurements, fit: FrameFit, k: int, frames: Array) -> Array:
    """Return the k least determined directions (12, k) at given frames."""
    n = 12 if measurements.is_oriented else 9
    design = frame_design_at(measurements.pairs, frames, fit.noise, measurements.by_model)
    _, _, Vt = np.linalg.svd(design[:, :n], full_matrices=True)
    basis = np.zeros((12, k))
    basis[:n] = Vt[n - k :].T
    return basis


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
    design = jacobian(fit.frames, _workspace(measurements)) * pairs.unit[:, None] * pairs.scale
    resolvable = _shown_elsewhere(
        basis, design.reshape(-1, N_STEP), oriented=measurements.is_oriented
    )
    start = f"{name}: base and tool could not be located, because"
    if resolvable.shape[1]:
        raise NotIdentifiable(
            f"{start} {open_parts_in_words(_open_parts(resolvable, fit.frames))} cannot be told "
            f"from these {len(pairs)} poses; add some that turn about another axis, that are "
            "displaced in another direction or further apart, from all over the workspace, or "
            "measure them better."
        )
    if not _is_resolved_by_the_tool(basis):
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


def _is_resolved_by_the_tool(basis: Array) -> bool:
    """Return whether holding the tool fixes all undetermined directions (12, k)."""
    s = np.linalg.svd(basis[6:], compute_uv=False)
    return bool(np.all(s > _RESOLVED)) and len(s) >= basis.shape[1]


def _kept_directions(basis: Array) -> Array:
    """Return a basis (12, 12 - k) of the steps that leave the held part of the tool at rest."""
    held = basis.copy()
    held[:6] = 0.0
    U, s, _ = np.linalg.svd(held, full_matrices=True)
    return np.asarray(U[:, int(np.sum(s > 0.0)) :])


def _covariance_with(
    information: Array,  # (12, 12): inverse covariance of a step in the same units
    basis: Array,  # (12, k): undetermined directions
    *,
    oriented: bool,  # whether the orientation of the tool is known; else its rows are zero
) -> Array:
    """Return the covariance (12, 12) of a step; zero along held directions."""
    Z = _kept_directions(basis) if basis.shape[1] else np.eye(N_STEP)
    if not oriented:
        U, s, _ = np.linalg.svd(Z[:9], full_matrices=False)
        Z = np.zeros((N_STEP, int(np.sum(s > _RESOLVED))))
        Z[:9] = U[:, s > _RESOLVED]
    return np.asarray(Z @ np.linalg.solve(Z.T @ information @ Z, Z.T))
