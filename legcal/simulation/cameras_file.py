"""The file that says where simulated cameras stand.

It is the block ``views`` of a dataset::

    views:
      c1: {T_base_camera: {xyz: [1.0, 0.3, 0.3], quat_xyzw: [0, 0, 0, 1]}, camera: lens.yaml}
      c2: {T_base_camera: {xyz: [0.0, 1.1, 0.3], quat_xyzw: [0, 0, 0, 1]}}

``camera`` is relative to the file, and may be left out.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field
from scipy.spatial.transform import RigidTransform

from legcal.errors import DatasetError
from legcal.files.motion import MotionEntry
from legcal.files.schema import FileSchema, PlainName, parse_yaml, read_text, validate
from legcal.vision.camera import Camera
from legcal.vision.camera_file import read_camera

MOST_SIDE, MOST_PIXELS = 65_535, 100_000_000  # what PNG files and memory hold


class PlaceEntry(FileSchema):
    """One camera."""

    T_base_camera: MotionEntry
    camera: str | None = None


class CamerasEntry(FileSchema):
    """The whole file."""

    views: Annotated[dict[PlainName, PlaceEntry], Field(min_length=1)]


def read_lens(path: Path) -> Camera:
    """Return the camera of a camera file, of a size that pictures can have.

    Raises
    ------
    DatasetError
        If the file is malformed, or its pictures too large.
    """
    camera = read_camera(path)
    if max(camera.width, camera.height) > MOST_SIDE or camera.width * camera.height > MOST_PIXELS:
        raise DatasetError(
            f"{path}: the camera could not be simulated: found {camera.width} x {camera.height} "
            f"px, needed at most {MOST_SIDE} px a side and {MOST_PIXELS // 10**6} million px; "
            "correct its image size."
        )
    return camera


def read_cameras(path: Path, camera: Camera) -> dict[str, tuple[Camera, RigidTransform]]:
    """Return the camera and T_base_camera of every view of a file.

    Parameters
    ----------
    path : Path
        The file.
    camera : Camera
        The camera of views that name none.

    Raises
    ------
    DatasetError
        With one sentence for each thing that is wrong.
    """
    found = parse_yaml(read_text(path, "cameras file"), path, "cameras file")
    entry = validate(CamerasEntry, found, path)
    return {
        name: (
            camera if view.camera is None else read_lens(path.parent / view.camera),
            view.T_base_camera.motion(),
        )
        for name, view in entry.views.items()
    }
