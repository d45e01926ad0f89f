"""What the images of a dataset show, before any fit.

The cameras are placed and the outlines measured as :func:`legcal.calibrate` does first.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.calibration.board import needs_rough_cameras, rough_placement
from legcal.calibration.joint_fit.diagnostics import arms_of_other_widths, wrong_arms_in_words
from legcal.calibration.ordered_dataset import OrderedDataset
from legcal.causes import Cause
from legcal.data.corners import Corners
from legcal.data.dataset import Dataset
from legcal.data.image_causes import image_notes
from legcal.data.image_tables import inverse
from legcal.data.landmarks import LANDMARKS_NAME
from legcal.data.measurements import few_views
from legcal.data.outlines import (
    Outlines,
    are_of_arms,
    join_outlines,
    merge_edited,
    no_outlines,
    reject_unused_legs,
)
from legcal.data.reasons import Reason, Rejection
from legcal.errors import DatasetError
from legcal.geometry.motions import components
from legcal.geometry.types import Array, IntArray
from legcal.machine.leg import Cylinder
from legcal.machine.rods import measured_readings
from legcal.perception.diagnostics import BEFORE_FIT, hint_notes, images_left_out
from legcal.perception.free_poses import views_without_rough_camera
from legcal.perception.photographs import (
    MeasuredImages,
    given_outlines,
    measure_photographs,
    nominal_placement,
    place_and_measure,
)
from legcal.perception.placement import (
    NotPlaced,
    PlacedArm,
    Placement,
    placed_arms,
    predict_legs_and_arms,
)
from legcal.vision.visibility import PredictedLeg

OVERLAYS, PHOTOGRAPHS = "overlays", "photographs"  # the subfolders of pictures
_UNSAFE = re.compile(r"[^A-Za-z0-9_.-]+")  # in names of files
_MAX_NAME = 80  # letters of such a name


@brief
@dataclass(frozen=True, eq=False)
class Detection:
    """What the images of a dataset show of the legs, in the order of the files.

    Attributes
    ----------
    dataset : Dataset
        What was searched.
    outlines : Outlines
        All outlines: detected, given and edited.
    A_base, B_base : (n_rows, n_legs, 3) array
        Joint centres at every row, where each view sees them, in the base link [m].
    cylinders : sequence, for each leg a sequence of Cylinder
        What can be seen of the legs, with the radii that outlines were searched by.
    T_base_camera : tuple of RigidTransform or None
        The camera of every view; None where nothing is known of it.
    rows : (n,) array of int
        The rows that have an image.
    unplaced : dict
        Why the cameras of some views could not be placed, by name of the view; they are left where
        they were expected, and no outline of theirs is here but those that were given.
    image_notes : tuple of str
        What is odd about images, views and radii.
    leg_notes : tuple of str
        What else a reader should know of the search for the legs.
    corners : Corners or None
        The corners of calibration boards in all images; None without a board.
    arms : mapping
        Where arms that are cylinders are expected, by the legs that have them as parts.
    """

    dataset: Dataset
    outlines: Outlines
    A_base: Array
    B_base: Array
    cylinders: Sequence[Sequence[Cylinder]]
    T_base_camera: tuple[RigidTransform | None, ...]
    rows: IntArray
    unplaced: dict[str, NotPlaced]
    image_notes: tuple[str, ...]
    leg_notes: tuple[str, ...]
    corners: Corners | None = None
    arms: Mapping[int, PlacedArm] = field(default_factory=dict)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader should know, also of the dataset."""
        return (*self.dataset.notes, *self.image_notes, *self.leg_notes)

    def view_of(self, row: int) -> str:
        """Return the name of the view of a row."""
        measurements = self.dataset.measurements
        return measurements.views[int(measurements.view[row])].name

    def predicted(self, row: int) -> list[PredictedLeg]:
        """Return where the legs of a row should be seen; none where the camera is not known.

        Arms come after them, each as another one of the leg that has it as a part.
        """
        measurements, legs = self.dataset.measurements, self.dataset.machine.legs
        view = measurements.views[measurements.view[row]]
        T = self.T_base_camera[int(measurements.view[row])]
        if T is None:
            return []
        ends, owner = (self.A_base, self.B_base), [*range(len(legs)), *self.arms]
        found = predict_legs_and_arms(view.camera, T, ends, self.cylinders, self.arms, row)
        every = [replace(leg, leg=owner[leg.leg]) for leg in found]
        return [leg for leg in every if view.uses(legs[leg.leg].name)]

    @cached_property
    def left_out(self) -> dict[int, Rejection]:
        """Why no outline of images is used that should show some, by row."""
        of_views = [row for row in self.rows.tolist() if self.view_of(row) in self.unplaced]
        return images_left_out(self.outlines) | dict.fromkeys(
            of_views, Rejection(Reason.NOT_PLACED)
        )

    @cached_property
    def overlay_files(self) -> dict[int, str]:
        """The file of each row's overlay, relative to the folder: by view and image."""
        measurements = self.dataset.measurements
        folders = unique_names(view.name for view in measurements.views)
        files: dict[int, str] = {}
        for v, folder in enumerate(folders):
            rows = [row for row in self.rows.tolist() if measurements.view[row] == v]
            images = [measurements.image[row] for row in rows]
            stems = [Path(image).stem for image in images]
            if len({stem.lower() for stem in stems}) < len(stems):
                stems = images
            for row, stem in zip(rows, unique_names(stems), strict=True):
                files[row] = f"{OVERLAYS}/{folder}/{stem}.jpg"
        return files

    @property
    def photograph_files(self) -> dict[int, str]:
        """The file of each row's photograph as it was searched, relative to the folder."""
        return {
            row: file.replace(OVERLAYS, PHOTOGRAPHS, 1) for row, file in self.overlay_files.items()
        }


