"""Which numbers of the cameras a fit looks for, and where the others stand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from legcal.geometry.types import IntArray
from legcal.observations.measurements import Measurements
from legcal.refinement.choices import Choices
from legcal.vision.camera import Camera
from legcal.vision.intrinsics import intrinsic_names, shared_cameras, with_intrinsics


def unknown_intrinsics(
    views: Sequence[str], cameras: Sequence[Camera], owners: Sequence[str], choices: Choices
) -> tuple[IntArray, tuple[str, ...], tuple[str, ...]]:
    """Return the unknown intrinsic of each view (n_views, n_keys), what they are, their names."""
    asked = {*choices.free, *choices.priors}
    names = [
        f"{view}.{key}"
        for view, camera in zip(views, cameras, strict=True)
        if view in owners
        for key in intrinsic_names(camera)
        if f"{view}.{key}" in asked
    ]
    keys = tuple(dict.fromkeys(name.rsplit(".", 1)[1] for name in names))
    number = {name: i for i, name in enumerate(names)}
    index = [[number.get(f"{owner}.{key}", -1) for key in keys] for owner in owners]
    return np.array(index, dtype=np.intp).reshape(len(views), len(keys)), keys, tuple(names)


def chosen_cameras(measurements: Measurements, choices: Choices) -> tuple[Camera, ...]:
    """Return the camera of each view with the intrinsics that are fixed at given values."""
    views = measurements.views
    owners = shared_cameras([view.name for view in views], [view.camera for view in views])
    cameras = []
    for view, owner in zip(views, owners, strict=True):
        given = {
            key: choices.values[f"{owner}.{key}"]
            for key in intrinsic_names(view.camera)
            if f"{owner}.{key}" in choices.values
        }
        cameras.append(with_intrinsics(view.camera, given) if given else view.camera)
    return tuple(cameras)
