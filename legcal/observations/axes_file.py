"""The table ``axes.csv``: axes of legs as the paper states them, instead of images and outlines.

One row an axis: view, image and leg, named as in ``observations.csv``; the Euler angles
psi and theta (:mod:`legcal.vision.euler`) and the point M_LS = (x, 0, z) in the camera frame; their
standard deviations, which are taken for true. Angles in radians, lengths in metres.
"""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from legcal.errors import DatasetError
from legcal.files.atomic import write_atomically
from legcal.files.csv_file import read_named_rows
from legcal.files.schema import describe
from legcal.geometry.types import Array, IntArray
from legcal.observations.leg_axes import LegAxes
from legcal.observations.measurements import Measurements
from legcal.observations.row import number_in, place_in_measurements
from legcal.observations.table import row_names, rows_by_name
from legcal.observations.table_axes import axes_of_table, table_of_axes

VALUES = ("psi", "theta", "x", "z")
SIGMAS = tuple(f"sigma_{name}" for name in VALUES)
COLUMNS = ("view", "image", "leg", *VALUES, *SIGMAS)

LARGEST_ANGLE = {"psi": 0.5 * math.pi, "theta": math.pi}  # [rad]
ANGLE_ROUNDING = 1e-3  # [rad]; as of 3.142
LARGEST_DISTANCE = 1000.0  # [m] of M_LS from the camera centre
SIGMA_RANGE = (1e-9, 1.0)  # [rad] or [m]: no axis is known better, and worse says nothing
LEAST_UPRIGHT = 1e-4  # component along the image y axis: M_LS is known, with less it runs away


def write_axes(
    path: Path, axes: LegAxes, measurements: Measurements, leg_names: Sequence[str]
) -> None:
    """Write axes, the file complete or not at all.

    Parameters
    ----------
    path : Path
        ``axes.csv``.
    axes : LegAxes
        What to write. Correlations between angles and point are left out.
    measurements : Measurements
        The rows they belong to, in the order of the file.
    leg_names : sequence of str
        The legs of the mechanism.

    Raises
    ------
    NotVisible
        If an axis has no point M_LS.
    OSError
        If the file cannot be written.
    """
    write_axis_table(path, axes.row, axes.leg, *table_of_axes(axes), measurements, leg_names)


def write_axis_table(
    path: Path,
    row: IntArray,
    leg: IntArray,
    values: Array,
    sigmas: Array,
    measurements: Measurements,
    leg_names: Sequence[str],
) -> None:
    """Write axes that are given as the table has them, the file complete or not at all.

    Parameters
    ----------
    path : Path
        ``axes.csv``.
    row, leg : (n,) array of int
        Indices of the image and of the leg.
    values, sigmas : (n, 4) array
        psi, theta, x, z and their standard deviations [rad, rad, m, m].
    measurements, leg_names
        As in :func:`write_axes`.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    names = row_names(measurements)
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    numbers = np.hstack([values, sigmas]).tolist()
    for r, j, cells in zip(row.tolist(), leg.tolist(), numbers, strict=True):
        view = measurements.views[measurements.view[r]].name
        writer.writerow([view, names[r], leg_names[j], *(repr(x) for x in cells)])
    write_atomically(path, text.getvalue().encode())


def read_axes(path: Path, leg_names: Sequence[str], measurements: Measurements) -> LegAxes:
    """Read ``axes.csv``.

    Parameters
    ----------
    path : Path
        The table.
    leg_names : sequence of str
        The legs of the mechanism.
    measurements : Measurements
        The rows that axes belong to, in the order of the file.

    Returns
    -------
    LegAxes
        In the order of the file.

    Raises
    ------
    DatasetError
        With one sentence for each thing that is wrong, naming row and column.
    """
    problems: list[str] = []
    needed = (
        "the axes of the legs in every image; add them, or delete the file to have images searched"
    )
    rows = read_named_rows(
        path, "table of axes", COLUMNS, "correct the header", problems, needed=needed
    )
    places = rows_by_name(measurements)
    first: dict[tuple[int, int], str] = {}
    numbers = []
    for where, cells in rows:
        place, unknown = place_in_measurements(where, cells, places, leg_names, "axis")
        found, wrong = _numbers(where, cells)
        problems += [*unknown, *wrong]
        numbers.append(found)
        earlier = where if unknown else first.setdefault(place, where)
        if earlier != where:
            problems.append(
                f"{where}: the axis could not be used: found the same image and leg in "
                f"{earlier.rsplit(', ', 1)[-1]}, needed it once; remove one of them."
            )
    if problems:
        raise DatasetError(problems)
    row, leg = np.array(list(first), dtype=np.intp).T
    table = np.array(numbers)
    return axes_of_table(row, leg, table[:, :4], table[:, 4:])


def _numbers(where: str, cells: Mapping[str, str]) -> tuple[list[float], list[str]]:
    """Return the eight numbers of a row, and what is wrong with them."""
    found = {name: number_in(cells[name]) for name in (*VALUES, *SIGMAS)}
    start = "the axis could not be used: found"
    problems = [
        f"{where}, column {name}: {start} "
        f"{describe(cells[name]) if cells[name] else 'an empty cell'}, needed a finite number; "
        "correct it or remove the row."
        for name, x in found.items()
        if not math.isfinite(x)
    ]
    problems += [
        f"{where}, column {name}: {start} {found[name]:g}, needed an angle from {-limit:.4f} to "
        f"{limit:.4f} rad; write radians, not degrees."
        for name, limit in LARGEST_ANGLE.items()
        if math.isfinite(found[name]) and abs(found[name]) > limit + ANGLE_ROUNDING
    ]
    problems += [
        f"{where}, column {name}: {start} {found[name]:g}, needed a coordinate from "
        f"{-LARGEST_DISTANCE:g} to {LARGEST_DISTANCE:g} m; correct it, or write metres."
        for name in ("x", "z")
        if math.isfinite(found[name]) and abs(found[name]) > LARGEST_DISTANCE
    ]
    least, most = SIGMA_RANGE
    problems += [
        f"{where}, column {name}: {start} {found[name]:g}, needed a standard deviation from "
        f"{least:g} to {most:g}; give it in {'rad' if name in SIGMAS[:2] else 'm'}."
        for name in SIGMAS
        if math.isfinite(found[name]) and not least <= found[name] <= most
    ]
    upright = math.cos(found["psi"]) * math.cos(found["theta"]) if not problems else 1.0
    if abs(upright) < LEAST_UPRIGHT:
        problems.append(
            f"{where}, columns psi, theta: {start} an axis parallel to the plane of the camera's x "
            "and z axes, needed one that crosses it: the point (x, 0, z) does not exist; remove "
            "the row, or give outlines instead."
        )
    return list(found.values()), problems
