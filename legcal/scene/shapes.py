"""Shapes beside the legs: ellipsoids at joints, pyramids of cameras."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array

if TYPE_CHECKING:
    from legcal.calibration.documents import Result
    from legcal.vision.camera import Camera


def ellipsoids(result: Result) -> dict[str, Array]:
    """Return half axes of one sigma at the joints of base and platform, (n, 3, 3) [m].

    Columns are axes, in the link; they are zero along fixed coordinates and those that define a
    frame.
    """
    half_axes = {}
    for side, block in (result.links or {}).items():
        value, vector = np.linalg.eigh(np.array([joint.covariance for joint in block.joints]))
        half_axes[str(side)] = vector * np.sqrt(np.maximum(value, 0.0))[:, None]
    return half_axes


def enlargement(axes: Mapping[str, Array], radius: float) -> float:
    """Return the factor 1, 2, 5, 10, ... that enlarges the median ellipsoid to nearly *radius*."""
    longest = [np.linalg.norm(of_side, axis=1).max(axis=1) for of_side in axes.values()]
    seen = np.concatenate([*longest, np.zeros(0)])
    usual = float(np.median(seen[seen > 0.0])) if np.any(seen > 0.0) else 1.0
    wanted = radius / usual
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * max(s for s in (1, 2, 5) if s * power <= wanted))


def pyramid(camera: Camera, T_base_camera: RigidTransform, depth: float) -> Array:
    """Return the centre of a camera and the corners of its view at a depth [m], (5, 3)."""
    w, h = camera.width - 0.5, camera.height - 0.5
    corners = camera.undistort(np.array([[-0.5, -0.5], [w, -0.5], [w, h], [-0.5, h]]))
    rays = depth * np.concatenate([corners, np.ones((4, 1))], axis=1)
    return np.asarray(T_base_camera.apply(np.concatenate([np.zeros((1, 3)), rays])))