def unique_names(names: Iterable[str]) -> list[str]:
    """Return names of files that are distinct on every file system."""
    found: list[str] = []
    taken: set[str] = set()
    for name in names:
        plain = _UNSAFE.sub("_", name).lstrip(".")[:_MAX_NAME] or "_"
        k, chosen = 1, plain
        while chosen.lower() in taken:
            k += 1
            chosen = f"{plain}-{k}"
        taken.add(chosen.lower())
        found.append(chosen)
    return found


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
    unplaced = dict[str, NotPlaced]()
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
        leg_notes=(*notes, *data.unreached_notes()),
        corners=None if board is None else order.restore(board.corners),
    )


def views_to_click(data: OrderedDataset) -> list[str]:
    """Return the views that cannot be searched before clicks, or other rough poses, place them."""
    if not needs_rough_cameras(data):
        return []
    m, rows = data.measurements, data.photographs.detect.tolist()
    return views_without_rough_camera(m, rows, [view.T_base_camera for view in m.views])


def unsearched(data: OrderedDataset, images: IntArray, views: Sequence[str]) -> Detection:
    """Return the images of a dataset that cannot be searched, to be clicked, in file order."""
    nominal = nominal_placement(data.machine, data.measurements, data.T_base_platform)
    rows, legs = inverse(data.order.rows), inverse(data.order.legs)
    why = Cause(
        "its images could not be searched: found no rough camera pose, needed one, since the "
        "motors do not determine the pose of the platform; click its joints at the base "
        f"({LANDMARKS_NAME})."
    )
    others = Cause(
        "its images could not be searched: found a rough camera pose here and none of other views, "
        "needed one of every view."
    )
    dataset = data.dataset
    return Detection(
        dataset=dataset,
        outlines=no_outlines(),
        A_base=nominal.A_base[rows][:, legs],
        B_base=nominal.B_base[rows][:, legs],
        cylinders=tuple(leg.cylinders for leg in dataset.machine.legs),
        T_base_camera=tuple(view.T_base_camera for view in dataset.measurements.views),
        rows=images,
        unplaced={
            view.name: NotPlaced(view.name, why if view.name in views else others)
            for view in dataset.measurements.views
        },
        image_notes=(),
        leg_notes=(),
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
    notes = hint_notes(
        [view.name for view in views],
        hints,
        placement.T_base_camera,
        BEFORE_FIT,
        by_landmarks=data.measurements.clicked_views,
    )
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
