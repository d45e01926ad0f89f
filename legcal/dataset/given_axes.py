"""Axes that a dataset gives in place of images: those that are used, and rows that lack them."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from legcal.errors import DatasetError
from legcal.observations.axes_file import read_axes
from legcal.observations.leg_axes import LegAxes, choose_axes
from legcal.observations.measurements import Measurements

AXES_NAME = "axes.csv"


def read_given_axes(
    path: Path, leg_names: Sequence[str], measurements: Measurements
) -> tuple[LegAxes | None, list[str]]:
    """Return the axes of the legs that the views use, and a note about others.

    Parameters
    ----------
    path : Path
        The table; None is returned if there is none.
    leg_names : sequence of str
        The legs of the mechanism.
    measurements : Measurements
        The rows that axes belong to.

    Raises
    ------
    DatasetError
        With one sentence for each thing that is wrong.
    """
    if not os.path.exists(path):
        return None, []
    axes = read_axes(path, leg_names, measurements)
    views = [measurements.views[v] for v in measurements.view[axes.row].tolist()]
    names = [leg_names[leg] for leg in axes.leg.tolist()]
    wanted = [
        view.legs is None or name in view.legs for view, name in zip(views, names, strict=True)
    ]
    used = np.flatnonzero(wanted)
    if len(used) == 0:
        raise DatasetError(
            f"{path}: the axes could not be used: found only legs that their views leave out, "
            "needed legs that dataset.yaml names for the views; correct these or the table."
        )
    left_out = len(axes) - len(used)
    note = f"{path}: {left_out} axes of legs that their views leave out are not used."
    return choose_axes(axes, used), [note] if left_out else []


def rows_without_axes(table_path: Path, measurements: Measurements, axes: LegAxes) -> list[str]:
    """Return one sentence for each row of the measurements that has no axis."""
    blank = np.setdiff1d(np.arange(measurements.n_rows), axes.row).tolist()
    return [
        f"{table_path}, row {row + 1}: the row could not be used: found no axis of it in "
        f"{AXES_NAME}, needed one of a leg that its view uses; add one or remove the row."
        for row in blank
    ]
