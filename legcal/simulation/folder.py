"""The folder of a simulated dataset, with the truth beside the input of a calibration.

``truth/`` holds the true model, the exact outlines and ``truth.json``: settings and seed, and the
true poses of cameras and platform. The method never reads it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import yaml

from legcal.data.measurements import Measurements
from legcal.errors import UsageError
from legcal.files.folder import (
    OutputKind,
    check_path,
    holds_files,
)
from legcal.files.motions import motion_to_xyz_quat
from legcal.files.published import with_schema
from legcal.files.table import format_table
from legcal.machine.model import Machine
from legcal.simulation.board import documents
from legcal.simulation.session import SimulatedSession
from legcal.simulation.settings import SimulationSettings
from legcal.version import __version__
from legcal.vision.camera_export import camera_info

TRUTH = "truth"
TRUTH_NAME = f"{TRUTH}/truth.json"
SIMULATED = OutputKind("dataset", TRUTH_NAME, "legcal_truth")


def write_session(
    folder: Path,
    machine: Machine,  # the nominal model
    model: str,  # path of its YAML in the dataset
    m: Measurements,
    *,
    groups: Sequence[str] = (),  # view of the file of each view, where cameras are in the hand
    board: Any = None,  # the block of a board, or of several
    lengths: Mapping[str, str] | None = None,  # measured distances of joints
) -> None:
    """Write ``dataset.yaml``, ``measurements.csv`` and the camera files."""
    cameras: dict[int, str] = {}
    views: dict[str, Any] = {}
    for v, view in enumerate(m.views):
        if id(view.camera) not in cameras:
            name = f"camera_info{f'_{view.name}' * bool(cameras)}.yaml"
            (folder / name).write_text(camera_info(view.camera, view.name), encoding="utf-8")
            cameras[id(view.camera)] = name
        entry: dict[str, Any] = {"camera": cameras[id(view.camera)]}
        if groups:
            entry["hand_held"] = True
        if view.camera.gamma_is_given:
            entry["gamma"] = view.camera.gamma
        if view.T_base_camera is not None:  # rough: five digits are enough
            rough = motion_to_xyz_quat(view.T_base_camera)
            entry["T_base_camera"] = {key: [round(x, 5) for x in rough[key]] for key in rough}
        if view.legs is not None:
            entry["legs"] = list(view.legs)
        views[groups[v] if groups else view.name] = entry
    document: dict[str, Any] = {
        "legcal_dataset": 1,
        "mechanism": model,
        "measurements": "measurements.csv",
        "encoder_sigma": dict(m.sigma_by_joint) or m.sigma_q,
        "views": views,
    }
    if board is not None:
        document["board"] = board
    if lengths:
        document["parameters"] = {"lengths": dict(lengths)}
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=100)
    (folder / "dataset.yaml").write_text(with_schema("dataset", text), encoding="utf-8")
    motors = list(machine.motors)
    joints = [str(machine.legs[j].prismatic) for j in motors]
    names, readings = list(groups) or [view.name for view in m.views], m.q[:, motors].tolist()
    rows = (
        [names[v], m.image[row], m.pose_labels[m.pose[row]], *readings[row]]
        for row, v in enumerate(m.view.tolist())
    )
    text = format_table(["view", "image", "pose", *joints], rows)
    (folder / "measurements.csv").write_text(text, encoding="utf-8")


def write_truth(
    path: Path,
    session: SimulatedSession,
    settings: SimulationSettings,
    files: Sequence[str],  # the other files of the dataset
) -> None:
    """Write ``truth.json``: settings, radii, cameras, poses and board as they really were."""
    truth, poses = session.truth, session.poses
    sliders = [(j, str(leg.prismatic)) for j, leg in enumerate(truth.legs) if leg.has_value]
    document = {
        "legcal_truth": 1,
        "legcal": __version__,
        "model": f"models/{truth.yaml_path.name}",
        "settings": _plain(asdict(replace(settings, views=settings.n_views))),
        "radii": {leg.name: leg.radius_of_part for leg in truth.legs},
        "views": {
            view.name: {"T_base_camera": motion_to_xyz_quat(view.T_base_camera)}
            for view in session.scene.views
        },
        "poses": {
            label: {
                "T_base_platform": motion_to_xyz_quat(T),
                "joints": {name: float(readings[j]) for j, name in sliders},
            }
            for label, T, readings in zip(session.labels, poses.poses, poses.readings, strict=True)
        },
        **({"board": documents(session.boards, poses=True)} if session.boards else {}),
        "files": list(files),
    }
    path.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    """Convert settings to values of JSON."""
    if isinstance(value, Mapping):
        return {str(key): _plain(x) for key, x in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(x) for x in value]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Real) and not isinstance(value, bool):
        number = int(value) if isinstance(value, Integral) else float(value)
        return number if math.isfinite(number) else str(number)
    return value


def check_dataset_destination(destination: Path) -> None:
    """Refuse an output folder that is not empty."""
    check_path(destination, SIMULATED)
    if destination.is_dir() and holds_files(destination):
        content = "a simulated dataset" if SIMULATED.is_in(destination) else "a folder with files"
        raise UsageError(
            f"{destination}: the dataset could not be written: found {content}, needed a new or "
            "empty folder; give another folder, or remove this one first."
        )


def files_in(folder: Path) -> list[str]:
    """Return the files of a folder, relative to it, in order; without hidden folders."""
    paths = [path.relative_to(folder) for path in folder.rglob("[!.]*") if path.is_file()]
    return [path.as_posix() for path in sorted(paths) if not path.parent.name.startswith(".")]
