"""Outlines of some images after a camera was turned or refocused, or a joint moved."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from legcal.data.dataset import Dataset
from legcal.geometry.types import Array, BoolArray
from legcal.simulation.observe import Scene, shifted_outlines
from legcal.vision.cylinder import outlines_of_axis


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


def with_moved_joint(
    dataset: Dataset, scene: Scene, later: BoolArray, j: int, by: Array
) -> Dataset:
    """Return a session in which the joint at A of a leg from point to point moves by (3,) [m].

    Outlines move by as much as exact ones do.
    """
    o = dataset.observations
    assert o is not None
    A, B = scene.A.copy(), scene.B.copy()
    A[:, j] += by
    for k in range(len(A)):
        lengths = np.linalg.norm(scene.B[k] - scene.A[k], axis=1)

        def platform(x: Array, B: Array = scene.B[k]) -> Array:
            middle = B.mean(axis=0)
            return np.asarray(Rotation.from_rotvec(x[:3]).apply(B - middle) + middle + x[3:])

        def error(x: Array, k: int = k, lengths: Array = lengths, at: Any = platform) -> Array:
            return np.asarray(np.linalg.norm(at(x) - A[k], axis=1) - lengths)

        found = least_squares(error, np.zeros(6), xtol=1e-14, ftol=1e-14, gtol=1e-14)
        B[k] = platform(found.x)
    moved, m = replace(scene, A=A, B=B), dataset.measurements
    h, ends = o.h.copy(), o.ends.copy()
    for i in np.flatnonzero(later[o.row]).tolist():
        row, leg, side = int(o.row[i]), int(o.leg[i]), int(o.edge[i]) - 1
        camera = m.views[m.view[row]].camera
        radius = dataset.machine.legs[leg].radius_of_part[o.part[i]]
        xy = camera.undistort(ends[i])
        lines = (outlines_of_axis(*s.leg_in_camera(row, leg), radius) for s in (scene, moved))
        was, now = (camera.line_offset(line[side][None], xy) for line in lines)
        h[[i]], ends[[i]] = shifted_outlines(camera, h[[i]], ends[[i]], (was - now)[None])
    return replace(dataset, observations=replace(o, h=h, ends=ends))
