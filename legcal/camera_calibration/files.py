"""The camera file that a calibration writes: a ROS camera_info with what else is known."""

from __future__ import annotations

import os
from pathlib import Path

from legcal.camera_calibration.result import CameraCalibration
from legcal.errors import DatasetError, OutOfResources, UsageError
from legcal.files.atomic import write_atomically
from legcal.files.schema import parse_yaml, read_text
from legcal.vision.camera_schema import CALIBRATED
from legcal.vision.camera_writer import camera_info

_WHAT = "camera file"
_DIGITS = 6  # of figures that describe the calibration


def check_camera_place(path: Path) -> None:
    """Refuse a place where no camera file can be written, or another file stands.

    Raises
    ------
    UsageError
        With what is there instead.
    """
    start = f"{path}: the camera could not be written: found"
    if not path.name or os.path.isdir(path):
        raise UsageError(f"{start} a folder, needed the name of a file; give one in it.")
    if not os.path.isdir(path.parent):
        raise UsageError(
            f"{start} no folder {path.parent}, needed one that exists; create it or give another "
            "file."
        )
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise UsageError(
            f"{start} that {path.parent} cannot be written to, needed permission to create files "
            "in it; give another file."
        )
    if not os.path.lexists(path):
        return
    try:
        is_own = CALIBRATED in parse_yaml(read_text(path, _WHAT), path, _WHAT)
    except DatasetError:
        is_own = False
    if not is_own:
        raise UsageError(
            f"{start} another file of that name, needed a new file or one that this command wrote; "
            "give another file."
        )


def write_camera(calibration: CameraCalibration, path: Path) -> None:
    """Write a camera; an earlier one of this command is replaced, any other file is not.

    Raises
    ------
    UsageError
        As :func:`check_camera_place`.
    OutOfResources
        If the file cannot be written.
    """
    check_camera_place(path)
    names, sigma = calibration.names, calibration.sigma.tolist()
    block = {
        "version": 1,
        "rms_px": _short(calibration.rms_px),
        "coverage": _short(calibration.coverage),
        "sigma": {name: _short(s) for name, s in zip(names, sigma, strict=True)},
        "images": [
            {"image": i.name, "corners": i.used, "rms_px": _short(i.rms_px)}
            for i in calibration.images
            if i.rms_px is not None
        ],
        "warnings": list(calibration.warnings),
    }
    text = camera_info(calibration.camera, path.stem, {CALIBRATED: block})
    try:
        write_atomically(path, text.encode())
    except OSError as error:
        raise OutOfResources(
            f"{path}: the camera could not be written: found '{error.strerror}', needed a folder "
            "that takes it; free some space or give another file."
        ) from error


def _short(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")
