"""The pose of a camera before a plane with known points: planar PnP, both of its solutions.

A plane that is seen with little perspective has two poses that show it almost alike (IPPE). Both
are refined in the image, with the whole model of the lens, and kept while both explain it.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry import Array, cross_matrices, motion_of
from legcal.vision.camera import Camera

_ITERATIONS = 50
_STOP = 1e-10  # what a step would change of the cost, as a part of it
_HUBER = 3.0  # standard deviations from which a corner counts less and less
_SAME = 1e-3  # [rad] between solutions that are one


@dataclass(frozen=True, eq=False)
class PlanePose:
    """A pose that explains the points of a plane."""

    T_camera_plane: RigidTransform  # the pose of the plane in the camera
    cost: float  # half the sum of squares of weighted residuals, large ones by Huber's loss
    residual_px: Array  # (n, 2) pixels less where the points should be seen [px]
    information: Array  # (6, 6) of a shift [m] and a turn [rad] of the plane


def plane_poses(
    camera: Camera,
    points: Array,  # (n, 3) four points or more of the plane z = 0, not all on a line [m]
    px: Array,  # (n, 2) where they are seen [px]
    sigma_px: Array,  # (n,) standard deviations of either coordinate [px]
) -> list[PlanePose]:
    """Return the poses of a plane that explain where its points are seen, the better one first."""
    middle = points.mean(axis=0)
    xy = camera.undistort(px)
    found, turns, shifts, _ = cv2.solvePnPGeneric(
        np.ascontiguousarray(points - middle),
        np.ascontiguousarray(xy),
        np.eye(3),
        np.zeros(0),
        flags=cv2.SOLVEPNP_IPPE,
    )
    starts = [
        RigidTransform.from_components(np.ravel(t), Rotation.from_rotvec(np.ravel(w)))
        * RigidTransform.from_translation(-middle)
        for w, t in zip(turns[:found], shifts[:found], strict=True)
        if np.all(np.isfinite(w)) and np.all(np.isfinite(t))
    ]
    poses: list[PlanePose] = []
    for start in starts:
        pose = refined_pose(camera, points, px, sigma_px, start)
        if pose is not None and all(_apart(pose, other) > _SAME for other in poses):
            poses.append(pose)
    return sorted(poses, key=lambda pose: pose.cost)


def refined_pose(
    camera: Camera, points: Array, px: Array, sigma_px: Array, start: RigidTransform
) -> PlanePose | None:
    """Return the pose of least cost near a start; None if it puts points behind the camera."""
    here = _evaluated(camera, points, px, sigma_px, start)
    damping = 1e-6
    for _ in range(_ITERATIONS):
        if here is None:
            return None
        pose, gradient = here
        H = pose.information
        damped = H + damping * np.diag(np.diag(H)) + 1e-12 * np.eye(6)
        step = np.asarray(-np.linalg.solve(damped, gradient), dtype=np.float64)
        there = _evaluated(camera, points, px, sigma_px, _moved(pose.T_camera_plane, step))
        if there is not None and there[0].cost <= pose.cost:
            here, damping = there, max(0.1 * damping, 1e-12)
        else:
            damping *= 10.0
        if -float(gradient @ step) < _STOP * max(pose.cost, 1.0) or damping > 1e8:
            break
    return None if here is None else here[0]


def _evaluated(
    camera: Camera, points: Array, px: Array, sigma_px: Array, T: RigidTransform
) -> tuple[PlanePose, Array] | None:
    """Return a pose with its cost, and the gradient of that."""
    P = np.asarray(T.apply(points))
    if P[:, 2].min() <= 0.0:
        return None
    xy = P[:, :2] / P[:, 2:]
    residual = px - camera.distort(xy)
    t = residual / sigma_px[:, None]
    size = np.linalg.norm(t, axis=1)
    weight = np.minimum(1.0, _HUBER / np.maximum(size, 1e-12))
    far = size > _HUBER
    cost = float(np.where(far, _HUBER * (size - 0.5 * _HUBER), 0.5 * size**2).sum())
    by_point = np.zeros((len(P), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0
    by_point[:, :, 2] = -xy
    by_point = camera.pixels_per_unit(xy) @ by_point / P[:, 2, None, None]
    arm = P - T.translation
    by_turn = -by_point @ cross_matrices(arm)
    J = np.concatenate([by_point, by_turn], axis=-1) / sigma_px[:, None, None]
    weighted = J * weight[:, None, None]
    information = np.einsum("nia,nib->ab", weighted, J)
    gradient = -np.einsum("nia,ni->a", weighted, t)
    return PlanePose(T, cost, residual, information), gradient


def _moved(T: RigidTransform, step: Array) -> RigidTransform:
    """Return a pose shifted [m] and turned [rad] about its own origin, in the camera frame."""
    turn = Rotation.from_rotvec(step[3:]).as_matrix()
    return motion_of(turn @ T.as_matrix()[:3, :3], T.translation + step[:3])


def _apart(one: PlanePose, other: PlanePose) -> float:
    """Return the angle between two poses [rad]."""
    turn = one.T_camera_plane.rotation * other.T_camera_plane.rotation.inv()
    return float(turn.magnitude())
