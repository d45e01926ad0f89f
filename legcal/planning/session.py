"""The folder of a planned session: a dataset without its photographs.

``dataset.yaml``, ``measurements.csv``, the model and the camera file are those of the dataset;
``poses.csv`` has the settings in millimetres and degrees, ``plan.json`` the expected errors.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from legcal.data.dataset import PLAN_NAME, POSES_NAME
from legcal.data.measurements import reading_columns
from legcal.data.reading_units import sigmas_of_legs
from legcal.errors import UsageError
from legcal.files.folder import (
    OutputKind,
    check_destination,
    holds_files,
    output_path,
    result_folder,
)
from legcal.files.motions import motion_to_xyz_quat
from legcal.files.published import with_schema
from legcal.files.quantity import SHOWN_IN
from legcal.files.table import format_table
from legcal.geometry.rotations import roll_pitch_yaw
from legcal.machine.files import DATASET_YAML
from legcal.machine.model_writer import write_model
from legcal.planning.order import HOME
from legcal.planning.planned_session import Plan
from legcal.vision.board_file import board_document
from legcal.vision.camera_export import camera_info

CAMERA, MEASUREMENTS = "camera_info.yaml", "measurements.csv"
HAND = "hand"  # the view of a hand-held camera
PLANNED = OutputKind("session", PLAN_NAME, "legcal_plan")


def check_session(output: str | Path) -> Path:
    """Return the folder of a session; refuse to replace other files."""
    destination = output_path(output, PLANNED)
    check_destination(destination, PLANNED)
    if destination.is_dir() and holds_files(destination):
        raise UsageError(
            f"{destination}: the session could not be written: found an earlier session, needed a "
            "new or empty folder; give another folder, or remove that one."
        )
    return destination


def write_session(
    plan: Plan,
    output: str | Path,
    *,
    pictures: Mapping[str, str | bytes] | None = None,
) -> list[Path]:
    """Write the folder of a session atomically, and return its files.

    *pictures* are further files by their names: drawings and pages.
    """
    destination = check_session(output)
    with result_folder(destination, PLANNED) as folder:
        yaml_path, _ = write_model(plan.machine, folder)
        texts = {
            CAMERA: camera_info(plan.camera, "camera"),
            DATASET_YAML: _dataset(plan, yaml_path.relative_to(folder).as_posix()),
            MEASUREMENTS: _measurements(plan),
            POSES_NAME: _poses(plan),
            PLAN_NAME: json.dumps(plan.document(), indent=1, allow_nan=False) + "\n",
            **(pictures or {}),
        }
        for name, content in texts.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            data = content if isinstance(content, bytes) else content.encode()
            (folder / name).write_bytes(data)
    return [destination / name for name in texts]


def images_of(plan: Plan) -> list[tuple[str, str, str, int, int]]:
    """Return view, image file, label of the pose, and indices of view and pose of every image.

    All images of a hand-held camera are of one view.
    """
    labels = plan.labels
    images: list[tuple[str, str, str, int, int]] = []
    for v, view in enumerate(plan.views):
        name = HAND if plan.hand_held else view.name
        for k in range(len(view.poses.poses)):
            label = labels[len(images)]
            images.append((name, f"images/{name}_{label}.jpg", label, v, k))
    return images


def _dataset(plan: Plan, model: str) -> str:
    """Return ``dataset.yaml``."""
    views: dict[str, Any] = {}
    for view in plan.views:
        entry: dict[str, Any] = {"camera": CAMERA}
        if plan.hand_held:
            views[HAND] = entry | {"hand_held": True}
            continue
        motion = motion_to_xyz_quat(view.T_base_camera)
        entry["T_base_camera"] = {key: [round(x, 5) for x in motion[key]] for key in motion}
        shown = np.asarray(view.shows.any(axis=0))
        if not shown.all():
            names = plan.machine.leg_names
            entry["legs"] = [names[j] for j in np.flatnonzero(shown).tolist()]
        views[view.name] = entry
    document: dict[str, Any] = {
        "legcal_dataset": 1,
        "mechanism": model,
        "measurements": MEASUREMENTS,
        "encoder_sigma": _encoder_sigma(plan),
        "views": views,
    }
    if plan.board is not None:
        document["board"] = board_document(plan.board.board)
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=100)
    return with_schema("dataset", text)


def _encoder_sigma(plan: Plan) -> float | dict[str, float]:
    """Return the standard deviation of readings [m], by motor [m or rad] where they differ."""
    legs = [plan.machine.legs[j] for j in plan.machine.motors]
    sigma = sigmas_of_legs(legs, plan.sigma_q, plan.sigma_by_joint).tolist()
    sigma_of_motor = {str(leg.prismatic): value for leg, value in zip(legs, sigma, strict=True)}
    if any(leg.reads_angle for leg in legs) or set(sigma_of_motor.values()) - {plan.sigma_q}:
        return sigma_of_motor
    return plan.sigma_q


def _measurements(plan: Plan) -> str:
    """Return ``measurements.csv`` with the planned readings, to be replaced by measured ones."""
    motors = list(plan.machine.motors)
    rows = [
        [name, image, label, *plan.views[v].poses.readings[k, motors].tolist()]
        for name, image, label, v, k in images_of(plan)
    ]
    joints = [column.name for column in reading_columns(plan.machine.legs)]
    return format_table(["view", "image", "pose", *joints], rows)


def _poses(plan: Plan) -> str:
    """Return ``poses.csv``."""
    motors, rows, labels = list(plan.machine.motors), [], plan.labels
    shown = [SHOWN_IN[plan.machine.legs[j].reading_unit] for j in motors]
    scale = np.array([size for size, _ in shown])
    for name, image, label, v, k in images_of(plan):
        view = plan.views[v]
        T, via = view.poses.poses[k], view.via[k]
        if via and via != HOME:
            via = labels[int(via) - 1]
        angles = np.degrees(roll_pitch_yaw(T.rotation.as_matrix()))
        numbers = [*(scale * view.poses.readings[k, motors]), *(1e3 * T.translation), *angles]
        where = 1e3 * view.T_base_camera.translation
        rows.append([name, label, image, via, *(f"{x:z.4f}" for x in numbers),
                     *(f"{x:z.0f}" for x in where)])  # fmt: skip
    joints = [
        f"{column.name} [{unit}]"
        for column, (_, unit) in zip(reading_columns(plan.machine.legs), shown, strict=True)
    ]
    pose = [*(f"{x} [mm]" for x in "xyz"), *(f"{x} [deg]" for x in ("roll", "pitch", "yaw"))]
    camera = [f"camera {x} [mm]" for x in "xyz"]
    header = ["view", "pose", "image", "on the way", *joints, *pose, *camera]
    return format_table(header, rows)
