"""How close a calibration came to what `legcal plan` expected of its session."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from legcal.calibration.joint_fit.platform import PlatformAccuracy
from legcal.errors import DatasetError
from legcal.files.reading import read_json

PLAN_NAME = "plan.json"  # what a session that was planned says of itself
AS_PLANNED = 1.3  # times the error that was expected: no more needs no remark on light


def closeness(folder: Path, n_images: int, platform: PlatformAccuracy | None) -> tuple[str, ...]:
    """Return a sentence on a planned session; nothing where a dataset was not planned."""
    file = folder / PLAN_NAME
    try:
        plan = read_json(file)
    except FileNotFoundError:
        return ()
    except (OSError, ValueError, DatasetError):
        return (
            f"{file} cannot be read: how close the session came to its plan is not known; copy the "
            "file from the planned session.",
        )
    try:
        planned, expected = int(plan["images"]), plan["expected"]
        dX, dE = float(expected["dX_m"]), float(expected["dE_rad"])
        beside = plan.get("given")
    except (ValueError, KeyError, TypeError, AttributeError):
        return ()
    if platform is None or platform.workspace is None or not dX > 0.0:
        return ()
    if beside:
        return (
            f"The session was planned to add to {beside}, whose images the plan counts on: put its "
            "views and rows there, and calibrate both together.",
        )
    found = platform.workspace
    ratio = found.mean_displacement / dX
    sentence = (
        f"Predicted error over the workspace: {1e3 * found.mean_displacement:.3f} mm / "
        f"{np.degrees(found.mean_rotation):.4f} deg with {n_images} images, {ratio:.2f} times the "
        f"plan ({1e3 * dX:.3f} mm / {np.degrees(dE):.4f} deg with {planned} images)."
    )
    if ratio > AS_PLANNED:
        sentence += (
            " Images that are missing or show fewer legs, or edges that are noisier than planned, "
            "make the difference: see legcal detect, and plan with --noise of this result."
        )
    return (sentence,)
