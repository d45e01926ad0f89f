"""A dataset: the folder of section 4.1, read and validated before any work."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from legcal.dataset.board_entry import read_board
from legcal.dataset.dataset import OBSERVATIONS_NAME, Dataset, row_problems
from legcal.dataset.entry import DatasetEntry, ViewEntry
from legcal.dataset.given_axes import AXES_NAME, read_given_axes
from legcal.dataset.given_corners import CORNERS_NAME, read_given_corners
from legcal.dataset.hand_held import expand_hand_held, hand_held_problems
from legcal.dataset.measurement_table import read_measurements
from legcal.errors import DatasetError
from legcal.files.inside import path_problem
from legcal.files.schema import closest, describe, parse_yaml, read_text, validate
from legcal.mechanism.files import DATASET_YAML, shipped_folders, shipped_names
from legcal.mechanism.load import load_mechanism
from legcal.mechanism.model import Mechanism
from legcal.observations.measurements import Measurements, View
from legcal.observations.outlines import Outlines
from legcal.observations.table import read_observations
from legcal.vision.camera import Camera
from legcal.vision.camera_file import read_camera

CACHE_NAME = ".legcal-cache.json"

__all__ = ["CACHE_NAME", "OBSERVATIONS_NAME", "Dataset", "load_dataset"]


def load_dataset(folder: str | Path, *, check_images: bool = True) -> Dataset:
    """Read a dataset and check everything in it that can be checked without decoding images.

    Parameters
    ----------
    folder : str or Path
        The dataset folder, or its ``dataset.yaml``.
    check_images : bool
        Also check that every image that must be read exists, is complete and has the size of
        its camera file.

    Returns
    -------
    Dataset
        With rows, views and legs in the order of the files.

    Raises
    ------
    DatasetError
        With one sentence for each thing that is wrong.
    ModelError, OutOfClass
        If the mechanism does not load.
    """
    yaml_path = _dataset_file(Path(folder))
    folder = yaml_path.parent
    entry = _read_entry(yaml_path)
    board, T_base_board = read_board(entry.board, yaml_path)
    problems = hand_held_problems(yaml_path, entry.views, has_board=board is not None)
    if found := path_problem(folder, entry.measurements):
        problems.append(
            f"{yaml_path}: measurements could not be used: found {found} ({entry.measurements}), "
            "needed a relative path inside it; move the table there."
        )
    camera_paths = tuple(folder / view.camera for view in entry.views.values())
    cameras = _read_cameras(camera_paths, problems)
    mechanism = load_mechanism(_mechanism_path(folder, entry.mechanism))
    problems += _leg_problems(yaml_path, entry.views, mechanism.leg_names)
    if problems:
        raise DatasetError(problems)
    views = tuple(
        _view(name, view, cameras[path])
        for (name, view), path in zip(entry.views.items(), camera_paths, strict=True)
    )
    table_path = folder / entry.measurements
    rows, notes = read_measurements(table_path, folder, views, mechanism.legs, entry.encoder_sigma)
    measurements, origin, problems = expand_hand_held(yaml_path, rows, entry.views)
    if problems:
        raise DatasetError(problems)
    _refuse_two_tables(folder)
    axes, left_out = read_given_axes(folder / AXES_NAME, mechanism.leg_names, measurements)
    dataset = Dataset(
        folder=folder,
        yaml_path=yaml_path,
        table_path=table_path,
        camera_paths=tuple(camera_paths[v] for v in origin),
        mechanism=mechanism,
        measurements=measurements,
        observations=_read_outlines(folder, mechanism, measurements),
        notes=(*notes, *left_out, *_unused_views(yaml_path, rows)),
        axes=axes,
        wishes=entry.parameters.wishes(yaml_path),
        board=board,
        T_base_board=T_base_board,
        corners=read_given_corners(folder / CORNERS_NAME, board, measurements),
    )
    held = [view.hand_held for view in entry.views.values()]
    of_hand = [row for row, v in enumerate(rows.view.tolist()) if held[v]]
    problems = row_problems(dataset, of_hand) if check_images else []
    if problems:
        raise DatasetError(problems)
    return dataset


def _refuse_two_tables(folder: Path) -> None:
    """Refuse a dataset with axes and outlines."""
    if os.path.exists(folder / AXES_NAME) and os.path.exists(folder / OBSERVATIONS_NAME):
        raise DatasetError(
            f"{folder}: the observations could not be read: found {AXES_NAME} and "
            f"{OBSERVATIONS_NAME}, needed one of them; remove the one that is not to be used."
        )


def _dataset_file(given: Path) -> Path:
    """Return the path of dataset.yaml."""
    path = (
        given
        if given.suffix in (".yaml", ".yml") and not os.path.isdir(given)
        else given / DATASET_YAML
    )
    if not os.path.isdir(path.parent):
        raise DatasetError(
            f"{given}: the dataset could not be read: found no such folder, needed a folder with a "
            f"{DATASET_YAML}; check the path."
        )
    if not os.path.exists(path):
        raise DatasetError(
            f"{given}: the dataset could not be read: found no {path.name} in the folder, needed "
            "one; give the folder of a dataset."
        )
    return path


def _read_entry(path: Path) -> DatasetEntry:
    """Return what dataset.yaml says."""
    found = parse_yaml(read_text(path, "dataset file"), path, "dataset file")
    version = found.get("legcal_dataset", 1)
    if version != 1 or isinstance(version, bool):
        raise DatasetError(
            f"{path}: the dataset could not be read: found legcal_dataset {describe(version)}, "
            "needed version 1; use the legcal that wrote it, or write the file as version 1."
        )
    return validate(DatasetEntry, found, path)


def _read_cameras(paths: tuple[Path, ...], problems: list[str]) -> dict[Path, Camera]:
    """Return the camera of each file; files that cannot be used add to the problems."""
    cameras = {}
    for path in dict.fromkeys(paths):
        try:
            cameras[path] = read_camera(path)
        except DatasetError as error:
            problems += error.problems
    return cameras


def _mechanism_path(folder: Path, named: str) -> Path:
    """Return the model's path relative to the dataset if there is one, else a shipped one."""
    path = folder / named
    if not os.path.isfile(path) and named in shipped_names():
        return shipped_folders()[0] / f"{named}.yaml"
    return path


