"""Simulated cameras: their lenses, where they look, and how roughly their places are told."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DatasetError
from legcal.files import FileSchema, MotionEntry, PlainName, parse_yaml, read_text, validate
from legcal.geometry import Array, motion_of
from legcal.vision import Camera, read_camera

UPWARD = np.array([0.0, 0.0, 1.0])

_SHIFT = 0.015  # [m] at most; a dataset may be off by 2 cm and 2 degrees
_TURN = float(np.deg2rad(1.5))

MOST_SIDE, MOST_PIXELS = 65_535, 100_000_000  # what PNG files and memory hold


def sample_camera() -> Camera:
    """Return a camera of 1024 x 768 pixels without distortion, as of the example hexapod."""
    K = np.array([[1290.3, 0.0, 518.3], [0.0, 1290.3, 379.6], [0.0, 0.0, 1.0]])
    return Camera(K, 1024, 768)


def mild_lens() -> Camera:
    """Return the camera of :func:`sample_camera` behind a lens that distorts a little."""
    pinhole = sample_camera()
    return replace(pinhole, distortion=np.array([-0.1, 0.03, 2e-4, -1e-4, 0.0]))


def look_at(
    position: Array, target: Array, roll: float = 0.0, *, up: Array = UPWARD
) -> RigidTransform:
    """Return the pose of a camera that looks at a point, with its y axis down."""
    z = (target - position) / np.linalg.norm(target - position)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    upright = np.column_stack([x, np.cross(z, x), z])
    return motion_of(upright @ Rotation.from_euler("z", roll).as_matrix(), position)


def rough_pose(T_base_camera: RigidTransform, rng: np.random.Generator) -> RigidTransform:
    """Return a camera pose that is up to 15 mm and 1.5 degrees off."""
    shift = _SHIFT * rng.random() * _any_direction(rng)
    turn = Rotation.from_rotvec(_TURN * rng.random() * _any_direction(rng))
    return RigidTransform.from_components(
        T_base_camera.translation + shift, turn * T_base_camera.rotation
    )


def _any_direction(rng: np.random.Generator) -> Array:
    """Return a unit vector (3,) that points anywhere."""
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


class PlaceEntry(FileSchema):
    """One camera."""

    T_base_camera: MotionEntry
    camera: str | None = None


class CamerasEntry(FileSchema):
    """The whole file."""

    views: Annotated[dict[PlainName, PlaceEntry], Field(min_length=1)]


def read_lens(path: Path) -> Camera:
    """Return the camera of a camera file, of a size that pictures can have."""
    camera = read_camera(path)
    if max(camera.width, camera.height) > MOST_SIDE or camera.width * camera.height > MOST_PIXELS:
        raise DatasetError(
            f"{path}: the camera could not be simulated: found {camera.width} x {camera.height} "
            f"px, needed at most {MOST_SIDE} px a side and {MOST_PIXELS // 10**6} million px; "
            "correct its image size."
        )
    return camera


def read_cameras(path: Path, camera: Camera) -> dict[str, tuple[Camera, RigidTransform]]:
    """Return the camera and T_base_camera of every view of a file."""
    found = parse_yaml(read_text(path, "cameras file"), path, "cameras file")
    entry = validate(CamerasEntry, found, path)
    return {
        name: (
            camera if view.camera is None else read_lens(path.parent / view.camera),
            view.T_base_camera.motion(),
        )
        for name, view in entry.views.items()
    }
