"""Camera files written: for datasets as ROS has them, and for other programs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from legcal.errors import UsageError
from legcal.files.folder import OutputFile
from legcal.files.published import with_schema
from legcal.vision.camera import Camera, intrinsic_names
from legcal.vision.camera_file import (
    CALIBRATED,
    PARAMETERS,
    calibrated_block,
    read_camera,
)
from legcal.vision.distortion import CameraProgram

_MARK = "# camera converted by legcal\n"
CONVERTED = OutputFile(
    "the camera", "camera file", "", "a new file or one that this command wrote", _MARK.encode()
)


def camera_info(camera: Camera, name: str, more: Mapping[str, Any] | None = None) -> str:
    """Return the text of a ROS camera_info file that reads back as the same camera."""
    distortion = camera.distortion if len(camera.distortion) else np.zeros(5)
    projection = np.column_stack([camera.K, np.zeros(3)])
    document = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": {"rows": 3, "cols": 3, "data": camera.K.ravel().tolist()},
        # ROS passes on any number of coefficients of this name to OpenCV.
        "distortion_model": (
            "rational_polynomial" if camera.model == "thin_prism" else camera.model
        ),
        "distortion_coefficients": {
            "rows": 1,
            "cols": len(distortion),
            "data": distortion.tolist(),
        },
        "rectification_matrix": {"rows": 3, "cols": 3, "data": np.eye(3).ravel().tolist()},
        "projection_matrix": {"rows": 3, "cols": 4, "data": projection.ravel().tolist()},
        **(more or {}),
    }
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=100)
    return with_schema("camera", text)


def rough_camera_info(camera: Camera, name: str) -> str:
    """Return the text of the camera file of a rough camera, with its covariance."""
    names = intrinsic_names(camera)
    C = np.zeros((len(names), len(names))) if camera.covariance is None else camera.covariance
    inexact = [i for i in range(len(names)) if C[i, i] > 0.0]
    stated = {
        "version": 1,
        "sigma": {names[i]: float(np.sqrt(C[i, i])) for i in inexact},
        "names": [names[i] for i in inexact],
        "covariance": C[np.ix_(inexact, inexact)].tolist(),
    }
    return camera_info(camera, name, {CALIBRATED: stated})


def convert_camera(path: Path, program: CameraProgram, output: Path) -> list[str]:
    """Write a camera file in the form of a program; return lines that say what was done.

    The covariance of a camera that legcal calibrated is kept for ros, which alone can hold it.

    Raises
    ------
    DatasetError
        If the camera file cannot be read.
    UsageError
        If the program has no such lens, or if another file stands there.
    """
    CONVERTED.check_place(output)
    camera, block = read_camera(path), calibrated_block(path)
    more = {CALIBRATED: block} if block and program == "ros" else None
    text = camera_text(camera, program, output.stem, more)
    CONVERTED.write(output, text.replace("\n", f"\n{_MARK}", 1))
    lines = [f"written: {output}"]
    if block and not more:
        lines.append(
            f"The covariance of the camera is left out, as files of {program} do not hold it; a "
            f"session that is to use it needs {path}."
        )
    return lines


def camera_text(
    camera: Camera, program: CameraProgram, name: str, more: Mapping[str, Any] | None = None
) -> str:
    """Return the text of a camera file in the form of a program; only ros has more entries.

    Raises UsageError if the program has no such lens.
    """
    if program == "ros":
        return camera_info(camera, name, more)
    D = camera.distortion.tolist()
    if camera.K[0, 1] != 0.0:
        raise _no_such_lens(camera, program, "a camera without skew")
    numbers = [camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]]
    pinhole = [float(number) for number in numbers]
    if program == "opencv":
        return _storage(camera)
    if program == "mrcal":
        n = len(pinhole) + len(D)
        for lens, (model, parameters) in PARAMETERS["mrcal"].items():
            if (model, len(parameters.split())) == (camera.model, n):
                size = [camera.width, camera.height]
                return (
                    f"{{\n    'lensmodel':  '{lens}',\n    'extrinsics': {[0.0] * 6},\n"
                    f"    'intrinsics': {pinhole + D},\n    'imagersize': {size},\n}}\n"
                )
        raise _no_such_lens(camera, program, "plumb_bob, rational_polynomial or thin_prism")
    lens = {"plumb_bob": "radtan", "equidistant": "equidistant"}.get(camera.model, "")
    if not lens or (lens == "radtan" and any(D[4:])):
        raise _no_such_lens(camera, program, "radtan (plumb_bob with k3 = 0) or equidistant")
    block = {
        "cam_overlaps": [],
        "camera_model": "pinhole",
        "distortion_coeffs": D[:4] or [0.0] * 4,
        "distortion_model": lens,
        "intrinsics": pinhole,
        "resolution": [camera.width, camera.height],
    }
    return yaml.safe_dump({"cam0": block}, sort_keys=False, default_flow_style=None, width=1000)


def _no_such_lens(camera: Camera, program: CameraProgram, needed: str) -> UsageError:
    """Return the error for a camera that a program cannot hold."""
    skew = " with skew" if camera.K[0, 1] != 0.0 else ""
    return UsageError(
        f"The camera could not be written for {program}: found the lens {camera.model}{skew}, "
        f"needed {needed}; choose another program, or calibrate with another --model."
    )


def _storage(camera: Camera) -> str:
    """Return the text of an OpenCV FileStorage."""
    storage = cv2.FileStorage("camera.yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    storage.write("camera_matrix", camera.K)
    storage.write("distortion_model", camera.model)
    D = camera.distortion if len(camera.distortion) else np.zeros(5)
    storage.write("distortion_coefficients", D[:, None])
    storage.write("fisheye_model", int(camera.model == "equidistant"))
    return str(storage.releaseAndGetString())
