"""The pose of a camera from known points: perspective-n-point, robust against wrong points.

Poses from four points each are compared by the robust cost of all points, and the better ones
refined. Points of a plane with little perspective have two poses of almost the same cost; both are
returned.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array, IntArray
from legcal.vision.camera import Camera

MIN_POINTS = 4
MAX_SUBSETS, SEED = 120, 1965  # maximum number of subsets of four points, and seed of their choice
N_REFINED = 8
TRUNCATION = 4.0  # standard deviations from which on a point counts as wrong
SAME_ANGLE = np.deg2rad(3.0)
MAX_STEPS, SMALL_STEP = 60, 1e-10  # maximum number of steps, and relative size of the last step
LINE = 0.02  # maximum ratio of width to length of collinear points


@dataclass(frozen=True, eq=False)
class PointPose:
    """A camera pose from points, with cost and covariance."""

    T_camera_base: RigidTransform
    cost: float  # half the sum of squares of distances [sigma], none larger than the truncation
    off_px: Array  # (n,) distance of each point from where it should be seen [px]
    covariance: Array  # (6, 6) of a rotation [rad] and a shift [m] of the camera in its frame


def on_a_line(points: Array) -> bool:
    """Return whether points (n, 3) are on a line, or nearly."""
    size = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return len(points) < 3 or bool(size[1] <= LINE * size[0])


def camera_poses_by_points(
    camera: Camera,
    points: Array,  # (n, 3) four points or more, not all on a line [m]
    px: Array,  # (n, 2) their pixels
    sigma_px: Array,  # (n,) standard deviations of either coordinate [px]
) -> list[PointPose]:
    """Return the camera poses that fit the pixels of points, the likeliest first.

    Points that contradict all others count little. The list is empty if no pose has the points in
    front of the camera.
    """
    middle, xy = points.mean(axis=0), camera.undistort(px)
    shown = points - middle
    starts = [
        pose
        for some in _subsets(len(points))
        if not on_a_line(shown[some])
        for pose in closed_form_poses(shown[some], xy[some], cv2.SOLVEPNP_SQPNP)
    ]
    cost = np.array([_cost(camera, pose, shown, px, sigma_px) for pose in starts])
    refined: list[PointPose] = []
    tried: list[RigidTransform] = []
    for k in np.argsort(cost, kind="stable").tolist():
        if len(tried) == N_REFINED or not np.isfinite(cost[k]):
            break
        if _is_new(starts[k], tried):
            tried.append(starts[k])
            refined.append(_refined(camera, starts[k], shown, px, sigma_px))
    best = list[PointPose]()
    for candidate in sorted(refined, key=lambda pose: pose.cost):
        if np.isfinite(candidate.cost) and _is_new(
            candidate.T_camera_base, [p.T_camera_base for p in best]
        ):
            best.append(candidate)
    back = RigidTransform.from_translation(-middle)
    return [
        PointPose(
            candidate.T_camera_base * back,
            candidate.cost,
            candidate.off_px,
            candidate.covariance,
        )
        for candidate in best
    ]


def _subsets(n: int) -> Iterator[IntArray]:
    """Yield all points together, and many choices of four of them."""
    yield np.arange(n)
    subsets = list(itertools.islice(itertools.combinations(range(n), MIN_POINTS), MAX_SUBSETS + 1))
    if len(subsets) <= MAX_SUBSETS:
        yield from (np.array(subset, dtype=np.intp) for subset in subsets if n > MIN_POINTS)
        return
    rng = np.random.default_rng(SEED)
    for _ in range(MAX_SUBSETS):
        yield rng.choice(n, MIN_POINTS, replace=False)


def closed_form_poses(points: Array, xy: Array, method: int) -> Iterator[RigidTransform]:
    """Yield T_camera_points by a method of OpenCV, of points (n, 3) seen at (n, 2).

    The latter are of the sensor plane.
    """
    middle = points.mean(axis=0)
    n, turns, shifts, _ = cv2.solvePnPGeneric(
        np.ascontiguousarray(points - middle),
        np.ascontiguousarray(xy),
        np.eye(3),
        np.zeros(0),
        flags=method,
    )
    for w, t in zip(turns[:n], shifts[:n], strict=True):
        if np.all(np.isfinite(w)) and np.all(np.isfinite(t)):
            R = Rotation.from_rotvec(np.ravel(w))
            yield RigidTransform.from_components(np.ravel(t) - R.apply(middle), R)


def _is_new(pose: RigidTransform, others: list[RigidTransform]) -> bool:
    """Return whether a pose differs from all others by more than ``SAME_ANGLE``."""
    return all((pose.rotation * o.rotation.inv()).magnitude() > SAME_ANGLE for o in others)


def _cost(camera: Camera, pose: RigidTransform, points: Array, px: Array, sigma_px: Array) -> float:
    """Return the robust cost of a pose; infinite if most points are behind the camera."""
    P = pose.apply(points)
    ahead = P[:, 2] > 0.0
    if 2 * np.count_nonzero(ahead) <= len(P):
        return float("inf")
    square = np.full(len(P), TRUNCATION**2)
    off = (camera.project(P[ahead]) - px[ahead]) / sigma_px[ahead, None]
    square[ahead] = np.minimum(np.sum(off**2, axis=1), TRUNCATION**2)
    return 0.5 * float(square.sum())


def _refined(
    camera: Camera, start: RigidTransform, points: Array, px: Array, sigma_px: Array
) -> PointPose:
    """Return the pose of least robust cost near a start, by Levenberg-Marquardt steps."""
    R, t = start.rotation.as_matrix(), start.translation
    scale = np.repeat([1.0, float(np.linalg.norm(t))], 3)
    value, JtJ, gradient = _normal_equations(camera, R, t, points, px, sigma_px)
    damping = 1e-3
    for _ in range(MAX_STEPS):
        A = JtJ * np.outer(scale, scale)
        step = -scale * np.linalg.solve(A + damping * np.diag(np.diag(A)) + 1e-12 * np.eye(6),
                                        scale * gradient)  # fmt: skip
        moved = Rotation.from_rotvec(step[:3]).as_matrix() @ R, t + step[3:]
        tried = _normal_equations(camera, *moved, points, px, sigma_px)
        if tried[0] < value:
            (R, t), (value, JtJ, gradient) = moved, tried
            damping = max(0.2 * damping, 1e-9)
        else:
            damping *= 5.0
        if np.abs(step / scale).max() < SMALL_STEP or damping > 1e9:
            break
    pose = RigidTransform.from_components(t, Rotation.from_matrix(R))
    P = pose.apply(points)
    ahead = P[:, 2] > 0.0
    off = np.full(len(P), np.inf)
    off[ahead] = np.linalg.norm(camera.project(P[ahead]) - px[ahead], axis=1)
    # From a rotation about the middle of the points and its shift to the camera's
    C = scale[:, None] * np.linalg.pinv(JtJ * np.outer(scale, scale), hermitian=True) * scale
    x, y, z = t
    by = np.eye(6)
    by[3:, :3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    by[3:, 3:] *= -1.0
    return PointPose(pose, _cost(camera, pose, points, px, sigma_px), off, by @ C @ by.T)


def _normal_equations(
    camera: Camera, R: Array, t: Array, points: Array, px: Array, sigma_px: Array
) -> tuple[float, Array, Array]:
    """Return cost, matrix (6, 6) and gradient by a turn and a shift of points; Cauchy's loss."""
    turned = points @ R.T
    P = turned + t
    ahead = P[:, 2] > 1e-3 * np.linalg.norm(t)
    width = 0.5 * TRUNCATION
    behind = float(np.count_nonzero(~ahead)) * 0.5 * width**2 * np.log1p(1e4)
    projected, by_point = camera.project_with_derivative(P[ahead])
    r = (projected - px[ahead]) / sigma_px[ahead, None]
    square = np.sum(r**2, axis=1) / width**2
    x, y, z = turned[ahead].T
    zero = np.zeros_like(x)
    by_turn = np.moveaxis(np.array([[zero, z, -y], [-z, zero, x], [y, -x, zero]]), -1, 0)
    J = np.concatenate([by_point @ by_turn, by_point], axis=2) / sigma_px[ahead, None, None]
    weighted = J / (1.0 + square)[:, None, None]
    cost = behind + 0.5 * width**2 * float(np.log1p(square).sum())
    return cost, np.einsum("nki,nkj->ij", weighted, J), np.einsum("nki,nk->i", weighted, r)
