"""Some of the images of a session, with the outlines, axes and corners that belong to them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legcal.geometry.types import IntArray
from legcal.observations.corners import Corners, choose_corners
from legcal.observations.leg_axes import LegAxes, choose_axes
from legcal.observations.measurements import Measurements
from legcal.observations.outlines import Outlines
from legcal.observations.sets import choose_outlines


def measurements_at(measurements: Measurements, rows: IntArray) -> Measurements:
    """Return some rows; their poses are numbered as they first appear, all views stay.

    Parameters
    ----------
    measurements : Measurements
        All rows.
    rows : (n,) array of int
        Those to keep, in their new order.
    """
    poses, first, pose = np.unique(measurements.pose[rows], return_index=True, return_inverse=True)
    appearance = np.argsort(first)
    labels = measurements.pose_labels
    return replace(
        measurements,
        image=tuple(measurements.image[row] for row in rows.tolist()),
        view=measurements.view[rows],
        pose=np.argsort(appearance)[pose],
        q=measurements.q[rows],
        pose_labels=tuple(labels[p] for p in poses[appearance].tolist()) if labels else (),
    )


def outlines_at(outlines: Outlines, rows: IntArray) -> Outlines:
    """Return the outlines of some rows as those of :func:`measurements_at` them."""
    place = _places(rows, outlines.row)
    chosen = choose_outlines(outlines, place >= 0)
    return replace(chosen, row=place[place >= 0])


def axes_at(axes: LegAxes, rows: IntArray) -> LegAxes:
    """Return the axes of some rows as those of :func:`measurements_at` them."""
    place = _places(rows, axes.row)
    chosen = choose_axes(axes, np.flatnonzero(place >= 0))
    return replace(chosen, row=place[place >= 0])


def corners_at(corners: Corners, rows: IntArray) -> Corners:
    """Return the corners of some rows as those of :func:`measurements_at` them."""
    place = _places(rows, corners.row)
    chosen = choose_corners(corners, place >= 0)
    return replace(chosen, row=place[place >= 0])


def _places(rows: IntArray, of: IntArray) -> IntArray:
    """Return where each row stands among those kept, -1 where it is not."""
    place = np.full(max(rows.max(initial=-1), of.max(initial=-1)) + 1, -1, dtype=np.intp)
    place[rows] = np.arange(len(rows))
    return place[of]
