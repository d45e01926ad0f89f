"""Outlines of some images as a camera that was turned or refocused shows them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from legcal.data.dataset import Dataset
from legcal.geometry.types import Array, BoolArray


def turned(angle: float) -> Callable[[Array], Array]:
    """Rays of a camera that was turned about its vertical axis [rad]."""
    return lambda rays: np.asarray(Rotation.from_rotvec([0.0, angle, 0.0]).apply(rays))


def zoomed(part: float) -> Callable[[Array], Array]:
    """Rays of a camera whose focal length grew by a part."""
    return lambda rays: rays * [1.0 + part, 1.0 + part, 1.0]


def with_rays(dataset: Dataset, rows: BoolArray, change: Callable[[Array], Array]) -> Dataset:
    """Change the rays through the outlines of some images of one view."""
    o, m = dataset.observations, dataset.measurements
    assert o is not None
    changed = rows[o.row]
    camera = m.views[int(m.view[rows][0])].camera
    xy = camera.undistort(o.ends[changed].reshape(-1, 2))
    rays = change(np.column_stack([xy, np.ones(len(xy))]))
    first, second = np.moveaxis(rays.reshape(-1, 2, 3), 1, 0)
    normal = np.cross(first, second)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    h, ends = o.h.copy(), o.ends.copy()
    h[changed] = normal * np.sign(np.sum(normal * h[changed], axis=1))[:, None]
    ends[changed] = camera.project(rays).reshape(-1, 2, 2)
    return replace(dataset, observations=replace(o, h=h, ends=ends))
