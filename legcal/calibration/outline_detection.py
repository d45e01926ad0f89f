"""Detection without a fit: what the images of a dataset show, for people to look at.

The cameras are placed and the outlines measured as :func:`legcal.calibrate` does first. Nothing is
written beside the dataset.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from legcal.calibration.detection import (
    DETECTION,
    Detection,
    check_detection_destination,
    write_detection,
)
from legcal.calibration.joint_fit.diagnostics import arms_of_other_widths, wrong_arms_in_words
from legcal.calibration.ordered_dataset import OrderedDataset, order_dataset
from legcal.calibration.pipeline import rough_placement
from legcal.data.dataset import Dataset, load_dataset
from legcal.data.image_causes import image_notes
from legcal.data.image_tables import inverse
from legcal.data.measurements import few_views
from legcal.data.outlines import (
    Outlines,
    are_of_arms,
    join_outlines,
    merge_edited,
    no_outlines,
    reject_unused_legs,
)
from legcal.errors import DatasetError
from legcal.files.folder import output_path
from legcal.geometry.motions import components
from legcal.geometry.types import IntArray
from legcal.machine.rods import measured_readings
from legcal.perception.diagnostics import BEFORE_FIT, hint_notes
from legcal.perception.photographs import (
    MeasuredImages,
    given_outlines,
    measure_photographs,
    place_and_measure,
)
from legcal.perception.placement import PlacedArm, Placement, placed_arms
from legcal.progress import Progress, shown_progress
from legcal.workers import Workers, worker_pool


def detect(
    source: str | Path | Dataset,
    *,
    output: str | Path | None = None,
    progress: Progress = False,
    workers: Workers = 1,
) -> Detection:
    """Find and measure the outlines of the legs in all images, without a fit.

    Parameters
    ----------
    source : path or Dataset
        The dataset folder, or what :func:`legcal.load_dataset` returned. Outlines that were given
        or edited are taken as they are; those that an earlier run left beside it are not.
    output : path, optional
        Write a folder there: ``observations.csv``, ``index.html`` and each image with what was
        found in it.
    progress : bool or callable
        True shows bars on stderr; a function is called as ``progress(stage, done, total)``.
    workers : int, str or executor
        Search and draw the images there, as :func:`legcal.calibrate` does.

    Returns
    -------
    Detection
        With views in ``unplaced`` whose images do not show the legs where they should be.

    Raises
    ------
    DatasetError, ModelError, OutOfClass
        If the input is malformed or not covered, or has no images.
    NotVisible
        If the images do not show the calibration board that they should.
    NotIdentifiable
        If the motors do not determine where the legs are.
    UsageError
        If ``output`` holds something else, or a table of an earlier detection that was corrected.
    """
    if output is not None:
        folder = source.folder if isinstance(source, Dataset) else _folder(Path(source))
        check_detection_destination(output_path(output, DETECTION), folder)
    dataset = source if isinstance(source, Dataset) else load_dataset(source)
    images = rows_with_image(dataset)
    with shown_progress(progress) as report, worker_pool(workers) as pool:
        data = order_dataset(dataset, pool, report)
        detection = detected(data, images)
        if output is not None:
            write_detection(detection, Path(output), pool, report)
    return detection


def _folder(path: Path) -> Path:
    """Return the folder of a dataset that is named by it or by its ``dataset.yaml``."""
    return path if path.is_dir() else path.parent


def rows_with_image(dataset: Dataset) -> IntArray:
    """Return the rows that have an image file; refuse a dataset without any."""
    paths = [dataset.image_path(row) for row in range(dataset.measurements.n_rows)]
    rows = [row for row, path in enumerate(paths) if path is not None and os.path.exists(path)]
    if dataset.axes is not None or not rows:
        found = "a table of axes" if dataset.axes is not None else "no image"
        raise DatasetError(
            f"{dataset.table_path}: the images could not be searched: found {found}, needed images "
            "of the legs; name them in the table of measurements."
        )
    return np.array(rows, dtype=np.intp)


def detected(data: OrderedDataset, images: IntArray) -> Detection:
    """Recognise and measure, and return what was found in the order of the files."""
    dataset, order, photographs = data.dataset, data.order, data.photographs
    scene, board = rough_placement(data)
    outlines, cylinders = given_outlines(photographs), photographs.cylinders
    unplaced = dict[str, str]()
    image_notes, notes = list[str](), list[str]()
    if len(photographs.detect):
        T_board_camera = None if board is None else board.T_board_camera
        seen = place_and_measure(photographs, scene, data.progress, T_board_camera)
        cameras, cylinders = seen.placement.T_base_camera, seen.photographs.cylinders
        placed = np.array([T is not None for T in cameras])
        row = seen.outlines.row
        kept = placed[data.measurements.view[row]] | ~np.isin(row, photographs.detect)
        outlines, unplaced = seen.outlines.choose(kept), seen.placement.unplaced
        arms = _nominal_arms(data)
        if arms:
            outlines = join_outlines([outlines, _of_arms(data, seen, arms)])
        image_notes, notes = _image_notes(data, seen.placement), _gamma_notes(data)
        if wrong := arms_of_other_widths(outlines, are_of_arms(outlines, data.machine.legs)):
            said = wrong_arms_in_words(wrong, data.machine.legs)
            notes.append(f"Arms do not look as the model draws them: {said}")
        # Legs of a view that could not be placed are drawn where its rough pose has them.
        drawn = tuple(
            T if T is not None else rough
            for T, rough in zip(cameras, scene.T_base_camera, strict=True)
        )
        scene = replace(seen.placement, T_base_camera=drawn, arms=_nominal_arms(data))
    rows, legs, views = inverse(order.rows), inverse(order.legs), inverse(order.views)
    names = dataset.machine.leg_names
    return Detection(
        dataset=dataset,
        outlines=reject_unused_legs(order.restore(outlines), dataset.measurements, names),
        A_base=scene.A_base[rows][:, legs],
        B_base=scene.B_base[rows][:, legs],
        cylinders=tuple(cylinders[leg] for leg in legs.tolist()),
        arms={
            int(np.flatnonzero(legs == j)[0]): replace(arm, ends=arm.ends[rows])
            for j, arm in scene.arms.items()
        },
        T_base_camera=tuple(scene.T_base_camera[v] for v in views.tolist()),
        rows=images,
        unplaced=unplaced,
        image_notes=tuple(image_notes),
        notes=(*dataset.notes, *image_notes, *notes, *data.unreached_notes()),
        corners=None if board is None else order.restore(board.corners),
    )


def _nominal_arms(data: OrderedDataset) -> dict[int, PlacedArm]:
    """Return the arms that are cylinders, where the model has them at the readings of each row."""
    legs, m = data.machine.legs, data.measurements
    if not data.machine.is_determined or not any(leg.arm is not None for leg in legs):
        return {}
    q = measured_readings(legs, *components(data.T_base_platform), m.q_of_poses)
    return placed_arms(legs, q, m.pose)


def _of_arms(data: OrderedDataset, seen: MeasuredImages, arms: Mapping[int, PlacedArm]) -> Outlines:
    """Return the outlines of arms in images that show the legs, before cameras that are placed."""
    photographs, cameras = seen.photographs, seen.placement.T_base_camera
    rows = [
        row
        for row in photographs.detect.tolist()
        if row not in seen.left_out and cameras[data.measurements.view[row]] is not None
    ]
    some = replace(photographs, detect=np.array(rows, dtype=np.intp), keep=no_outlines())
    placement = replace(seen.placement, arms=arms, window=None)
    found = measure_photographs(some, placement, data.progress, stage="Measuring arms")
    of_arms = found.choose(are_of_arms(found, data.machine.legs))
    return merge_edited(of_arms, photographs.keep)


def _image_notes(data: OrderedDataset, placement: Placement) -> list[str]:
    """Return what is to be said of the cameras and the images."""
    views = data.measurements.views
    hints = [view.T_base_camera for view in views]
    notes = hint_notes([view.name for view in views], hints, placement.T_base_camera, BEFORE_FIT)
    return [*notes, *placement.notes, *image_notes(data.measurements, placement.barely)]


def _gamma_notes(data: OrderedDataset) -> list[str]:
    """Return a note on cameras whose gamma nobody states."""
    views = data.measurements.views
    without_gamma = [view.name for view in views if not view.camera.gamma_is_given]
    if not without_gamma:
        return []
    return [
        f"The gamma of {few_views(without_gamma)} is not given and was taken as 1: outlines of a "
        "camera that encodes light lie off by up to half of the blur; write gamma of the views in "
        "dataset.yaml, or let legcal calibrate estimate it."
    ]
