"""Tables of observations in images: select, join and reorder rows, and map them to other images.

A table (outlines, corners, axes) has one entry a row in each of its fields; ``row`` is the index of
the image in the measurements. Jobs put datasets into canonical order before they begin, so that
results do not depend on the order of files.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self, TypeVar

import numpy as np

from legcal.data.measurements import Measurements
from legcal.data.reasons import Reason, Rejection
from legcal.files.schema import natural_key
from legcal.geometry.tables import Table
from legcal.geometry.types import BoolArray, IntArray


def _order_of(keys: Sequence[Any]) -> IntArray:
    """Return the indices that sort keys."""
    return np.array(sorted(range(len(keys)), key=keys.__getitem__), dtype=np.intp)


@dataclass(frozen=True, eq=False)
class ImageTable(Table):
    """A table whose fields are arrays or tuples with one entry a row."""

    keys: ClassVar[tuple[str, ...]]  # the fields that identify a row, in the order of sorting
    row: IntArray  # (n,) of the measurements

    def row_keys(self) -> list[tuple[Any, ...]]:
        """Return the entries of ``keys`` in each row."""
        columns = (getattr(self, name) for name in self.keys)
        return list(zip(*(x if isinstance(x, tuple) else x.tolist() for x in columns), strict=True))

    def sort(self) -> Self:
        """Return the rows sorted by their keys."""
        return self.choose(_order_of(self.row_keys()))

    def at(self, rows: IntArray) -> Self:
        """Return the observations in some images, as a table for :func:`measurements_at` them."""
        place = np.full(max(rows.max(initial=-1), self.row.max(initial=-1)) + 1, -1, dtype=np.intp)
        place[rows] = np.arange(len(rows))
        place = place[self.row]
        return replace(self.choose(place >= 0), row=place[place >= 0])

    def reject(self, wrong: BoolArray, why: Reason | Sequence[Rejection]) -> Self:
        """Return the table with some of its used observations rejected.

        *why* is one reason for all, or a rejection for each.
        """
        table = self.columns()
        out = table["used"] & wrong
        reasons = (Rejection(why),) * len(self) if isinstance(why, Reason) else why
        changed: dict[str, Any] = {
            "used": table["used"] & ~out,
            "reason": tuple(
                new if is_out else old
                for is_out, new, old in zip(out.tolist(), reasons, table["reason"], strict=True)
            ),
        }
        return replace(self, **changed)

    def rejected_for(self, *reasons: Reason) -> BoolArray:
        """Return a mask (n,) of the observations rejected for any of some reasons."""
        why = self.columns()["reason"]
        return np.array([rejection.reason in reasons for rejection in why], dtype=np.bool_)


_Table = TypeVar("_Table", bound=ImageTable)


@dataclass(frozen=True, eq=False)
class Order:
    """Permutations: element k of a reordered thing is element ``index[k]`` of the original."""

    rows: IntArray
    views: IntArray
    legs: IntArray

    def reorder(self, table: _Table) -> _Table:
        """Map a table of the original measurements to the reordered measurements, sorted."""
        return self._renamed(table, inverse(self.rows), inverse(self.legs))

    def restore(self, table: _Table) -> _Table:
        """Map a table of the reordered measurements to the original measurements, sorted."""
        return self._renamed(table, self.rows, self.legs)

    def _renamed(self, table: _Table, rows: IntArray, legs: IntArray) -> _Table:
        changed = {"row": rows[table.row]}
        if hasattr(table, "leg"):
            changed["leg"] = legs[table.leg]
        return replace(table, **changed).sort()


def canonical_order(measurements: Measurements, leg_names: Sequence[str]) -> Order:
    """Return legs and views by name, and rows by view, image, pose label and readings.

    Numbers in names of views, images and poses are in order, since they are listed so.
    """
    legs = np.argsort(np.array(leg_names, dtype=object), kind="stable")
    views = _order_of([natural_key(name) for name in measurements.view_names])
    labels = measurements.pose_labels or ("",) * measurements.n_poses
    keys = [
        (
            natural_key(measurements.views[v].name),
            natural_key(image),
            natural_key(labels[p]),
            readings,
        )
        for v, image, p, readings in zip(
            measurements.view.tolist(),
            measurements.image,
            measurements.pose.tolist(),
            np.nan_to_num(measurements.q[:, legs]).tolist(),
            strict=True,
        )
    ]
    return Order(_order_of(keys), views, legs)


def reorder_measurements(measurements: Measurements, order: Order) -> Measurements:
    """Return measurements in another order; poses are numbered as they first appear."""
    moved = measurements_at(measurements, order.rows)
    return replace(
        moved,
        views=tuple(measurements.views[v] for v in order.views.tolist()),
        view=inverse(order.views)[moved.view],
        q=moved.q[:, order.legs],
        sigma_q=moved.sigma_q[order.legs],
    )


def measurements_at(measurements: Measurements, rows: IntArray) -> Measurements:
    """Return some rows in a new order; poses are numbered as they first appear, all views stay."""
    poses, first, pose = np.unique(measurements.pose[rows], return_index=True, return_inverse=True)
    appearance = np.argsort(first)
    labels = measurements.pose_labels
    return replace(
        measurements,
        image=tuple(measurements.image[row] for row in rows.tolist()),
        view=measurements.view[rows],
        pose=np.argsort(appearance)[pose],
        q=measurements.q[rows],
        time=None if measurements.time is None else measurements.time[rows],
        pose_labels=tuple(labels[p] for p in poses[appearance].tolist()) if labels else (),
        own_zeros=tuple(replace(one, rows=one.rows[rows]) for one in measurements.own_zeros),
    )


def inverse(permutation: IntArray) -> IntArray:
    """Return the inverse of a permutation: ``inverse(p)[p[k]] == k``."""
    return np.argsort(permutation)
