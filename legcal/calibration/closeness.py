"""Comparison of a session with its plan: the expected error, and the commands of its poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from legcal.calibration.joint_fit.platform import PlatformAccuracy
from legcal.calibration.quantities import mm_deg
from legcal.data.dataset import Dataset
from legcal.data.reading_units import legs_with_readings
from legcal.errors import DatasetError
from legcal.files.quantity import SHOWN_IN
from legcal.files.reading import read_json
from legcal.files.table import Column, read_table

PLAN_NAME = "plan.json"  # plan in the folder of a planned session
POSES_NAME = "poses.csv"  # its poses
_ROUNDED = 0.51e-4  # [mm or deg] of the commands there
AS_PLANNED = 1.3  # largest ratio of predicted and planned error without a remark


def closeness(folder: Path, n_images: int, platform: PlatformAccuracy | None) -> tuple[str, ...]:
    """Return a sentence on the error of a planned session; () without a plan."""
    file = folder / PLAN_NAME
    try:
        plan = read_json(file)
    except FileNotFoundError:
        return ()
    except (OSError, ValueError, DatasetError):
        return (
            f"{file} cannot be read, so that the result cannot be compared with its plan; copy the "
            "file from the planned session.",
        )
    try:
        planned, expected = int(plan["images"]), plan["expected"]
        dX, dE = float(expected["dX_m"]), float(expected["dE_rad"])
        added_to = plan.get("given")
    except (ValueError, KeyError, TypeError, AttributeError):
        return ()
    if platform is None or platform.workspace is None or not dX > 0.0:
        return ()
    if added_to:
        return (
            f"The session was planned to add to {added_to}, whose images the plan counts on: put "
            "its views and rows there, and calibrate both together.",
        )
    predicted = platform.workspace
    ratio = predicted.mean_displacement / dX
    sentence = (
        "Predicted error over the workspace: "
        f"{mm_deg(predicted.mean_displacement, predicted.mean_rotation)} with {n_images} images, "
        f"{ratio:.2f} times the plan ({mm_deg(dX, dE)} with {planned} images)."
    )
    if ratio > AS_PLANNED:
        sentence += (
            " Images that are missing or show fewer legs, or edges that are noisier than planned, "
            "make the difference: see legcal detect, and plan with --noise of this result."
        )
    return (sentence,)


def commanded(dataset: Dataset) -> tuple[str, ...]:
    """Return a sentence on readings that are all the commands of a plan; () without a plan."""
    file, m, machine = dataset.folder / POSES_NAME, dataset.measurements, dataset.machine
    shown = [SHOWN_IN[machine.legs[j].reading_unit] for j in machine.motors]
    motors = zip(legs_with_readings(machine.legs), shown, strict=True)
    names = [f"{leg.prismatic} [{unit}]" for leg, (_, unit) in motors]
    columns = [Column("image", "text"), *(Column(name) for name in names)]
    if not file.exists():
        return ()
    try:
        table = read_table(file, "plan", "row", columns)
        commands = dict(zip(table.text("image"), table.numbers(names), strict=True))
    except (OSError, DatasetError):
        return ()
    rows = [row for row, image in enumerate(m.image) if image in commands]
    scale = np.array([size for size, _ in shown])
    apart = [scale * m.q[row, machine.motors] - commands[m.image[row]] for row in rows]
    if not rows or not np.all(np.abs(apart) <= _ROUNDED):
        return ()
    return (
        f"All readings equal the commands in {file}: write down what the encoders read at each "
        "pose; without encoders, state how well the motors reach a command as encoder_sigma.",
    )
