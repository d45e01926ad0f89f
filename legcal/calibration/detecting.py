"""Detection without a fit: what the images of a dataset show, for people to look at.

The cameras are placed and the outlines measured as :func:`legcal.calibrate` does first. Nothing is
written beside the dataset.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from legcal.calibration.starts import base_of_board, observe_board
from legcal.calibration.workpiece import Workpiece, workpiece
from legcal.data import (
    Dataset,
    Outlines,
    choose_outlines,
    few_views,
    inverse,
    load_dataset,
    reject_unused_legs,
    restore_outlines,
)
from legcal.errors import DatasetError
from legcal.estimation import Choices
from legcal.files import output_path
from legcal.geometry import IntArray
from legcal.machine import Cylinder
from legcal.perception import (
    BEFORE_FIT,
    DETECTION,
    Detection,
    Scene,
    check_detection_destination,
    given_outlines,
    hint_notes,
    observe,
    scene_at_poses,
    write_detection,
)
from legcal.progress import Report, no_progress
from legcal.workers import worker_pool


def detect(
    source: str | Path | Dataset,
    *,
    output: str | Path | None = None,
    progress: Report = no_progress,
    workers: int = 1,
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
    progress : callable
        Called as ``progress(stage, done, total)``.
    workers : int
        Search and draw the images in that many processes, as :func:`legcal.calibrate` does.

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
    rows = _rows_with_image(dataset)
    with worker_pool(workers) as run:
        work = workpiece(dataset, run, None, Choices(), use_cache=False)
        detection = _in_file_order(work, rows, _observed(work, progress))
        if output is not None:
            write_detection(detection, Path(output), run, progress)
    return detection


def _folder(path: Path) -> Path:
    """Return the folder of a dataset that is named by it or by its ``dataset.yaml``."""
    return path if path.is_dir() else path.parent


def _rows_with_image(dataset: Dataset) -> IntArray:
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


@dataclass(frozen=True, eq=False)
class _Observed:
    """What the images show, in the order of work.

    Attributes
    ----------
    outlines : Outlines
        All of them.
    scene : Scene
        Where the images put everything.
    cylinders : tuple, for each leg a tuple of Cylinder
        With the radii that the outlines were searched by.
    unplaced : dict of str
        Why views could not be placed, by name.
    notes : tuple of str
        What else a reader should know.
    """

    outlines: Outlines
    scene: Scene
    cylinders: tuple[tuple[Cylinder, ...], ...]
    unplaced: dict[str, str]
    notes: tuple[str, ...]


def _observed(work: Workpiece, progress: Report) -> _Observed:
    """Return what the images show."""
    photographs = work.photographs
    scene = scene_at_poses(work.mechanism, work.measurements, work.nominal_poses)
    board = observe_board(work, progress)
    if board is not None:
        T_base_board = base_of_board(work, board, scene.T_base_camera)
        if T_base_board is not None:
            cameras = board.cameras(T_base_board, scene.T_base_camera)
            scene = replace(scene, T_base_camera=cameras)
    if len(photographs.detect) == 0:
        return _Observed(given_outlines(photographs), scene, photographs.cylinders, {}, ())
    joined = None if board is None else board.T_board_camera
    observed = observe(photographs, scene, progress, joined)
    placement = observed.placement
    # Legs of a view that could not be placed are drawn where its rough pose has them.
    drawn = tuple(
        T if T is not None else rough
        for T, rough in zip(placement.scene.T_base_camera, scene.T_base_camera, strict=True)
    )
    scene = replace(placement.scene, T_base_camera=drawn)
    placed = np.array([T is not None for T in placement.scene.T_base_camera])
    searched = placed[work.measurements.view[observed.outlines.row]]
    kept = searched | ~np.isin(observed.outlines.row, photographs.detect)
    found = choose_outlines(observed.outlines, kept)
    views = work.measurements.views
    hints = [view.T_base_camera for view in views]
    cameras = placement.scene.T_base_camera
    notes = hint_notes([view.name for view in views], hints, cameras, BEFORE_FIT)
    return _Observed(
        found,
        scene,
        observed.photographs.cylinders,
        placement.unplaced,
        (*notes, *placement.notes, *_untold_gammas(work)),
    )


def _untold_gammas(work: Workpiece) -> list[str]:
    """Return what is to be said of cameras of which nobody told how they encode light."""
    views = [view.name for view in work.measurements.views if not view.camera.gamma_is_told]
    if not views:
        return []
    return [
        f"The gamma of {few_views(views)} is not told and was taken "
        "as 1: outlines of a camera that encodes light lie off by up to half of the blur; write "
        "gamma of the views in dataset.yaml, or let legcal calibrate look for it."
    ]


def _in_file_order(work: Workpiece, images: IntArray, found: _Observed) -> Detection:
    """Return what was found in the order of the files."""
    dataset, order = work.dataset, work.order
    rows, legs, views = inverse(order.rows), inverse(order.legs), inverse(order.views)
    restored, scene = restore_outlines(found.outlines, order), found.scene
    names = dataset.mechanism.leg_names
    return Detection(
        dataset=dataset,
        outlines=reject_unused_legs(restored, dataset.measurements, names),
        A_base=scene.A_base[rows][:, legs],
        B_base=scene.B_base[rows][:, legs],
        cylinders=tuple(found.cylinders[leg] for leg in legs.tolist()),
        T_base_camera=tuple(scene.T_base_camera[v] for v in views.tolist()),
        rows=images,
        unplaced=found.unplaced,
        notes=(*dataset.notes, *found.notes, *work.reached.notes(work.measurements)),
    )
