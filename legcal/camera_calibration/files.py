"""The camera file that a calibration writes: a ROS camera_info with what else is known."""

from __future__ import annotations

from pathlib import Path

from legcal.camera_calibration.result import CameraCalibration
from legcal.files.own_yaml import OwnYaml
from legcal.vision.camera_schema import CALIBRATED
from legcal.vision.camera_writer import camera_info

CAMERA_FILE = OwnYaml(
    "the camera", "camera file", CALIBRATED, "a new file or one that this command wrote"
)
_DIGITS = 6  # of figures that describe the calibration


def write_camera(calibration: CameraCalibration, path: Path) -> None:
    """Write a camera; an earlier one of this command is replaced, any other file is not.

    Raises
    ------
    UsageError
        If another file stands there, or none can be written.
    OutOfResources
        If the file cannot be written.
    """
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
    CAMERA_FILE.write(path, text)


def _short(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")
