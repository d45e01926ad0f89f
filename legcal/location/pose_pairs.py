"""Tool poses in the world beside platform poses in the base, and the two frames between them.

``T_world_tool = T_world_base T_base_platform T_platform_tool``: the middle one comes from the
readings, the left side is measured, the outer ones are looked for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array, BoolArray, IntArray

N_FRAME = 12  # displacement and rotation of both frames


@dataclass(frozen=True, eq=False)
class PosePairs:
    """Measured tool poses and the platform poses that the readings give.

    Attributes
    ----------
    R, t : (n, 3, 3) and (n, 3) array
        T_base_platform [m].
    M, p : (n, 3, 3) and (n, 3) array
        T_world_tool as measured [m]; M is the identity where it is not.
    oriented : (n,) array of bool
        Whether the orientation of the tool was measured.
    length : float
        A length of the machine, which rotations are weighed against [m].
    """

    R: Array
    t: Array
    M: Array
    p: Array
    oriented: BoolArray
    length: float

    def __len__(self) -> int:
        return len(self.t)

    def of(self, rows: BoolArray | IntArray) -> PosePairs:
        """Return some of the pairs."""
        return PosePairs(
            self.R[rows],
            self.t[rows],
            self.M[rows],
            self.p[rows],
            self.oriented[rows],
            self.length,
        )

    @property
    def scale(self) -> Array:
        """What one unit of each component of a step means, (12,): the length, or one radian."""
        return np.tile(np.repeat([self.length, 1.0], 3), 2)


@dataclass(frozen=True, eq=False)
class Frames:
    """The base in the world and the tool in the platform; leading dimensions make a batch.

    Attributes
    ----------
    R_base, t_base : (..., 3, 3) and (..., 3) array
        T_world_base [m].
    R_tool, t_tool : (..., 3, 3) and (..., 3) array
        T_platform_tool [m].
    """

    R_base: Array
    t_base: Array
    R_tool: Array
    t_tool: Array

    def at(self, i: int | IntArray) -> Frames:
        """Return one of a batch, or several."""
        return Frames(self.R_base[i], self.t_base[i], self.R_tool[i], self.t_tool[i])

    def moved(self, step: Array) -> Frames:
        """Return the frames after a step (..., 12).

        A step holds the displacement of the base in the world [m], its rotation vector about
        world axes [rad], and the same of the tool in the platform.
        """
        return Frames(
            turned(step[..., 3:6]) @ self.R_base,
            self.t_base + step[..., :3],
            turned(step[..., 9:]) @ self.R_tool,
            self.t_tool + step[..., 6:9],
        )

    def transforms(self) -> tuple[RigidTransform, RigidTransform]:
        """Return T_world_base and T_platform_tool."""
        return (
            RigidTransform.from_components(self.t_base, Rotation.from_matrix(self.R_base)),
            RigidTransform.from_components(self.t_tool, Rotation.from_matrix(self.R_tool)),
        )


def stacked(several: list[Frames]) -> Frames:
    """Return several frames as one batch."""
    return Frames(
        np.array([f.R_base for f in several]),
        np.array([f.t_base for f in several]),
        np.array([f.R_tool for f in several]),
        np.array([f.t_tool for f in several]),
    )


def predicted(frames: Frames, pairs: PosePairs) -> tuple[Array, Array]:
    """Return orientations (..., n, 3, 3) and positions (..., n, 3) [m] of the tool in the world."""
    tip = np.einsum("nij,...j->...ni", pairs.R, frames.t_tool) + pairs.t
    p = np.einsum("...ij,...nj->...ni", frames.R_base, tip) + frames.t_base[..., None, :]
    M = frames.R_base[..., None, :, :] @ pairs.R @ frames.R_tool[..., None, :, :]
    return M, p


def residuals(frames: Frames, pairs: PosePairs) -> Array:
    """Return measured minus predicted poses, (..., n, 6): position [m], rotation vector [rad].

    Both are along world axes; a rotation that was not measured counts as zero.
    """
    M, p = predicted(frames, pairs)
    away = pairs.M @ np.swapaxes(M, -1, -2)
    turn = Rotation.from_matrix(away.reshape(-1, 3, 3)).as_rotvec().reshape(p.shape)
    turn[..., ~pairs.oriented, :] = 0.0
    return np.concatenate([pairs.p - p, turn], axis=-1)


def jacobian(frames: Frames, pairs: PosePairs) -> Array:
    """Return the derivative of predicted poses by a step, (..., n, 6, 12)."""
    n = len(pairs)
    tip = np.einsum("nij,...j->...ni", pairs.R, frames.t_tool) + pairs.t
    arm = np.einsum("...ij,...nj->...ni", frames.R_base, tip)
    carried = frames.R_base[..., None, :, :] @ pairs.R
    J = np.zeros((*frames.t_base.shape[:-1], n, 6, N_FRAME))
    J[..., :3, :3] = np.eye(3)
    J[..., :3, 3:6] = -cross_matrices(arm)
    J[..., :3, 6:9] = carried
    J[..., 3:, 3:6] = np.eye(3) * pairs.oriented[:, None, None]
    J[..., 3:, 9:] = carried * pairs.oriented[:, None, None]
    return J


def cross_matrices(v: Array) -> Array:
    """Return the matrices (..., 3, 3) of w -> v x w."""
    x, y, z = np.moveaxis(v, -1, 0)
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def turned(rotation_vector: Array) -> Array:
    """Return the rotation matrices (..., 3, 3) of rotation vectors [rad]."""
    flat = Rotation.from_rotvec(rotation_vector.reshape(-1, 3)).as_matrix()
    return np.asarray(flat.reshape(*rotation_vector.shape[:-1], 3, 3))


def nearest_rotation(matrix: Array) -> Array:
    """Return the rotation matrices nearest to some matrices (..., 3, 3)."""
    U, _, Vt = np.linalg.svd(matrix)
    flip = np.ones(U.shape[:-1])
    flip[..., 2] = np.sign(np.linalg.det(U @ Vt))
    return np.asarray((U * flip[..., None, :]) @ Vt)
