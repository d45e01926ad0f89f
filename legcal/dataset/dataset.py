"""What a dataset holds, and which of its rows can be used."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from scipy.spatial.transform import RigidTransform

from legcal.dataset.given_axes import rows_without_axes
from legcal.dataset.given_corners import CORNERS_NAME, rows_without_board
from legcal.dataset.wishes import Wish
from legcal.errors import DatasetError
from legcal.geometry.types import Image
from legcal.mechanism.model import Mechanism
from legcal.observations.corners import Corners
from legcal.observations.leg_axes import LegAxes
from legcal.observations.measurements import Measurements
from legcal.observations.outlines import Outlines
from legcal.vision.board import Board
from legcal.vision.camera import Camera
from legcal.vision.image_file import image_problem, read_image

OBSERVATIONS_NAME = "observations.csv"


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


def row_problems(dataset: Dataset, hand_held: Sequence[int]) -> list[str]:
    """Return one sentence for each row that neither an image nor tables make usable.

    Parameters
    ----------
    dataset : Dataset
        The dataset.
    hand_held : sequence of int
        The rows of hand-held views, which need the board.
    """
    table_path, measurements = dataset.table_path, dataset.measurements
    if dataset.corners is None:
        problems = [
            f"{table_path}, row {row + 1}, column image: its camera could not be placed: found "
            f"neither an image nor {CORNERS_NAME}, needed the board in every image of a camera "
            "that is held in the hand; name an image or give the corners."
            for row in hand_held
            if not measurements.image[row]
        ]
    else:
        problems = rows_without_board(table_path, measurements, dataset.corners, hand_held)
    if dataset.axes is not None:
        return [*problems, *rows_without_axes(table_path, measurements, dataset.axes)]
    outlines = dataset.observations
    given = set() if outlines is None else set(outlines.row.tolist())
    for row in range(measurements.n_rows):
        path = dataset.image_path(row)
        if path is None and row not in given:
            problems.append(
                f"{table_path}, row {row + 1}, column image: the row could not be used: "
                f"found neither an image nor outlines of it in {OBSERVATIONS_NAME}, needed one of "
                "them; name an image or remove the row."
            )
        elif path is not None and (os.path.exists(path) or row not in given):
            found = dataset.image_problem(row)
            problems += [found] if found else []
    return problems
