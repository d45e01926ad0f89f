"""The two frames that are looked for, and how measured poses depend on them.

T_world_tool = T_world_base T_base_platform(q) T_platform_tool
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry import Array, BoolArray, IntArray, cross_matrices, rotation_matrices

N_FRAME = 12  # displacement and rotation of both frames
SMALLEST = 1e-9  # [m, rad]; nobody measures better, and files round


@dataclass(frozen=True, eq=False)
class Frames:
    """The base in the world and the tool in the platform; leading dimensions make a batch."""

    R_base: Array  # R_base, t_base: (..., 3, 3) and (..., 3): T_world_base [m]
    t_base: Array
    R_tool: Array  # R_tool, t_tool: (..., 3, 3) and (..., 3): T_platform_tool [m]
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
            rotation_matrices(step[..., 3:6]) @ self.R_base,
            self.t_base + step[..., :3],
            rotation_matrices(step[..., 9:]) @ self.R_tool,
            self.t_tool + step[..., 6:9],
        )

    def transforms(self) -> tuple[RigidTransform, RigidTransform]:
        """Return T_world_base and T_platform_tool."""
        return (
            RigidTransform.from_components(self.t_base, Rotation.from_matrix(self.R_base)),
            RigidTransform.from_components(self.t_tool, Rotation.from_matrix(self.R_tool)),
        )


@dataclass(frozen=True, eq=False)
class PosePairs:
    """Measured tool poses and the platform poses that the readings give."""

    R: Array  # R, t: (n, 3, 3) and (n, 3): T_base_platform [m]
    t: Array
    # M, p: (n, 3, 3) and (n, 3): T_world_tool as measured [m]; M is the identity where it is not
    M: Array
    p: Array
    oriented: BoolArray  # (n,): whether the orientation of the tool was measured
    length: float  # A length of the machine, which rotations are weighed against [m]

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


@dataclass(frozen=True, eq=False)
class Noise:
    """Standard deviations of the rows."""

    sigma: Array  # (n, 2): of position [m] and orientation [rad] of each row, up to ``factor``
    factor: Array  # (2,): what all of a kind are multiplied with
    # whether the standard deviations of positions and of orientations were stated; the factor of
    # those that were not is estimated
    stated: tuple[bool, bool]
    # (n, 6, 6): covariance of the tool pose by errors of the readings [m, rad]; None without any
    readings: Array | None = None

    def of(self, rows: BoolArray | IntArray) -> Noise:
        """Return that of some rows."""
        readings = None if self.readings is None else self.readings[rows]
        return replace(self, sigma=self.sigma[rows], readings=readings)

    def scaled(self, factor: Array) -> Noise:
        """Return the same with other factors."""
        return replace(self, factor=factor)

    @property
    def floor(self) -> Array:
        """The smallest factor of each kind that can be meant."""
        return np.asarray(SMALLEST / self.sigma.min(axis=0))

    def standard_deviations(self) -> Array:
        """Return those of each row and component without the readings', (n, 6) [m, rad]."""
        return np.repeat(self.sigma * self.factor, 3, axis=1)

    def whitening(self, oriented: BoolArray) -> Array:
        """Return matrices W (n, 6, 6) with W^T W the inverse covariance; zero where unmeasured."""
        sigma = self.standard_deviations()
        if self.readings is None:
            W = np.zeros((*sigma.shape, 6))
            W[:, range(6), range(6)] = 1.0 / sigma
        else:
            S = self.readings.copy()
            S[~oriented, 3:, :3] = S[~oriented, :3, 3:] = 0.0
            S[:, range(6), range(6)] += sigma**2
            W = np.linalg.inv(np.linalg.cholesky(S))
        W[~oriented, 3:] = 0.0
        return np.asarray(W)
