"""Where the adjustment of a camera begins: OpenCV's answer, or the flattest boards."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.camera_calibration.adjustment import Adjusted, SeenCorners, adjust
from legcal.geometry.types import Array, IntArray
from legcal.vision.camera import Camera, DistortionModel
from legcal.vision.image_file import ImageSize
from legcal.vision.intrinsics import intrinsic_names
from legcal.vision.plane_pose import plane_poses
from legcal.vision.quiet import quiet_opencv

FOCAL_LENGTHS = (0.25, 4.0, 13)  # least to greatest, how many: parts of the longer side
_WIDEST = 1.45  # of an angle to the axis before a fisheye lens [rad]
_ROUGH, _ROUGH_STEPS = ("fx", "fy", "k1"), 12  # looked for first


def adjusted_anyhow(seen: SeenCorners, size: ImageSize, model: DistortionModel) -> Adjusted | None:
    """Return the adjustment from where a camera is roughly right, None if none succeeds.

    Parameters
    ----------
    seen : SeenCorners
        The corners.
    size : ImageSize
        Of the images [px].
    model : {"plumb_bob", "rational_polynomial", "equidistant"}
        How the lens distorts.
    """
    start = None if model == "equidistant" else _by_opencv(seen, size, model)
    start = start or _by_straight_lines(seen, size, model)
    if start is None:
        return None
    rough = adjust(*start, seen, _ROUGH, n_steps=_ROUGH_STEPS)
    return None if rough is None else adjust(rough.camera, rough.T_camera_board, seen)


def _by_straight_lines(
    seen: SeenCorners, size: ImageSize, model: DistortionModel
) -> tuple[Camera, list[RigidTransform]] | None:
    """Return the camera without distortion before which boards are flattest, of several."""
    centre = 0.5 * (size.width - 1.0), 0.5 * (size.height - 1.0)
    cameras = []
    for part in np.geomspace(*FOCAL_LENGTHS).tolist():
        f = part * max(size.width, size.height)
        K = np.array([[f, 0.0, centre[0]], [0.0, f, centre[1]], [0.0, 0.0, 1.0]])
        cameras.append(Camera(K, size.width, size.height, _no_distortion(model), model))
    best = min(cameras, key=lambda camera: _bend(camera, seen))
    poses = []
    for a, b in pairwise(_bounds(seen)):
        found = plane_poses(best, seen.points[a:b], seen.px[a:b], np.ones(b - a))
        if not found:
            return None
        poses.append(found[0].T_camera_plane)
    return best, poses


def _bend(camera: Camera, seen: SeenCorners) -> float:
    """Return how far the corners of boards are from any plane before a camera (rms) [px]."""
    angle = np.linalg.norm(seen.px - camera.K[:2, 2], axis=1) / camera.K[0, 0]
    if camera.model == "equidistant" and angle.max() > _WIDEST:
        return np.inf
    xy = camera.undistort(seen.px)
    off = []
    for a, b in pairwise(_bounds(seen)):
        board = seen.points[a:b, :2]
        H, _ = cv2.findHomography(board, xy[a:b])
        if H is None:
            return np.inf
        flat = np.column_stack([board, np.ones(b - a)]) @ np.asarray(H, dtype=np.float64).T
        off.append(camera.distort(flat[:, :2] / flat[:, 2:]) - seen.px[a:b])
    return float(np.sqrt(np.mean(np.concatenate(off) ** 2)))


def _bounds(seen: SeenCorners) -> IntArray:
    """Return where the corners of each image begin, and where those of the last one end."""
    return np.searchsorted(seen.image, np.arange(seen.image[-1] + 2))


def _by_opencv(
    seen: SeenCorners, size: ImageSize, model: DistortionModel
) -> tuple[Camera, list[RigidTransform]] | None:
    """Return the camera that OpenCV calibrates, with two coefficients of distortion."""
    pieces = list(pairwise(_bounds(seen)))
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    try:
        with quiet_opencv():
            _, K, distortion, turns, shifts = cv2.calibrateCamera(
                [seen.points[a:b].astype(np.float32) for a, b in pieces],
                [seen.px[a:b].astype(np.float32) for a, b in pieces],
                (size.width, size.height),
                np.eye(3),
                np.zeros(5),
                flags=flags,
            )
    except cv2.error:
        return None
    numbers = np.concatenate([np.ravel(K), np.ravel(distortion), np.ravel(turns), np.ravel(shifts)])
    if not np.all(np.isfinite(numbers)) or min(K[0, 0], K[1, 1]) < 1.0:
        return None
    coefficients = _no_distortion(model)
    coefficients[:2] = np.ravel(distortion)[:2]
    poses = [
        RigidTransform.from_components(np.ravel(t), Rotation.from_rotvec(np.ravel(w)))
        for w, t in zip(turns, shifts, strict=True)
    ]
    return Camera(np.asarray(K), size.width, size.height, coefficients, model), poses


def _no_distortion(model: DistortionModel) -> Array:
    return np.zeros(len(intrinsic_names(Camera(np.eye(3), 1, 1, np.zeros(0), model))) - 4)
