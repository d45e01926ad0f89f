"""The table ``observations.csv``: outlines written, corrected by hand and read back.

The image column names the row of ``measurements.csv`` that an outline belongs to. Where that
row has no image, the rows without image of its view are named by their pose labels if every
one has its own, otherwise by their numbers in ``measurements.csv``, counted from 1.
"""

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from legcal.errors import DatasetError
from legcal.files.atomic import write_atomically
from legcal.files.csv_file import read_named_rows
from legcal.geometry.types import Array
from legcal.mechanism.leg import Leg
from legcal.observations.measurements import Measurements
from legcal.observations.outlines import ENCODING, QUALITY, Outlines
from legcal.observations.row import (
    COLUMNS,
    VERDICTS,
    OutlineRow,
    parse_row,
    place_of,
    rows_to_outlines,
)

LINE_TOLERANCE_PX = 5.0  # ends further from the line contradict it


def row_names(measurements: Measurements) -> tuple[str, ...]:
    """Return what the image column calls each row of the measurements.

    Parameters
    ----------
    measurements : Measurements
        The rows, in the order of the file.
    """
    names = list(measurements.image)
    for v in range(len(measurements.views)):
        rows = np.flatnonzero(measurements.view == v).tolist()
        blank = [i for i in rows if not names[i]]
        taken = {names[i] for i in rows}
        labels = [
            measurements.pose_labels[measurements.pose[i]] if measurements.pose_labels else ""
            for i in blank
        ]
        if not all(labels) or len(set(labels)) < len(labels) or set(labels) & taken:
            labels = [str(i + 1) for i in blank]
        for i, label in zip(blank, labels, strict=True):
            names[i] = label
    return tuple(names)


def rows_by_name(measurements: Measurements) -> dict[tuple[str, str], int]:
    """Return the row of the measurements for each view and name in the image column."""
    names = row_names(measurements)
    views = [measurements.views[v].name for v in measurements.view.tolist()]
    return {place: row for row, place in enumerate(zip(views, names, strict=True))}


