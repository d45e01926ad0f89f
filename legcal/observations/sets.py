"""Sets of outlines: chosen, joined, put in order, and corrected by hand."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from legcal.geometry.types import BoolArray, IntArray
from legcal.observations.measurements import Measurements
from legcal.observations.outlines import Outlines

Key = tuple[int, int, str, int]


def no_outlines() -> Outlines:
    """Return an empty table."""
    none = np.zeros(0, dtype=np.intp)
    return Outlines(
        row=none,
        leg=none,
        part=(),
        edge=none,
        h=np.zeros((0, 3)),
        ends=np.zeros((0, 2, 2)),
        covariance=np.zeros((0, 2, 2)),
        used=np.zeros(0, dtype=np.bool_),
        reason=(),
        source=(),
    )


def outline_keys(outlines: Outlines) -> list[Key]:
    """Return what makes each outline one and the same: image row, leg, part and edge."""
    return list(
        zip(
            outlines.row.tolist(),
            outlines.leg.tolist(),
            outlines.part,
            outlines.edge.tolist(),
            strict=True,
        )
    )


def choose_outlines(outlines: Outlines, chosen: BoolArray | IntArray) -> Outlines:
    """Return some of the outlines.

    Parameters
    ----------
    outlines : Outlines
        The table.
    chosen : (n,) array of bool, or (m,) array of int
        Which rows of the table, or their indices in a new order.
    """
    index = np.flatnonzero(chosen) if chosen.dtype == np.bool_ else chosen
    return Outlines(
        row=outlines.row[index],
        leg=outlines.leg[index],
        part=tuple(outlines.part[i] for i in index.tolist()),
        edge=outlines.edge[index],
        h=outlines.h[index],
        ends=outlines.ends[index],
        covariance=outlines.covariance[index],
        used=outlines.used[index],
        reason=tuple(outlines.reason[i] for i in index.tolist()),
        source=tuple(outlines.source[i] for i in index.tolist()),
        contrast=outlines.contrast[index],
        length=outlines.length[index],
        residual=outlines.residual[index],
        gamma=outlines.gamma[index],
        by_gamma=outlines.by_gamma[index],
    )


def join_outlines(tables: Sequence[Outlines]) -> Outlines:
    """Return the rows of several tables, sorted by image row, leg, part and edge."""
    tables = [no_outlines(), *tables]
    joined = Outlines(
        row=np.concatenate([t.row for t in tables]),
        leg=np.concatenate([t.leg for t in tables]),
        part=tuple(part for t in tables for part in t.part),
        edge=np.concatenate([t.edge for t in tables]),
        h=np.concatenate([t.h for t in tables]),
        ends=np.concatenate([t.ends for t in tables]),
        covariance=np.concatenate([t.covariance for t in tables]),
        used=np.concatenate([t.used for t in tables]),
        reason=tuple(reason for t in tables for reason in t.reason),
        source=tuple(source for t in tables for source in t.source),
        contrast=np.concatenate([t.contrast for t in tables]),
        length=np.concatenate([t.length for t in tables]),
        residual=np.concatenate([t.residual for t in tables]),
        gamma=np.concatenate([t.gamma for t in tables]),
        by_gamma=np.concatenate([t.by_gamma for t in tables]),
    )
    return sort_outlines(joined)


def sort_outlines(outlines: Outlines) -> Outlines:
    """Return the outlines sorted by image row, leg, part and edge."""
    keys = outline_keys(outlines)
    order = sorted(range(len(keys)), key=keys.__getitem__)
    return choose_outlines(outlines, np.array(order, dtype=np.intp))


def is_edited(outlines: Outlines) -> BoolArray:
    """Return which outlines were corrected by hand."""
    return np.array([source == "edited" for source in outlines.source], dtype=np.bool_)


def merge_edited(detected: Outlines, table: Outlines) -> Outlines:
    """Return detected outlines with the edited rows of a table laid over them.

    An edited row wins over the detected outline of the same image, leg, part and edge, and is
    kept where nothing was detected.

    Parameters
    ----------
    detected : Outlines
        What detection found.
    table : Outlines
        A table with edited rows; its other rows are left out.
    """
    edited = choose_outlines(table, is_edited(table))
    taken = set(outline_keys(edited))
    kept = np.array([key not in taken for key in outline_keys(detected)], dtype=np.bool_)
    return join_outlines([choose_outlines(detected, kept), edited])


def reject_unused_legs(
    outlines: Outlines, measurements: Measurements, leg_names: Sequence[str]
) -> Outlines:
    """Return outlines with those rejected whose leg the dataset leaves out of their view.

    Parameters
    ----------
    outlines : Outlines
        The table.
    measurements : Measurements
        The rows it belongs to; their views may name the legs to use.
    leg_names : sequence of str
        The legs of the mechanism.
    """
    views = [measurements.views[v] for v in measurements.view[outlines.row].tolist()]
    names = [leg_names[leg] for leg in outlines.leg.tolist()]
    out = np.array(
        [
            view.legs is not None and name not in view.legs
            for view, name in zip(views, names, strict=True)
        ],
        dtype=np.bool_,
    )
    out &= outlines.used
    reason = tuple(
        f"view {view.name} does not use this leg" if left_out else reason
        for view, left_out, reason in zip(views, out.tolist(), outlines.reason, strict=True)
    )
    return replace(outlines, used=outlines.used & ~out, reason=reason)
