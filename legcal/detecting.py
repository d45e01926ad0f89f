"""Detection without a fit: what the images of a dataset show, for people to look at.

The cameras are aligned and the outlines measured as :func:`legcal.calibrate` does first. Nothing is
written beside the dataset.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.board_views import BoardViews, base_of_board, board_without_place, observe_board
from legcal.dataset.folder import Dataset, load_dataset
from legcal.detection.observe import Scene, align, given_outlines, scene_at_poses
from legcal.detection.observe import detect as search
from legcal.errors import DatasetError, NotVisible
from legcal.geometry.types import IntArray
from legcal.observations.canonical_order import inverse, restore_outlines
from legcal.observations.outlines import Outlines
from legcal.observations.sets import reject_unused_legs
from legcal.overlays.detected import Detection
from legcal.overlays.folder import DETECTION, check_detection_destination, write_detection
from legcal.progress import Report, no_progress
from legcal.refinement.choices import Choices
from legcal.report.destination import output_path
from legcal.workers import worker_pool
from legcal.workpiece import Workpiece, workpiece


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
        outlines, scene, unplaced = _observed(work, progress)
        detection = _in_file_order(work, rows, outlines, scene, unplaced)
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


def _observed(work: Workpiece, progress: Report) -> tuple[Outlines, Scene, dict[str, str]]:
    """Return all outlines, the scene with aligned cameras, and views without one and why."""
    photographs = work.photographs
    scene = scene_at_poses(work.mechanism, work.measurements, work.nominal_poses)
    board = observe_board(work, progress)
    if board is not None:
        place = base_of_board(work, board, scene.T_base_camera)
        if place is None and len(photographs.detect):
            raise board_without_place(work)
        if place is not None:
            scene = _with_cameras_of(board, scene, place)
    if len(photographs.detect) == 0:
        return given_outlines(photographs), scene, {}
    scene, unplaced = _aligned(work, scene, progress)
    if board is not None and not unplaced:
        place = board.placed(scene.T_base_camera)
        scene = scene if place is None else _with_cameras_of(board, scene, place)
    view_names = [view.name for view in work.measurements.views]
    placed = [
        view_names[v] not in unplaced for v in work.measurements.view[photographs.detect].tolist()
    ]
    photographs = replace(photographs, detect=photographs.detect[np.array(placed, dtype=np.bool_)])
    return search(photographs, scene, progress), scene, unplaced


def _with_cameras_of(board: BoardViews, scene: Scene, T_base_board: RigidTransform) -> Scene:
    """Return a scene whose cameras stand to each other as the board shows them."""
    return replace(scene, T_base_camera=board.cameras(T_base_board, scene.T_base_camera))


def _aligned(work: Workpiece, scene: Scene, progress: Report) -> tuple[Scene, dict[str, str]]:
    """Return the scene with aligned cameras; where that fails, of the views where it does not."""
    photographs = work.photographs
    try:
        return align(photographs, scene, progress), {}
    except NotVisible:
        pass
    unplaced = {}
    view = work.measurements.view[photographs.detect]
    for v in np.unique(view).tolist():
        try:
            scene = align(
                replace(photographs, detect=photographs.detect[view == v]), scene, progress
            )
        except NotVisible as error:
            unplaced[work.measurements.views[v].name] = " ".join(error.problems)
    return scene, unplaced


def _in_file_order(
    work: Workpiece, images: IntArray, outlines: Outlines, scene: Scene, unplaced: dict[str, str]
) -> Detection:
    """Return what was found in the order of the files."""
    dataset, order = work.dataset, work.order
    rows, legs, views = inverse(order.rows), inverse(order.legs), inverse(order.views)
    restored = restore_outlines(outlines, order)
    names = dataset.mechanism.leg_names
    return Detection(
        dataset=dataset,
        outlines=reject_unused_legs(restored, dataset.measurements, names),
        A_base=scene.A_base[rows][:, legs],
        B_base=scene.B_base[rows][:, legs],
        T_base_camera=tuple(scene.T_base_camera[v] for v in views.tolist()),
        rows=images,
        unplaced=unplaced,
        notes=(*dataset.notes, *work.reached.notes(work.measurements)),
    )