def write_observations(
    path: Path, outlines: Outlines, measurements: Measurements, leg_names: Sequence[str]
) -> None:
    """Write outlines so that reading gives the same numbers, and the file complete or not at all.

    Parameters
    ----------
    path : Path
        ``observations.csv``.
    outlines : Outlines
        What to write.
    measurements : Measurements
        The rows they belong to, in the order of the file.
    leg_names : sequence of str
        The legs of the mechanism.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    write_atomically(path, format_observations(outlines, measurements, leg_names).encode())


def format_observations(
    outlines: Outlines, measurements: Measurements, leg_names: Sequence[str]
) -> str:
    """Return the text of ``observations.csv``; arguments as in :func:`write_observations`."""
    names = row_names(measurements)
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*COLUMNS, *QUALITY, *ENCODING])
    for i in range(len(outlines)):
        row, covariance = outlines.row[i], outlines.covariance[i]
        told = [float(getattr(outlines, name)[i]) for name in (*QUALITY, *ENCODING)]
        numbers = [
            *outlines.h[i].tolist(),
            *outlines.ends[i].ravel().tolist(),
            *covariance[[0, 0, 1], [0, 1, 1]].tolist(),
        ]
        writer.writerow(
            [
                measurements.views[measurements.view[row]].name,
                names[row],
                leg_names[outlines.leg[i]],
                outlines.part[i],
                int(outlines.edge[i]),
                *map(_cell, numbers),
                VERDICTS[0 if outlines.used[i] else 1],
                outlines.reason[i],
                outlines.source[i],
                *map(_cell, told),
            ]
        )
    return text.getvalue()


def _cell(number: float) -> str:
    """Return a number as it is read back, nothing for NaN."""
    return "" if math.isnan(number) else repr(number)


def read_observations(
    path: Path,
    legs: Sequence[Leg],
    measurements: Measurements,
    *,
    skip_stale: bool = False,
) -> Outlines:
    """Read ``observations.csv``.

    (a, b, c) is normalised; the ends are put in order, nearer to the base joint first, as the
    sign of eq (3) tells it.

    Parameters
    ----------
    path : Path
        The table.
    legs : sequence of Leg
        The legs of the mechanism, for their names and visible cylinders.
    measurements : Measurements
        The rows that outlines belong to, in the order of the file.
    skip_stale : bool
        Leave out detected outlines of images, legs or parts that are no longer there, as in
        a table that legcal wrote for an earlier state of the dataset.

    Returns
    -------
    Outlines
        In the order of the file.

    Raises
    ------
    DatasetError
        With one sentence for each thing that is wrong, naming row and column.
    """
    problems: list[str] = []
    places = rows_by_name(measurements)
    found: list[OutlineRow] = []
    first: dict[tuple[int, int, str, int], str] = {}
    remedy = "delete the file to have it written again"
    optional = (*QUALITY, *ENCODING)
    rows = read_named_rows(
        path, "table of observations", COLUMNS, remedy, problems, optional=optional
    )
    for where, cells in rows:
        place, unknown = place_of(where, cells, places, legs)
        if unknown and skip_stale and cells["source"] == "detected":
            continue
        problems += unknown
        outline = parse_row(where, cells, place, problems)
        if outline is None or unknown:
            continue
        earlier = first.setdefault(outline.key, where)
        if earlier != where:
            problems.append(
                f"{where}: the outline could not be used: found the same image, leg, part and edge "
                f"in {earlier.rsplit(', ', 1)[-1]}, needed it once; remove one of them."
            )
        found.append(outline)
    if problems:
        raise DatasetError(problems)
    outlines = _ordered_ends(rows_to_outlines(found), measurements)
    problems = _line_problems(outlines, [o.where for o in found], measurements)
    if problems:
        raise DatasetError(problems)
    return outlines


def _rays(outlines: Outlines, measurements: Measurements) -> Array:
    """Return the ends of outlines on the sensor plane, (n, 2, 2)."""
    xy = np.full(outlines.ends.shape, np.nan)
    view = measurements.view[outlines.row]
    known = np.all(np.isfinite(outlines.ends), axis=(1, 2))
    for v in np.unique(view):
        chosen = (view == v) & known
        if np.any(chosen):
            xy[chosen] = measurements.views[v].camera.undistort(outlines.ends[chosen])
    return xy


def _ordered_ends(outlines: Outlines, measurements: Measurements) -> Outlines:
    """Return outlines with the end nearer to the base joint first.

    h is the moment u x P, and the ray to the second end is that to the first plus a piece of
    u, so that (second x first) . h > 0.
    """
    xy = _rays(outlines, measurements)
    rays = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=-1)
    swap = np.sum(np.cross(rays[:, 1], rays[:, 0]) * outlines.h, axis=-1) < 0.0
    ends = np.where(swap[:, None, None], outlines.ends[:, ::-1], outlines.ends)
    turned = outlines.covariance[:, ::-1, ::-1]
    covariance = np.where(swap[:, None, None], turned, outlines.covariance)
    return replace(outlines, ends=ends, covariance=covariance)


def _line_problems(
    outlines: Outlines, wheres: Sequence[str], measurements: Measurements
) -> list[str]:
    """Return used outlines whose ends do not lie on their line."""
    xy = _rays(outlines, measurements)
    problems = []
    for i in np.flatnonzero(outlines.used).tolist():
        camera = measurements.views[measurements.view[outlines.row[i]]].camera
        offset = float(np.abs(camera.line_offset(outlines.h[i][None], xy[i])).max())
        if not offset <= LINE_TOLERANCE_PX:
            problems.append(
                f"{wheres[i]}, columns a to v1: the outline could not be used: found ends "
                f"{offset:.3g} px from the line (a, b, c), needed at most "
                f"{LINE_TOLERANCE_PX:g} px; correct the line or its ends."
            )
    return problems
