"""Where the fit stands: values of everything that it moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.frames import motion_of
from legcal.geometry.types import Array
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.leg_steps import moved_legs
from legcal.refinement.layout import Layout
from legcal.vision.camera import Camera
from legcal.vision.intrinsics import intrinsic_names, intrinsic_values, with_intrinsics


@dataclass(frozen=True, eq=False)
class State:
    """Values of everything that the fit moves.

    Attributes
    ----------
    legs : tuple of LegGeometry
        The legs in R_b and R_e.
    radii : (n_radii,) array
        Radii [m] of the layout's parts.
    biases : (n_biases,) array
        Shifts of outlines that several of them share [px].
    cameras : tuple of Camera
        The intrinsics of each view.
    R_camera, t_camera : (n_views, 3, 3) and (n_views, 3) array
        Rotation and translation [m] of T_camera_Rb.
    R_pose, t_pose : (n_poses, 3, 3) and (n_poses, 3) array
        Rotation and translation [m] of T_Rb_Re.
    R_board, t_board : (1, 3, 3) and (1, 3) array
        Rotation and translation [m] of T_Rb_board, the calibration board in R_b.
    board_scale : (1,) array
        Factor on the dimensions of the board.
    """

    legs: tuple[LegGeometry, ...]
    radii: Array
    biases: Array
    cameras: tuple[Camera, ...]
    R_camera: Array
    t_camera: Array
    R_pose: Array
    t_pose: Array
    R_board: Array
    t_board: Array
    board_scale: Array

    @cached_property
    def A(self) -> Array:
        """Base joint centres in R_b, (n_legs, 3) [m]."""
        return np.array([leg.A for leg in self.legs])

    @cached_property
    def B(self) -> Array:
        """Platform joint centres in R_e, (n_legs, 3) [m]."""
        return np.array([leg.B for leg in self.legs])

    @cached_property
    def lengths(self) -> Array:
        """Offsets and constant lengths, (n_legs,) [m]."""
        return np.array([leg.q0 for leg in self.legs])

    @property
    def T_camera_Rb(self) -> tuple[RigidTransform, ...]:
        """Camera poses, one a view."""
        return motions(self.R_camera, self.t_camera)

    @property
    def T_Rb_board(self) -> RigidTransform:
        """The calibration board in R_b; of no meaning where no image shows one."""
        return motions(self.R_board, self.t_board)[0]

    @property
    def T_Rb_Re(self) -> tuple[RigidTransform, ...]:
        """Platform poses."""
        return motions(self.R_pose, self.t_pose)

    def moved(self, x: Array, layout: Layout) -> State:
        """Return the state after a change x of its unknowns [m, rad, px]."""
        change = np.append(x, 0.0)
        legs = self.legs
        if np.any(layout.place < layout.size):
            legs = moved_legs(legs, layout.place, x)
        camera, pose = change[layout.camera], x[layout.n_kept :].reshape(-1, 6)
        board = change[layout.board]
        return State(
            legs,
            self.radii + change[layout.radius],
            self.biases + change[layout.bias],
            _changed(self.cameras, change[layout.intrinsic], layout.intrinsic_keys),
            turned(self.R_camera, camera[:, :3]),
            self.t_camera + camera[:, 3:],
            turned(self.R_pose, pose[:, :3]),
            self.t_pose + pose[:, 3:],
            turned(self.R_board, board[None, :3]),
            self.t_board + board[3:],
            self.board_scale + change[layout.board_scale],
        )


def _changed(
    cameras: tuple[Camera, ...], change: Array, keys: tuple[str, ...]
) -> tuple[Camera, ...]:
    """Return cameras whose intrinsics have changed by (n_views, n_keys)."""
    if not np.any(change):
        return cameras
    changed = []
    for camera, by in zip(cameras, change, strict=True):
        moved = dict(zip(keys, by.tolist(), strict=True))
        values = {key: intrinsic_of(camera, key) + d for key, d in moved.items() if d != 0.0}
        changed.append(with_intrinsics(camera, values))
    return tuple(changed)


def intrinsic_of(camera: Camera, key: str) -> float:
    """Return one number of a camera by its name."""
    return float(intrinsic_values(camera)[intrinsic_names(camera).index(key)])


def cayley(w: Array) -> Array:
    """Return Cayley's rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad]."""
    g = 0.5 * w
    K = np.zeros((*w.shape[:-1], 3, 3))
    K[..., 0, 1], K[..., 0, 2], K[..., 1, 2] = -g[..., 2], g[..., 1], -g[..., 0]
    K -= np.swapaxes(K, -1, -2)
    scale = 2.0 / (1.0 + np.sum(g**2, axis=-1))[..., None, None]
    return np.asarray(np.eye(3) + scale * (K + K @ K))


def turned(R: Array, w: Array) -> Array:
    """Return rotation matrices turned by rotation vectors, orthogonal to rounding."""
    product = cayley(w) @ R
    drift = np.swapaxes(product, -1, -2) @ product
    return np.asarray(product @ (1.5 * np.eye(3) - 0.5 * drift))


def motions(R: Array, t: Array) -> tuple[RigidTransform, ...]:
    """Return rigid motions of rotation matrices (n, 3, 3) and translations (n, 3) [m]."""
    if len(R) == 0:
        return ()
    return tuple(motion_of(R, t))


def components(motions: Sequence[RigidTransform]) -> tuple[Array, Array]:
    """Return rotation matrices and translations of motions."""
    T = np.array([T.as_matrix() for T in motions]).reshape(-1, 4, 4)
    return T[:, :3, :3].copy(), T[:, :3, 3].copy()
