"""A dataset: the folder of section 4.1, read and validated before any work."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.dataset.entry import DatasetEntry, ViewEntry
from legcal.dataset.given_axes import AXES_NAME, read_given_axes, rows_without_axes
from legcal.dataset.measurement_table import read_measurements
from legcal.dataset.wishes import Wish
from legcal.errors import DatasetError
from legcal.files.inside import path_problem
from legcal.files.schema import closest, describe, parse_yaml, read_text, validate
from legcal.geometry.types import Image
from legcal.mechanism.files import DATASET_YAML, shipped_folders, shipped_names
from legcal.mechanism.load import load_mechanism
from legcal.mechanism.model import Mechanism
from legcal.observations.corners import Corners
from legcal.observations.leg_axes import LegAxes
from legcal.observations.measurements import Measurements, View
from legcal.observations.outlines import Outlines
from legcal.observations.table import read_observations
from legcal.vision.board import Board
from legcal.vision.camera import Camera
from legcal.vision.camera_file import read_camera
from legcal.vision.image_file import image_problem, read_image

OBSERVATIONS_NAME = "observations.csv"
CACHE_NAME = ".legcal-cache.json"


@dataclass(frozen=True, eq=False)
class Dataset:
    """Everything that a calibration starts from.

    Attributes
    ----------
    folder : Path
        The dataset folder.
    yaml_path, table_path : Path
        ``dataset.yaml`` and the table of measurements.
    camera_paths : tuple of Path
        The camera file of each view.
    mechanism : Mechanism
        The nominal model.
    measurements : Measurements
        The rows of the table, in its order.
    observations : Outlines or None
        The rows of ``observations.csv`` if there is one: given, cached or edited.
    notes : tuple of str
        What is odd but allowed.
    axes : LegAxes or None
        The rows of ``axes.csv`` if there is one, of the legs that the views use. Images are
        then not searched, and there are no observations.
    wishes : tuple of Wish
        What the block ``parameters`` asks of parameters by name.
    board : Board or None
        The calibration board that is fixed to the base.
    T_base_board : RigidTransform or None
        Its pose in the base link, where it is known.
    corners : Corners or None
        The rows of ``corners.csv`` if there is one. Images are then not searched for the board.
    """

    folder: Path
    yaml_path: Path
    table_path: Path
    camera_paths: tuple[Path, ...]
    mechanism: Mechanism
    measurements: Measurements
    observations: Outlines | None
    notes: tuple[str, ...] = ()
    axes: LegAxes | None = None
    wishes: tuple[Wish, ...] = ()
    board: Board | None = None
    T_base_board: RigidTransform | None = None
    corners: Corners | None = None

    def image_path(self, row: int) -> Path | None:
        """Return the image file of a row; None where only outlines are given."""
        image = self.measurements.image[row]
        return self.folder / image if image else None

    def read_image(self, row: int) -> Image:
        """Return the image of a row as (height, width) grey levels 0 to 255, float32.

        Raises
        ------
        DatasetError
            If the row has no image, or its file cannot be used.
        """
        return self.image_reader([row])(0)

    def image_reader(self, rows: Sequence[int]) -> "ImageReader":
        """Return what reads the images of these rows, in this order, in any process."""
        return ImageReader(
            tuple(self.image_path(row) for row in rows),
            tuple(self._camera(row) for row in rows),
            tuple(self._where(row) for row in rows),
        )

    def image_problem(self, row: int) -> str | None:
        """Return what keeps the image of a row from being used, or None; nothing is decoded."""
        path = self.image_path(row)
        return image_problem(path, self._camera(row), self._where(row)) if path else None

    def _camera(self, row: int) -> Camera:
        """Return the camera that took the image of a row."""
        return self.measurements.views[int(self.measurements.view[row])].camera

    def _where(self, row: int) -> str:
        """Return the place of a row for a message."""
        return f"{self.table_path}, row {row + 1}"


@dataclass(frozen=True, eq=False)
class ImageReader:
    """Reads images by their number.

    Attributes
    ----------
    paths : tuple of Path or None
        The files; None where a row has no image.
    cameras : tuple of Camera
        The camera of each image.
    places : tuple of str
        Where each image is named, for messages.
    """

    paths: tuple[Path | None, ...]
    cameras: tuple[Camera, ...]
    places: tuple[str, ...]

    def __call__(self, k: int) -> Image:
        """Return image k as (height, width) grey levels 0 to 255, float32."""
        path = self.paths[k]
        if path is None:
            raise DatasetError(
                f"{self.places[k]}: its image could not be read: found an empty cell, needed an "
                f"image; name one or give its outlines in {OBSERVATIONS_NAME}."
            )
        return read_image(path, self.cameras[k], self.places[k])


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
    problems: list[str] = []
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
    measurements, notes = read_measurements(
        table_path, folder, views, mechanism.legs, entry.encoder_sigma
    )
    if os.path.exists(folder / AXES_NAME) and os.path.exists(folder / OBSERVATIONS_NAME):
        raise DatasetError(
            f"{folder}: the observations could not be read: found {AXES_NAME} and "
            f"{OBSERVATIONS_NAME}, needed one of them; remove the one that is not to be used."
        )
    axes, left_out = read_given_axes(folder / AXES_NAME, mechanism.leg_names, measurements)
    dataset = Dataset(
        folder=folder,
        yaml_path=yaml_path,
        table_path=table_path,
        camera_paths=camera_paths,
        mechanism=mechanism,
        measurements=measurements,
        observations=_read_outlines(folder, mechanism, measurements),
        notes=(*notes, *left_out, *_unused_views(yaml_path, measurements)),
        axes=axes,
        wishes=entry.parameters.wishes(yaml_path),
    )
    problems = _row_problems(dataset) if check_images else []
    if problems:
        raise DatasetError(problems)
    return dataset


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
        camera=camera,
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


def _row_problems(dataset: Dataset) -> list[str]:
    """Return the rows that neither an image nor outlines nor axes make usable."""
    if dataset.axes is not None:
        return rows_without_axes(dataset.table_path, dataset.measurements, dataset.axes)
    outlines = dataset.observations
    given = set() if outlines is None else set(outlines.row.tolist())
    problems = []
    for row in range(dataset.measurements.n_rows):
        path = dataset.image_path(row)
        if path is None and row not in given:
            problems.append(
                f"{dataset.table_path}, row {row + 1}, column image: the row could not be used: "
                f"found neither an image nor outlines of it in {OBSERVATIONS_NAME}, needed one of "
                "them; name an image or remove the row."
            )
        elif path is not None and (os.path.exists(path) or row not in given):
            found = dataset.image_problem(row)
            problems += [found] if found else []
    return problems
