"""Where the fit stands, and where each unknown sits in the vector that a solver sees.

The solver sees only changes x around a reference state, in mm and mrad, so that nothing is
singular and rounding is relative to the change. The vector is kinematic parameters, radii,
cameras, platform poses, in this order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.mechanism.parameters import KinematicParameters, free_coordinates
from legcal.refinement.residuals import UNIT


@dataclass(frozen=True, eq=False)
class Layout:
    """Positions of the unknowns in x; ``size`` marks what is no unknown.

    Attributes
    ----------
    base, platform : (n_legs, 3) array of int
        Joint coordinates; those that are zero by the definition of the frame are no unknowns.
    offset : (n_legs,) array of int
        Offsets; those of legs without an encoder are no unknowns.
    radius : (n_radii,) array of int
        Radii, one for each of ``parts``.
    camera : (n_views, 6) array of int
        Rotation and translation of each camera; cameras that show nothing are no unknowns.
    pose : (n_poses, 6) array of int
        Rotation and translation of each platform pose.
    parts : tuple of (int, str)
        Leg index and part of each radius.
    size : int
        Number of unknowns.
    """

    base: IntArray
    platform: IntArray
    offset: IntArray
    radius: IntArray
    camera: IntArray
    pose: IntArray
    parts: tuple[tuple[int, str], ...]
    size: int

    @property
    def kinematic(self) -> IntArray:
        """Positions of the kinematic parameters, in the order of ``parameters.to_vector``."""
        ordered = np.concatenate([self.base.ravel(), self.platform.ravel(), self.offset])
        return ordered[ordered < self.size]

    @property
    def n_kept(self) -> int:
        """Number of unknowns other than platform poses; they come first."""
        return self.size - self.pose.size


def lay_out(
    frame_legs: Sequence[int],
    has_offset: BoolArray,
    parts: Sequence[tuple[int, str]],
    camera_is_seen: BoolArray,
    n_poses: int,
) -> Layout:
    """Return the layout of the unknowns.

    Parameters
    ----------
    frame_legs : sequence of 3 int
        The legs that define R_b and R_e.
    has_offset : (n_legs,) array of bool
        Which legs have an encoder or a constant length.
    parts : sequence of (int, str)
        Leg index and part of each radius.
    camera_is_seen : (n_views,) array of bool
        Which views have outlines or axes.
    n_poses : int
        Number of platform poses.

    Returns
    -------
    Layout
    """
    free = free_coordinates(len(has_offset), frame_legs)
    masks = [
        free,
        free,
        has_offset,
        np.ones(len(parts), dtype=np.bool_),
        np.repeat(camera_is_seen[:, None], 6, axis=1),
        np.ones((n_poses, 6), dtype=np.bool_),
    ]
    size = int(sum(mask.sum() for mask in masks))
    positions, first = [], 0
    for mask in masks:
        position = np.full(mask.shape, size, dtype=np.intp)
        count = int(mask.sum())
        position[mask] = np.arange(first, first + count)
        positions.append(position)
        first += count
    base, platform, offset, radius, camera, pose = positions
    return Layout(base, platform, offset, radius, camera, pose, tuple(parts), size)


@dataclass(frozen=True, eq=False)
class State:
    """Values of everything that the fit moves.

    Attributes
    ----------
    base_joints, platform_joints : (n_legs, 3) array
        A in R_b and B in R_e [m].
    offsets : (n_legs,) array
        q0 [m]; NaN for legs without one.
    radii : (n_radii,) array
        Radii [m] of the layout's parts.
    R_camera, t_camera : (n_views, 3, 3) and (n_views, 3) array
        Rotation and translation [m] of T_camera_Rb.
    R_pose, t_pose : (n_poses, 3, 3) and (n_poses, 3) array
        Rotation and translation [m] of T_Rb_Re.
    """

    base_joints: Array
    platform_joints: Array
    offsets: Array
    radii: Array
    R_camera: Array
    t_camera: Array
    R_pose: Array
    t_pose: Array

    @property
    def parameters(self) -> KinematicParameters:
        """The kinematic parameters."""
        return KinematicParameters(self.base_joints, self.platform_joints, self.offsets)

    @property
    def T_camera_Rb(self) -> tuple[RigidTransform, ...]:
        """Camera poses, one a view."""
        return motions(self.R_camera, self.t_camera)

    @property
    def T_Rb_Re(self) -> tuple[RigidTransform, ...]:
        """Platform poses."""
        return motions(self.R_pose, self.t_pose)

    def moved(self, x: Array, layout: Layout) -> State:
        """Return the state after a change x [mm, mrad] of its unknowns."""
        change = np.append(UNIT * x, 0.0)
        camera, pose = change[layout.camera], change[layout.pose]
        return State(
            self.base_joints + change[layout.base],
            self.platform_joints + change[layout.platform],
            self.offsets + change[layout.offset],
            self.radii + change[layout.radius],
            turned(self.R_camera, camera[:, :3]),
            self.t_camera + camera[:, 3:],
            turned(self.R_pose, pose[:, :3]),
            self.t_pose + pose[:, 3:],
        )


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
    together = RigidTransform.from_components(t, Rotation.from_matrix(R))
    return tuple(together[i] for i in range(len(R)))
