"""Camera files as legcal writes them: ROS camera_info."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import yaml

from legcal.vision.camera import Camera


def camera_info(camera: Camera, name: str, more: Mapping[str, Any] | None = None) -> str:
    """Return the text of a ROS camera_info file that reads back as the same camera.

    Parameters
    ----------
    camera : Camera
        The camera.
    name : str
        What the file calls it.
    more : mapping, optional
        Keys that stand at the end; ROS does not read them.
    """
    distortion = camera.distortion if len(camera.distortion) else np.zeros(5)
    projection = np.column_stack([camera.K, np.zeros(3)])
    document = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": {"rows": 3, "cols": 3, "data": camera.K.ravel().tolist()},
        "distortion_model": camera.model,
        "distortion_coefficients": {
            "rows": 1,
            "cols": len(distortion),
            "data": distortion.tolist(),
        },
        "rectification_matrix": {"rows": 3, "cols": 3, "data": np.eye(3).ravel().tolist()},
        "projection_matrix": {"rows": 3, "cols": 4, "data": projection.ravel().tolist()},
        **(more or {}),
    }
    return str(yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=100))
