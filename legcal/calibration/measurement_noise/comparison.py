"""The noise of repeated images by two methods, as section 4.2 estimates it: ``legcal noise``."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from legcal.calibration.measurement_noise.canny import canny_parts
from legcal.calibration.measurement_noise.document import (
    CALLED,
    DatasetNoise,
    LegNoise,
    MethodNoise,
)
from legcal.calibration.measurement_noise.repeatability import (
    OUTLINE,
    LegOrientation,
    Repeats,
    group_rows,
    leg_orientations,
)
from legcal.calibration.ordered_dataset import order_dataset
from legcal.data.dataset import Dataset, load_dataset
from legcal.data.measurements import Measurements, few
from legcal.data.outlines import Outlines, no_outlines
from legcal.errors import DatasetError, NotIdentifiable, NotVisible
from legcal.geometry.types import Array, BoolArray
from legcal.machine.kinematics import forward_kinematics_many
from legcal.perception.diagnostics import BEFORE_FIT, hint_notes
from legcal.perception.outline import Method, measure
from legcal.perception.photographs import (
    Photographs,
    measure_photographs,
    nominal_placement,
    recognise_and_place,
)
from legcal.perception.placement import Placement
from legcal.progress import Progress, Report, shown_progress
from legcal.vision.cylinder import EPSILON
from legcal.workers import Workers, worker_pool

_METHODS: dict[str, tuple[Method, str]] = {
    "detector": (measure, "Measuring outlines"),
    "canny": (canny_parts, "Canny and least squares"),
}
_BIAS = (
    "Repeats show what differs between images of one pose, not the bias that they share: an edge "
    "that light, blur or rounding to whole pixels displaces in all of them shows no spread. What "
    "the detector claims allows for such bias, so that a ratio below one is expected of it."
)
_RANGE = (
    "The 95 % ranges hold for normal errors: where a method falls on one edge in some images and "
    "on another in others, they are too narrow."
)
_MIN_JUMP = 3.0  # ratio of spread to claim of an edge that jumps, and the same in the median ratio:
# not all edges of a method that claims too little jump


def measure_noise(
    source: str | Path | Dataset, *, progress: Progress = False, workers: Workers = 1
) -> DatasetNoise:
    """Estimate the noise of outlines and leg axes from repeated images of the same poses.

    Parameters
    ----------
    source : path or Dataset
        A dataset whose column ``pose`` says which images repeat each other. Its outlines, if it has
        any, are left alone: the images are searched.
    progress : bool or callable
        True shows bars on stderr; a function is called as ``progress(stage, done, total)``.
    workers : int, str or executor
        Search the images there, as :func:`legcal.calibrate` does.

    Raises
    ------
    DatasetError, ModelError, OutOfClass
        If the input is malformed or not covered, or has no images.
    NotIdentifiable
        If no image is repeated, or the motors do not determine where the legs are.
    NotVisible
        If the images do not show the legs where they should be, or no leg was found twice.
    """
    dataset = source if isinstance(source, Dataset) else load_dataset(source)
    with shown_progress(progress) as report, worker_pool(workers) as executor:
        data = order_dataset(dataset, executor, report)
        machine, measurements = data.machine, data.measurements
        paths = [dataset.image_path(row) for row in data.order.rows.tolist()]
        has_image = np.array(
            [path is not None and os.path.exists(path) for path in paths], dtype=np.bool_
        )
        repeats = find_repeats(measurements, has_image, dataset.table_path)
        every = replace(data.photographs, detect=np.flatnonzero(has_image), keep=no_outlines())
        placement, outlines = _search(every, repeats, report)
    methods = []
    for name, table in outlines.items():
        found = leg_orientations(table, measurements, machine.legs, repeats)
        legs = []
        for leg in dataset.machine.leg_names:
            j = machine.leg_names.index(leg)
            legs.append(LegNoise(leg, tuple(o for o in found if o.leg == j)))
        methods.append(MethodNoise(name, tuple(legs)))
    if not any(method.spread(OUTLINE) for method in methods):
        raise NotVisible(
            f"{dataset.table_path}: the measurement noise could not be estimated: found no outline "
            "in two images of the same pose, needed one; check the images and the radii of the "
            "legs."
        )
    views = measurements.views
    hints = hint_notes(
        [view.name for view in views],
        [view.T_base_camera for view in views],
        placement.T_base_camera,
        BEFORE_FIT,
    )
    return DatasetNoise(
        dataset=dataset,
        view_names=tuple(view.name for view in views),
        pose_labels=measurements.pose_labels,
        repeats=tuple(repeats),
        methods=tuple(methods),
        leg_names=tuple(machine.leg_names),
        differences=_differences(
            outlines["detector"], outlines["canny"], measurements, repeats, machine.leg_names
        ),
        notes=(
            *dataset.notes,
            *placement.all_notes(measurements),
            *hints,
            *noise_notes(measurements, methods),
        ),
    )


def find_repeats(measurements: Measurements, has_image: BoolArray, where: Path) -> list[Repeats]:
    """Return the repeated images of a dataset, by view and pose; ``where`` is its table.

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


