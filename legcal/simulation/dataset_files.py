"""The files of a simulated dataset: what a calibration reads, and the truth."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import RigidTransform

from legcal.geometry.frames import motion_to_xyz_quat
from legcal.geometry.types import Array
from legcal.mechanism.configurations import Configurations
from legcal.mechanism.leg import LegKind, main_cylinders
from legcal.mechanism.model import Mechanism
from legcal.observations.measurements import Measurements, View
from legcal.simulation.images import Images, Viewpoint
from legcal.simulation.settings import SimulationSettings
from legcal.version import __version__
from legcal.vision.camera_writer import camera_info

LEAST_SIGMA_Q = 1e-9  # [m] that readings without noise claim


def pose_labels(n_poses: int) -> tuple[str, ...]:
    """Return the names of poses: p01, p02, ..."""
    width = max(2, len(str(n_poses)))
    return tuple(f"p{i + 1:0{width}d}" for i in range(n_poses))


def image_names(images: Images, views: Sequence[Viewpoint], labels: Sequence[str]) -> list[str]:
    """Return the name of every photograph, relative to the dataset."""
    repeats = int(images.repeat.max()) + 1
    return [
        f"images/{views[v].name}_{labels[p]}{f'_{k + 1}' * (repeats > 1)}.png"
        for v, p, k in zip(images.view, images.pose, images.repeat, strict=True)
    ]


def measurements_of(
    images: Images,
    views: Sequence[View],
    labels: Sequence[str],
    names: Sequence[str],
    q: Array,
    sigma_q: float,
) -> Measurements:
    """Return the rows of the dataset.

    Parameters
    ----------
    images : Images
        The images.
    views : sequence of View
        The cameras, with what is told about them.
    labels : sequence of str
        The names of all poses.
    names : sequence of str
        The image of each row, "" where there is none.
    q : (n_poses, n_legs) array
        Readings of all poses [m].
    sigma_q : float
        Their standard deviation [m].
    """
    kept, pose = np.unique(images.pose, return_inverse=True)
    return Measurements(
        views=tuple(views),
        image=tuple(names),
        view=images.view,
        pose=pose.astype(np.intp),
        q=q[images.pose],
        sigma_q=max(sigma_q, LEAST_SIGMA_Q),
        pose_labels=tuple(labels[p] for p in kept),
    )


def write_session(
    folder: Path,
    mechanism: Mechanism,
    model: str,
    m: Measurements,
    *,
    groups: Sequence[str] = (),
    board: Mapping[str, Any] | None = None,
) -> None:
    """Write ``dataset.yaml``, ``measurements.csv`` and the camera files.

    Parameters
    ----------
    folder : Path
        The dataset.
    mechanism : Mechanism
        The nominal model.
    model : str
        The path of its YAML in the dataset.
    m : Measurements
        The rows.
    groups : sequence of str
        The view of the file that each view belongs to where cameras are in the hand.
    board : mapping, optional
        The block of the calibration board.
    """
    cameras = _write_cameras(folder, m.views)
    views: dict[str, Any] = {}
    for v, (view, camera) in enumerate(zip(m.views, cameras, strict=True)):
        entry: dict[str, Any] = {"camera": camera}
        if groups:
            entry["hand_held"] = True
        if view.camera.gamma_is_told:
            entry["gamma"] = view.camera.gamma
        if view.T_base_camera is not None:
            entry["T_base_camera"] = _rounded(view.T_base_camera)
        if view.legs is not None:
            entry["legs"] = list(view.legs)
        views[groups[v] if groups else view.name] = entry
    document: dict[str, Any] = {
        "legcal_dataset": 1,
        "mechanism": model,
        "measurements": "measurements.csv",
        "encoder_sigma": m.sigma_q,
        "views": views,
    }
    if board is not None:
        document["board"] = dict(board)
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=100)
    (folder / "dataset.yaml").write_text(text, encoding="utf-8")
    (folder / "measurements.csv").write_text(
        _measurements_text(mechanism, m, groups), encoding="utf-8"
    )


def write_truth(
    path: Path,
    settings: SimulationSettings,
    mechanism: Mechanism,
    views: Sequence[Viewpoint],
    poses: Configurations,
    labels: Sequence[str],
    files: Sequence[str],
    board: Mapping[str, Any] | None = None,
) -> None:
    """Write ``truth.json``: settings, radii, cameras, poses and board as they really were.

    Parameters
    ----------
    path : Path
        The file.
    settings : SimulationSettings
        The settings, with the seed.
    mechanism : Mechanism
        The true model.
    views, poses, labels : sequence
        Cameras and poses.
    files : sequence of str
        The other files of the dataset.
    board : mapping, optional
        The block of the calibration board, with its true pose.
    """
    sliders = [
        (j, str(leg.prismatic))
        for j, leg in enumerate(mechanism.legs)
        if leg.kind is not LegKind.CONSTANT
    ]
    document = {
        "legcal_truth": 1,
        "legcal": __version__,
        "model": f"models/{mechanism.yaml_path.name}",
        "settings": _plain(asdict(settings)),
        "radii": {
            leg.name: {part: c.radius for part, c in main_cylinders(leg.cylinders).items()}
            for leg in mechanism.legs
        },
        "views": {
            view.name: {"T_base_camera": motion_to_xyz_quat(view.T_base_camera)} for view in views
        },
        "poses": {
            label: {
                "T_base_platform": motion_to_xyz_quat(T),
                "joints": {name: float(readings[j]) for j, name in sliders},
            }
            for label, T, readings in zip(labels, poses.poses, poses.readings, strict=True)
        },
        **({} if board is None else {"board": dict(board)}),
        "files": list(files),
    }
    path.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _write_cameras(folder: Path, views: Sequence[View]) -> list[str]:
    """Write the file of every camera; return the name of each view's."""
    written: dict[int, str] = {}
    names = []
    for view in views:
        if id(view.camera) not in written:
            name = f"camera_info{f'_{view.name}' * bool(written)}.yaml"
            (folder / name).write_text(camera_info(view.camera, view.name), encoding="utf-8")
            written[id(view.camera)] = name
        names.append(written[id(view.camera)])
    return names


def _measurements_text(mechanism: Mechanism, m: Measurements, groups: Sequence[str]) -> str:
    """Return the text of ``measurements.csv``."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    motors = list(mechanism.motors)
    joints = [str(mechanism.legs[j].prismatic) for j in motors]
    writer.writerow(["view", "image", "pose", *joints])
    for row in range(m.n_rows):
        v, label = m.view[row], m.pose_labels[m.pose[row]]
        view = groups[v] if groups else m.views[v].name
        writer.writerow([view, m.image[row], label, *map(repr, m.q[row, motors].tolist())])
    return text.getvalue()


def _rounded(T: RigidTransform) -> dict[str, list[float]]:
    """Return a rough pose with as many digits as it deserves."""
    return {key: [round(x, 5) for x in numbers] for key, numbers in motion_to_xyz_quat(T).items()}


def _plain(value: Any) -> Any:
    """Return settings as JSON can hold them."""
    if isinstance(value, Mapping):
        return {str(key): _plain(x) for key, x in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(x) for x in value]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value