def _leg_problems(
    path: Path, views: Mapping[str, ViewEntry], leg_names: Sequence[str]
) -> list[str]:
    """Return the legs of views that the mechanism does not have."""
    return [
        f"{path}: views.{name}.legs could not be used: found the unknown leg {describe(leg)}, "
        f"needed legs of the mechanism; {closest(leg, leg_names)}"
        for name, view in views.items()
        for leg in view.legs or ()
        if leg not in leg_names
    ]


def _view(name: str, entry: ViewEntry, camera: Camera) -> View:
    """Return a view of the measurements."""
    return View(
        name=name,
        camera=replace(camera, gamma=entry.gamma or 1.0, gamma_is_told=entry.gamma is not None),
        T_base_camera=entry.T_base_camera.motion() if entry.T_base_camera else None,
        legs=tuple(entry.legs) if entry.legs else None,
    )


def _read_outlines(
    folder: Path, mechanism: Mechanism, measurements: Measurements
) -> Outlines | None:
    """Return the outlines beside the dataset, if there are any."""
    path = folder / OBSERVATIONS_NAME
    if not os.path.exists(path):
        return None
    is_own = (folder / CACHE_NAME).exists()
    return read_observations(path, mechanism.legs, measurements, skip_stale=is_own)


def _unused_views(path: Path, measurements: Measurements) -> list[str]:
    """Return a note for each view without a row."""
    return [
        f"{path}: view {view.name} has no row in the table of measurements and is left out."
        for v, view in enumerate(measurements.views)
        if not np.any(measurements.view == v)
    ]