def _search(
    every: Photographs, repeats: Sequence[Repeats], progress: Report
) -> tuple[Placement, dict[str, Outlines]]:
    """Place the cameras; return the outlines that each method finds in all repeated images."""
    measurements = every.measurements
    poses = forward_kinematics_many(every.machine, measurements.q_of_poses)
    nominal = nominal_placement(every.machine, measurements, poses)
    views = {group.view for group in repeats}  # placed by one image of every pose
    groups = group_rows(measurements, every.detect)
    rows = np.sort([group.rows[0] for group in groups if group.view in views])
    placement = recognise_and_place(replace(every, detect=rows), nominal, progress)
    placement.require_one()
    repeated = replace(every, detect=np.sort(np.concatenate([group.rows for group in repeats])))
    found = {
        name: measure_photographs(repeated, placement, progress, method=method, stage=stage)
        for name, (method, stage) in _METHODS.items()
    }
    return placement, found


def _differences(
    first: Outlines,
    second: Outlines,
    measurements: Measurements,
    repeats: Sequence[Repeats],
    leg_names: Sequence[str],
) -> dict[str, Array]:
    """Return how far lines of the second method lie outside the first's, means over repeats."""
    group_of = {row: k for k, group in enumerate(repeats) for row in group.rows.tolist()}
    place = {key: i for i, key in enumerate(second.row_keys()) if second.used[i]}
    found: dict[tuple[int, int, str, int], list[Array]] = {}
    for i, (row, leg, part, edge) in enumerate(first.row_keys()):
        j = place.get((row, leg, part, edge))
        if j is None or not first.used[i]:
            continue
        camera = measurements.views[int(measurements.view[row])].camera
        # Positive inside the second line, which then lies outside the first.
        h = np.broadcast_to(second.h[j], (2, 3))
        offset = EPSILON[edge - 1] * camera.line_offset(h, camera.undistort(first.ends[i]))
        found.setdefault((group_of[row], leg, part, edge), []).append(offset)
    by_leg: dict[str, list[Array]] = {}
    for (_, leg, _, _), offsets in sorted(found.items(), key=lambda item: item[0]):
        by_leg.setdefault(leg_names[leg], []).append(np.mean(offsets, axis=0))
    return {leg: np.array(outward) for leg, outward in by_leg.items()}


def noise_notes(measurements: Measurements, methods: Sequence[MethodNoise]) -> list[str]:
    """Return what repeated images cannot determine, and what is not known of which leg."""
    notes = [_BIAS, _RANGE]
    for leg in methods[0].legs:
        if not leg.orientations:
            notes.append(f"{leg.name} is in none of the repeated images.")
    for method in methods:
        called = CALLED[method.name]
        for leg in method.legs:
            if leg.orientations and not any(o.quantities for o in leg.orientations):
                notes.append(f"{leg.name}: {called} found its axis in no two images of one pose.")
            without = [o for o in leg.orientations if o.inclination is not None]
            if without:
                places = ", ".join(sorted({_view_and_pose(measurements, o) for o in without}))
                inclined = np.degrees(min(o.inclination or 0.0 for o in without))
                notes.append(
                    f"{leg.name}: M_LS does not exist for {called} in {len(without)} of "
                    f"{len(leg.orientations)} orientations ({places}), where the leg is parallel "
                    f"to the image x axis within {inclined:.2f} deg, or to the camera's plane "
                    "y = 0: M_LS would slide along it by more than its width, or lie at infinity."
                )
        notes += _jumps(measurements, method)
    return notes


def _jumps(measurements: Measurements, method: MethodNoise) -> list[str]:
    """Return a note on outlines that spread far more than the others, against what is claimed."""
    ratios = [line.ratio for leg in method.legs for o in leg.orientations for line in o.lines]
    least = _MIN_JUMP * max(1.0, float(np.median(ratios))) if ratios else np.inf
    found = []
    for leg in method.legs:
        for o in leg.orientations:
            jumping = [line.sd for line in o.lines if line.ratio > least]
            if jumping:
                found.append((max(jumping), f"{leg.name} in {_view_and_pose(measurements, o)}"))
    if not found:
        return []
    found.sort(key=lambda jump: -jump[0])
    places = few([f"{where} ({sd:.3f} px)" for sd, where in found])
    return [
        f"{CALLED[method.name]}: single outlines spread over {least:.2g} times as far as is "
        f"claimed of them: {places}. Such an edge jumps between images; pooled "
        "standard deviations and upper bounds are of the jumps, medians are not."
    ]


def _view_and_pose(measurements: Measurements, o: LegOrientation) -> str:
    return f"{measurements.views[o.view].name}/{measurements.pose_labels[o.pose]}"
