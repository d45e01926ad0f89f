"""The folder of a simulated dataset, with the truth beside what a calibration may see.

``truth/`` holds the true model, the exact outlines and ``truth.json``: settings and seed, where the
cameras and the platform really were. Nothing of the method reads it.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import yaml

from legcal.calibration.closeness import PLAN_NAME
from legcal.data.dataset import AXES_NAME, CACHE_NAME, CORNERS_NAME, OBSERVATIONS_NAME
from legcal.data.measurements import Measurements
from legcal.data.outlines import OUTLINE_COLUMNS
from legcal.errors import DatasetError, UsageError
from legcal.files.folder import (
    OutputKind,
    check_destination,
    check_path,
    holds_files,
    in_the_way,
    path_problem,
    result_folder,
)
from legcal.files.motions import motion_to_xyz_quat
from legcal.files.published import with_schema
from legcal.files.reading import read_json
from legcal.files.table import format_table, read_table
from legcal.machine.model import Machine
from legcal.simulation.board import documents
from legcal.simulation.session import SimulatedSession
from legcal.simulation.settings import SimulationSettings
from legcal.version import __version__
from legcal.vision.camera_file import camera_info

TRUTH = "truth"
TRUTH_NAME = f"{TRUTH}/truth.json"
_FOLDERS = ("images", "models", "urdf", TRUTH)
_TABLES = ("measurements.csv", OBSERVATIONS_NAME, AXES_NAME, CORNERS_NAME)
_FILES = ("dataset.yaml", *_TABLES, "camera_info*.yaml", PLAN_NAME)
SIMULATED = OutputKind("dataset", TRUTH_NAME, "legcal_truth")


def write_session(
    folder: Path,
    machine: Machine,  # the nominal model
    model: str,  # path of its YAML in the dataset
    m: Measurements,
    *,
    groups: Sequence[str] = (),  # view of the file of each view, where cameras are in the hand
    board: Any = None,  # the block of one, or of several
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


def check_dataset_destination(destination: Path, *, force: bool) -> None:
    """Refuse an output folder that holds anything; with *force* only if that was not simulated."""
    check_path(destination, SIMULATED)
    if destination.is_dir() and holds_files(destination) and not force:
        there = "a simulated dataset" if SIMULATED.is_in(destination) else "a folder with files"
        remedy = "give another folder"
        if SIMULATED.is_in(destination):
            remedy += ", or replace it with --force (in Python: force=True)"
        raise UsageError(
            f"{destination}: the dataset could not be written: found {there}, needed a new or "
            f"empty folder; {remedy}."
        )
    check_destination(destination, SIMULATED)
    foreign = _foreign(destination)
    if foreign:
        raise UsageError(in_the_way(destination, SIMULATED, foreign))


@contextmanager
def dataset_folder(destination: Path, *, force: bool) -> Iterator[Path]:
    """Give a temporary folder that becomes the dataset when the block ends well.

    With *force* the files of an earlier simulated dataset go, and so do the outlines that a
    calibration left there; other files beside them are kept. Nothing else is replaced.
    """
    check_dataset_destination(destination, force=force)
    earlier = _earlier(destination)
    with result_folder(destination, SIMULATED, earlier, replaceable=earlier) as folder:
        yield folder


def files_in(folder: Path) -> list[str]:
    """Return the files of a folder, relative to it, in order; none of hidden folders."""
    found = [path.relative_to(folder) for path in folder.rglob("[!.]*") if path.is_file()]
    return [path.as_posix() for path in sorted(found) if not path.parent.name.startswith(".")]


def _earlier(destination: Path) -> list[Path]:
    """Return the files of the simulated dataset in a folder, and what calibration left there."""
    if not SIMULATED.is_in(destination):
        return []
    named = read_json(destination / TRUTH_NAME).get("files", [])
    names = [name for name in named if isinstance(name, str)] if isinstance(named, list) else []
    if _is_detected(destination):
        names += [OBSERVATIONS_NAME, CACHE_NAME]
    own = [Path(name) for name in dict.fromkeys(names) if path_problem(destination, name) is None]
    return [name for name in own if _is_place(name) or name == Path(CACHE_NAME)]


def _is_detected(folder: Path) -> bool:
    """Say whether a calibration left the table of outlines, and nobody gave or corrected a row."""
    try:
        if read_json(folder / CACHE_NAME).get("given"):
            return False
        if not os.path.exists(folder / OBSERVATIONS_NAME):
            return True
        table = read_table(folder / OBSERVATIONS_NAME, "table", "outline", OUTLINE_COLUMNS)
        return "edited" not in table.text("source")
    except (OSError, ValueError, AttributeError, RecursionError, DatasetError):
        return False


def _is_place(name: Path) -> bool:
    """Say whether a path in a dataset is one where simulation writes."""
    if ".." in name.parts:
        return False
    is_file = len(name.parts) == 1 and any(name.match(file) for file in _FILES)
    return is_file or name.parts[:1] in {(folder,) for folder in _FOLDERS}


def _foreign(destination: Path) -> str:
    """Return what stands in the places of a dataset and is none of its files, "" for nothing."""
    if not destination.is_dir():
        return ""
    own = set(_earlier(destination))
    folders = {parent for name in own for parent in name.parents}
    for above, inside, files in os.walk(destination):
        here = Path(above).relative_to(destination)
        for name in sorted([here / name for name in inside + files]):
            path = destination / name
            if not _is_place(name) or any(part.startswith(".") for part in name.parts):
                continue
            if path.is_symlink():
                return f"{name}, which is a link"
            if path.is_dir() and name not in folders and not _is_plain(name):
                return f"{name}, which is a folder"
            if not path.is_dir() and name not in own:
                return f"{name}, which an earlier simulation did not write"
        if here == Path():
            inside[:] = [name for name in inside if name in _FOLDERS]
    return ""


def _is_plain(name: Path) -> bool:
    """Say whether every dataset may have a folder of that name."""
    return name.as_posix() in (*_FOLDERS, f"{TRUTH}/models", f"{TRUTH}/urdf")
