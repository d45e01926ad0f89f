"""The outlines of all images near a placement: the one place where detection is entered."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from legcal.data.outlines import Outlines, join_outlines, no_outlines
from legcal.data.reasons import Reason, Rejection
from legcal.geometry.types import Array
from legcal.machine.shapes import PlacedOccluders
from legcal.perception.outline import (
    ImageSearch,
    Method,
    PartLines,
    measure,
    outline_table,
)
from legcal.perception.placement import Placement, Search, predict_legs_and_arms
from legcal.vision.visibility import PredictedLeg
from legcal.workers import Run, in_turn


def measure_outlines(
    search: Search,
    placement: Placement,
    rows: Sequence[int],
    *,
    method: Method = measure,
    run: Run = in_turn,
    progress: Callable[[int], None] | None = None,
) -> tuple[Outlines, Array]:
    """Find and measure the outlines of all legs in the images of rows, near a placement.

    Two outlines for each part of each leg that is looked for, by row; what was not found or cannot
    be trusted is rejected with the reason. And the blur (n_rows,) of all images [px], NaN where
    none was measured. ``progress`` is called with each row that has been searched.
    """
    if placement.window is not None:
        rows = [row for row in rows if not np.isnan(placement.window[row]).all()]
    search = replace(search, edge_pairs={}, still={})  # of no use to worker processes
    blur, tables = np.full(search.measurements.n_rows, np.nan), []
    task = partial(_of_image, search, placement, method)
    for row, (outlines, blur[row]) in zip(rows, run(task, rows), strict=True):
        tables.append(outlines)
        if progress is not None:
            progress(row)
    return join_outlines(tables), blur


def _of_image(
    search: Search, placement: Placement, method: Method, row: int
) -> tuple[Outlines, float]:
    """Find and measure the outlines of all wanted legs of an image; return its blur too [px]."""
    view = int(search.measurements.view[row])
    camera, T = search.measurements.views[view].camera, placement.T_base_camera[view]
    window = np.where(search.wanted[view], 0.0, np.nan)
    if placement.window is not None:
        window += placement.window[row]
    wanted = [leg for leg in np.flatnonzero(~np.isnan(window)).tolist() if search.cylinders[leg]]
    predicted: list[PredictedLeg] = []
    arms, occluders = placement.arms, PlacedOccluders.none()
    if T is not None:
        ends = placement.A_base, placement.B_base
        predicted = predict_legs_and_arms(camera, T, ends, search.cylinders, arms, row)
        here = (of_rows[row : row + 1] for of_rows in ends)
        (occluders,) = PlacedOccluders.at(search.occluders, *here)
        occluders = occluders.before(T.as_matrix())
    window = np.concatenate([window, window[list(arms)]])
    if placement.window is None:
        error = np.broadcast_to(placement.joint_error, search.wanted.shape)[view]
        error = np.concatenate([error, [arm.error for arm in arms.values()]])
        for leg in predicted:
            joint_error = search.size * error[leg.leg]
            window[leg.leg] += placement.pixel_error + joint_error * _pixels_per_metre(leg)
    known = placement.blur[view] if placement.blur else np.nan
    blur = search.blur.get(row, 0.0) if np.isnan(known) else known
    one = ImageSearch(
        row,
        np.zeros((0, 0), dtype=np.float32) if T is None else search.load(row),
        camera,
        predicted,
        [*search.leg_names, *(arm.name for arm in arms.values())],
        window,
        guided=placement.window is not None,
        blur=blur or None,
        near_fit=not np.isnan(known),
        arms=tuple(arms),
        occluders=occluders,
        polished=placement.polished,
    )
    found, blur = (no_outlines(), np.nan) if T is None else method(one)
    seen = {leg.leg for leg in predicted}
    why = Rejection(Reason.NOT_PLACED if T is None else Reason.OUTSIDE)
    others = [PartLines(j, _longest(search, j), (why, why)) for j in wanted if j not in seen]
    return join_outlines([found, outline_table(one, others)]) if others else found, blur


def _longest(search: Search, leg: int) -> str:
    """Return the part of a leg that stands for it where it is not looked for."""
    of_leg = search.cylinders[leg]
    return max(of_leg, key=lambda cylinder: (cylinder.end - cylinder.start, cylinder.link)).link


def _pixels_per_metre(leg: PredictedLeg) -> float:
    """Return the image scale at the nearer joint of a leg [px/m]."""
    depths = leg.A_camera[2], leg.B_camera[2]
    length = float(np.linalg.norm(leg.B_camera - leg.A_camera))
    nearest = max(min(depths), 0.2 * depths[0], 0.0025 * length)
    return float(leg.band.scale / nearest)
