"""Two unknown frames: T_world_tool = T_world_base T_base_platform(q) T_platform_tool.

Frames are arrays (..., 2, 3, 4): rotation beside position [m] of T_world_base and T_platform_tool;
leading dimensions make a batch. They move by steps (..., 12): displacement of the base in the world
[m], its rotation vector about world axes [rad], and the same of the tool in the platform.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.motions import moved_poses
from legcal.geometry.rotations import cross_matrices
from legcal.geometry.types import Array, BoolArray, IntArray

N_STEP = 12


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
