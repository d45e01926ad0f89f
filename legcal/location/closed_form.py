"""Robot-world and hand-eye calibration in closed form, where tool orientations were measured.

With A_i = T_tool_world and B_i = T_platform_base the equation A X = Z B of the literature has
X = T_world_base and Z = T_tool_platform. OpenCV solves it where it can (version 5.0 cannot);
the solution here is the same Kronecker form (M. Shah, 2013): orientations first,
positions by linear least squares. Both say nothing of noise and serve as starts.
"""

from __future__ import annotations

import cv2
import numpy as np

from legcal.geometry.types import Array
from legcal.location.pose_pairs import Frames, PosePairs, nearest_rotation


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
