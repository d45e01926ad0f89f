"""The measurement noise of a dataset with repeated images, as section 4.2 estimates it.

The same images go through both methods: legcal's detection, and Canny's edge points with lines by
least squares. Each gives pairs of outlines, axes by (4) and (5), and their Euler angles and M_LS;
the repeats of a leg's orientation (one pose in one view) give standard deviations. Repeats agree on
what the images share: an edge that light, blur or the model of the outline moves is moved in all
of them.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from legcal.dataset.folder import Dataset, load_dataset
from legcal.detection.detect import Method
from legcal.detection.outline import outline_parts
from legcal.errors import NotVisible
from legcal.geometry.types import IntArray
from legcal.mechanism.kinematics import forward_kinematics_many
from legcal.mechanism.model import Mechanism
from legcal.observations.canonical_order import canonical_order, reorder_measurements
from legcal.observations.measurements import Measurements
from legcal.observations.outlines import Outlines
from legcal.observations.sets import no_outlines
from legcal.photographs import Photographs, Placement, detect, place, scene_at_poses
from legcal.progress import Report, no_progress
from legcal.recognition.hints import BEFORE_FIT, hint_notes
from legcal.repeatability.canny import canny_parts
from legcal.repeatability.difference import outline_differences
from legcal.repeatability.notes import noise_notes
from legcal.repeatability.repeats import Repeats, find_repeats, group_rows
from legcal.repeatability.result import OUTLINE, LegNoise, MethodNoise, Noise
from legcal.repeatability.samples import LegOrientation, leg_orientations
from legcal.workers import worker_pool

METHODS: dict[str, tuple[Method, str]] = {
    "detector": (outline_parts, "Measuring outlines"),
    "canny": (canny_parts, "Canny and least squares"),
}


def measure_noise(
    source: str | Path | Dataset, *, progress: Report = no_progress, workers: int = 1
) -> Noise:
    """Estimate the noise of outlines and leg axes from repeated images of the same poses.

    Parameters
    ----------
    source : path or Dataset
        A dataset whose column ``pose`` says which images repeat each other. Its outlines, if it has
        any, are left alone: the images are searched.
    progress : callable
        Called as ``progress(stage, done, total)``.
    workers : int
        Search the images in that many processes, as :func:`legcal.calibrate` does.

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
    order = canonical_order(dataset.measurements, dataset.mechanism.leg_names)
    measurements = reorder_measurements(dataset.measurements, order)
    names = dataset.mechanism.leg_names
    mechanism = dataset.mechanism.with_leg_order([names[leg] for leg in order.legs])
    paths = [dataset.image_path(row) for row in order.rows.tolist()]
    has_image = np.array(
        [path is not None and os.path.exists(path) for path in paths], dtype=np.bool_
    )
    repeats = find_repeats(measurements, has_image, dataset.table_path)
    load = dataset.image_reader(order.rows.tolist())
    with worker_pool(workers) as run:
        every = Photographs(
            mechanism, measurements, load, run, np.flatnonzero(has_image), no_outlines()
        )
        placement, outlines = _search(every, repeats, progress)
    methods = []
    for name, found in outlines.items():
        orientations = leg_orientations(found, measurements, mechanism.legs, repeats)
        methods.append(MethodNoise(name, _by_leg(orientations, mechanism, names)))
    _refuse_nothing_found(dataset, methods)
    return Noise(
        dataset=dataset,
        view_names=tuple(view.name for view in measurements.views),
        pose_labels=measurements.pose_labels,
        repeats=tuple(repeats),
        methods=tuple(methods),
        differences=tuple(
            outline_differences(
                outlines["detector"],
                outlines["canny"],
                measurements,
                repeats,
                mechanism.leg_names,
            )
        ),
        notes=(
            *dataset.notes,
            *placement.all_notes,
            *_hint_notes(measurements, placement),
            *noise_notes(measurements, methods),
        ),
    )


def _search(
    every: Photographs, repeats: Sequence[Repeats], progress: Report
) -> tuple[Placement, dict[str, Outlines]]:
    """Place the cameras; return the outlines that each method finds in all repeated images."""
    measurements = every.measurements
    q = measurements.q[measurements.first_rows]
    poses = forward_kinematics_many(every.mechanism, q)
    scene = scene_at_poses(every.mechanism, measurements, poses)
    to_align = replace(every, detect=_rows_to_align(every, repeats))
    placement = place(to_align, scene, progress)
    placement.require_one()
    scene = placement.scene
    repeated = replace(every, detect=np.sort(np.concatenate([group.rows for group in repeats])))
    found = {
        name: detect(repeated, scene, progress, method=method, stage=stage)
        for name, (method, stage) in METHODS.items()
    }
    return placement, found


def _hint_notes(measurements: Measurements, placement: Placement) -> list[str]:
    """Return what is to be said of rough camera poses that are wrong."""
    views = measurements.views
    hints = [view.T_base_camera for view in views]
    cameras = placement.scene.T_base_camera
    return hint_notes([view.name for view in views], hints, cameras, BEFORE_FIT)


def _rows_to_align(every: Photographs, repeats: Sequence[Repeats]) -> IntArray:
    """Return one image of every pose of the views that have repeats."""
    views = {group.view for group in repeats}
    groups = group_rows(every.measurements, every.detect)
    return np.sort([group.rows[0] for group in groups if group.view in views])


def _by_leg(
    found: Sequence[LegOrientation], mechanism: Mechanism, names: Sequence[str]
) -> tuple[LegNoise, ...]:
    """Return the orientations of every leg, legs in the order of the model."""
    index = {name: mechanism.leg_names.index(name) for name in names}
    return tuple(LegNoise(name, tuple(o for o in found if o.leg == index[name])) for name in names)


def _refuse_nothing_found(dataset: Dataset, methods: Sequence[MethodNoise]) -> None:
    """Raise NotVisible if no method has found any outline twice."""
    if any(method.spread(OUTLINE) for method in methods):
        return
    raise NotVisible(
        f"{dataset.table_path}: the measurement noise could not be estimated: found no outline in "
        "two images of the same pose, needed one; check the images and the radii of the legs."
    )
