"""Some of the images of a session, with the outlines, axes and corners that belong to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from legcal.data.axes import LegAxes, choose_axes
from legcal.data.corners import Corners, choose_corners, sort_corners
from legcal.data.measurements import Measurements
from legcal.data.outlines import Outlines, choose_outlines, sort_outlines
from legcal.geometry import IntArray


@dataclass(frozen=True, eq=False)
class Order:
    """Permutations: element k of a reordered thing is element ``index[k]`` of the original.

    Attributes
    ----------
    rows, views, legs : (n,) array of int
        Original indices of rows, views and legs, in the new order.
    """

    rows: IntArray
    views: IntArray
    legs: IntArray


def canonical_order(measurements: Measurements, leg_names: Sequence[str]) -> Order:
    """Return legs and views by name, and rows by view, image, pose label and readings.

    Parameters
    ----------
    measurements : Measurements
        The rows in any order.
    leg_names : sequence of str
        The legs, in the order of the columns of ``measurements.q``.
    """
    legs = np.argsort(np.array(leg_names, dtype=object), kind="stable")
    view_names = np.array([view.name for view in measurements.views], dtype=object)
    views = np.argsort(view_names, kind="stable")
    return Order(sort_rows(measurements, legs), views, legs)


def sort_rows(measurements: Measurements, legs: IntArray | None = None) -> IntArray:
    """Return the rows sorted by view name, image, pose label and readings.

    Parameters
    ----------
    measurements : Measurements
        The rows in any order.
    legs : (n_legs,) array of int or None
        The order in which readings are compared; None for that of the columns.

    Returns
    -------
    (n_rows,) array of int
        Indices of the rows, in their new order.
    """
    q = np.nan_to_num(measurements.q if legs is None else measurements.q[:, legs])
    labels = measurements.pose_labels or ("",) * measurements.n_poses
    keys = [
        (measurements.views[v].name, image, labels[p], readings)
        for v, image, p, readings in zip(
            measurements.view.tolist(),
            measurements.image,
            measurements.pose.tolist(),
            q.tolist(),
            strict=True,
        )
    ]
    return np.array(sorted(range(len(keys)), key=keys.__getitem__), dtype=np.intp)


def reorder_measurements(measurements: Measurements, order: Order) -> Measurements:
    """Return measurements in another order; poses are numbered as they first appear.

    Parameters
    ----------
    measurements : Measurements
        The rows in any order.
    order : Order
        All of their rows, views and legs in the order wanted.
    """
    pose = measurements.pose[order.rows]
    poses, first = np.unique(pose, return_index=True)
    poses = poses[np.argsort(first)]
    labels = measurements.pose_labels
    return replace(
        measurements,
        views=tuple(measurements.views[v] for v in order.views.tolist()),
        image=tuple(measurements.image[i] for i in order.rows.tolist()),
        view=inverse(order.views)[measurements.view[order.rows]],
        pose=inverse(poses)[pose],
        q=measurements.q[np.ix_(order.rows, order.legs)],
        pose_labels=tuple(labels[p] for p in poses.tolist()) if labels else (),
    )


def reorder_outlines(outlines: Outlines, order: Order) -> Outlines:
    """Return outlines of reordered measurements, sorted by row, leg, part and edge.

    Parameters
    ----------
    outlines : Outlines
        Outlines of the measurements in their original order.
    order : Order
        The order given to :func:`reorder_measurements`.
    """
    renamed = replace(
        outlines, row=inverse(order.rows)[outlines.row], leg=inverse(order.legs)[outlines.leg]
    )
    return sort_outlines(renamed)


def reorder_axes(axes: LegAxes, order: Order) -> LegAxes:
    """Return axes of reordered measurements, sorted by row and leg.

    Parameters
    ----------
    axes : LegAxes
        Axes of the measurements in their original order.
    order : Order
        The order given to :func:`reorder_measurements`.
    """
    row, leg = inverse(order.rows)[axes.row], inverse(order.legs)[axes.leg]
    return choose_axes(replace(axes, row=row, leg=leg), np.lexsort([leg, row]))


def reorder_corners(corners: Corners, order: Order) -> Corners:
    """Return corners of reordered measurements, sorted by row and number.

    Parameters
    ----------
    corners : Corners
        Corners of the measurements in their original order.
    order : Order
        The order given to :func:`reorder_measurements`.
    """
    return sort_corners(replace(corners, row=inverse(order.rows)[corners.row]))


def restore_corners(corners: Corners, order: Order) -> Corners:
    """Return corners of reordered measurements as those of the original ones, sorted."""
    return sort_corners(replace(corners, row=order.rows[corners.row]))


def restore_outlines(outlines: Outlines, order: Order) -> Outlines:
    """Return outlines of reordered measurements as those of the original ones, sorted."""
    return sort_outlines(
        replace(outlines, row=order.rows[outlines.row], leg=order.legs[outlines.leg])
    )


def inverse(permutation: IntArray) -> IntArray:
    """Return where each original element went: ``inverse(p)[p[k]] == k``."""
    return np.argsort(permutation)


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
