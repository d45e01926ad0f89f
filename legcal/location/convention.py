"""Where a machine leaves a part of the frames open, the tool is held there and the rest follows."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from legcal.geometry.types import Array
from legcal.location.pose_pairs import N_FRAME, Frames, PosePairs

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
