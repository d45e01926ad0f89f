"""Which images repeat each other: rows of one view that share a pose."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from legcal.errors import DatasetError, NotIdentifiable
from legcal.geometry.types import BoolArray, IntArray
from legcal.observations.measurements import Measurements


@dataclass(frozen=True, eq=False)
class Repeats:
    """Images of one pose from one camera position.

    Attributes
    ----------
    view, pose : int
        Indices of the view and the pose.
    rows : (n,) array of int
        The rows of the measurements.
    """

    view: int
    pose: int
    rows: IntArray


def find_repeats(measurements: Measurements, has_image: BoolArray, where: Path) -> list[Repeats]:
    """Return the repeated images of a dataset, by view and pose.

    Parameters
    ----------
    measurements : Measurements
        All rows.
    has_image : (n_rows,) array of bool
        Whether the image file of a row is there.
    where : Path
        The table, for messages.

    Raises
    ------
    DatasetError
        If no row has an image.
    NotIdentifiable
        If no view has two images of one pose.
    """
    rows = np.flatnonzero(has_image)
    what = f"{where}: the measurement noise could not be estimated: found no"
    if len(rows) == 0:
        raise DatasetError(
            f"{what} image in {measurements.n_rows} rows, needed repeated images of the same "
            "poses; name the images in the column image."
        )
    repeats = [group for group in group_rows(measurements, rows) if len(group.rows) > 1]
    if not repeats:
        found = "two images of one pose in any view" if measurements.pose_labels else "column pose"
        raise NotIdentifiable(
            f"{what} {found}, needed several images of each pose from one camera position; take "
            "every image several times and give its rows the same label in the column pose "
            "(legcal simulate --images 4 does, for a simulated machine)."
        )
    return repeats


def group_rows(measurements: Measurements, rows: IntArray) -> list[Repeats]:
    """Return rows by view and pose, also those that nothing repeats."""
    places = np.stack([measurements.view[rows], measurements.pose[rows]], axis=1)
    distinct, which = np.unique(places, axis=0, return_inverse=True)
    return [
        Repeats(int(view), int(pose), rows[which.ravel() == k])
        for k, (view, pose) in enumerate(distinct)
    ]
