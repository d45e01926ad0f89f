"""What ``legcal doctor`` and ``legcal detect`` find: the legs in the images, and an examination.

Nothing is fitted: cameras are placed and outlines measured as in the first stage of
:func:`legcal.calibrate`. An examination has the figures, and findings with remedies.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.calibration.board import needs_rough_cameras, rough_placement
from legcal.calibration.diagnosis.diagnosis import Diagnosis
from legcal.calibration.documents import DiagnosisBlock, LeftOut, Overlay, left_out_blocks
from legcal.calibration.joint_fit.diagnostics import arms_of_other_widths, wrong_arms_in_words
from legcal.calibration.ordered_dataset import OrderedDataset
from legcal.causes import Cause
from legcal.data.corners import Corners
from legcal.data.dataset import Dataset
from legcal.data.image_tables import inverse
from legcal.data.landmarks import LANDMARKS_NAME
from legcal.data.measurements import few_views, image_notes, row_names
from legcal.data.outlines import (
    Outlines,
    are_of_arms,
    join_outlines,
    merge_edited,
    no_outlines,
    reject_unused_legs,
)
from legcal.data.reasons import Reason, Rejection
from legcal.errors import DatasetError, printable
from legcal.files.schema import Document
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
    placed_arms,
    predict_legs_and_arms,
)
from legcal.vision.visibility import PredictedLeg

OVERLAYS, PHOTOGRAPHS = "overlays", "photographs"  # the subfolders of pictures
_UNSAFE = re.compile(r"[^A-Za-z0-9_.-]+")  # characters not allowed in file names
_MAX_NAME = 80  # largest length of a file name
Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
CHECKS = ("files", "readings", "camera", "photographs", "legs", "parameters", "mistakes")


@brief
@dataclass(frozen=True, eq=False)
class Detection:
    """Legs detected in the images of a dataset, in the order of the files."""

    dataset: Dataset  # the searched dataset
    outlines: Outlines  # all outlines: detected, given and edited
    # A_base, B_base: (n_rows, n_legs, 3): joint centres at every row as used for the view, in the
    # base link [m]
    A_base: Array
    B_base: Array
    # visible parts of the legs, with the radii used in the search
    cylinders: Sequence[Sequence[Cylinder]]
    # the camera of every view; None if it is unknown
    T_base_camera: tuple[RigidTransform | None, ...]
    rows: IntArray  # (n,): the rows that have an image
    # reasons why cameras could not be placed, by name of the view; these cameras keep their
    # expected pose, and only given outlines of their views are included
    unplaced: dict[str, NotPlaced]
    image_notes: tuple[str, ...]  # warnings about images, views and radii
    leg_notes: tuple[str, ...]  # remarks on the search for the legs
    # the corners of calibration boards in all images; None without a board
    corners: Corners | None = None
    # expected arms with visible cylinders, by the leg that has them as parts
    arms: Mapping[int, PlacedArm] = field(default_factory=dict)

    @property
    def notes(self) -> tuple[str, ...]:
        """All warnings and remarks, including those on the dataset."""
        return (*self.dataset.notes, *self.image_notes, *self.leg_notes)

    def view_of(self, row: int) -> str:
        """Return the name of the view of a row."""
        measurements = self.dataset.measurements
        return measurements.views[int(measurements.view[row])].name

    def predicted(self, row: int) -> list[PredictedLeg]:
        """Return the predicted legs in the image of a row; none if the camera is unknown.

        Arms follow as further entries of the legs that have them as parts.
        """
        measurements, legs = self.dataset.measurements, self.dataset.machine.legs
        view = measurements.views[measurements.view[row]]
        T = self.T_base_camera[int(measurements.view[row])]
        if T is None:
            return []
        ends, owner = (self.A_base, self.B_base), [*range(len(legs)), *self.arms]
        legs_and_arms = predict_legs_and_arms(view.camera, T, ends, self.cylinders, self.arms, row)
        with_owner = [replace(leg, leg=owner[leg.leg]) for leg in legs_and_arms]
        return [leg for leg in with_owner if view.uses(legs[leg.leg].name)]

    @cached_property
    def left_out(self) -> dict[int, Rejection]:
        """Reasons why images with expected outlines have no used one, by row."""
        of_views = [row for row in self.rows.tolist() if self.view_of(row) in self.unplaced]
        return images_left_out(self.outlines) | dict.fromkeys(
            of_views, Rejection(Reason.NOT_PLACED)
        )

    @cached_property
    def overlay_files(self) -> dict[int, str]:
        """The overlay of each row, relative to the folder: by view and image."""
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
        """The photograph of each row as searched, relative to the folder."""
        return {
            row: file.replace(OVERLAYS, PHOTOGRAPHS, 1) for row, file in self.overlay_files.items()
        }


def unique_names(names: Iterable[str]) -> list[str]:
    """Return file names that are distinct on every file system."""
    unique: list[str] = []
    taken: set[str] = set()
    for name in names:
        plain = _UNSAFE.sub("_", name).lstrip(".")[:_MAX_NAME] or "_"
        k, chosen = 1, plain
        while chosen.lower() in taken:
            k += 1
            chosen = f"{plain}-{k}"
        taken.add(chosen.lower())
        unique.append(chosen)
    return unique


def rows_with_image(dataset: Dataset) -> IntArray:
    """Return the rows that have an image file."""
    paths = [dataset.image_path(row) for row in range(dataset.measurements.n_rows)]
    rows = [row for row, path in enumerate(paths) if path is not None and os.path.exists(path)]
    return np.array(rows, dtype=np.intp)


def require_images(dataset: Dataset) -> IntArray:
    """Return the rows that have an image file; refuse a dataset without any."""
    rows = rows_with_image(dataset)
    if not len(rows):
        raise DatasetError(
            f"{dataset.table_path}: the images could not be searched: found no image, "
            "needed images of the legs; name them in the table of measurements."
        )
    return rows


def detected(data: OrderedDataset, images: IntArray) -> Detection:
    """Recognise and measure the legs; return the detection in the order of the files."""
    dataset, order, photographs = data.dataset, data.order, data.photographs
    scene, board = rough_placement(data)
    outlines, cylinders = given_outlines(photographs), photographs.cylinders
    unplaced = dict[str, NotPlaced]()
    notes_on_images, notes = list[str](), list[str]()
    if len(photographs.detect):
        T_board_camera = None if board is None else board.T_board_camera
        measured = place_and_measure(photographs, scene, data.progress, T_board_camera)
        cameras, cylinders = measured.placement.T_base_camera, measured.photographs.cylinders
        placed = np.array([T is not None for T in cameras])
        row = measured.outlines.row
        is_kept = placed[data.measurements.view[row]] | ~np.isin(row, photographs.detect)
        outlines, unplaced = measured.outlines.choose(is_kept), measured.placement.unplaced
        arms = _nominal_arms(data)
        if arms:
            outlines = join_outlines([outlines, _of_arms(data, measured, arms)])
        of_views = data.measurements.views
        hints = hint_notes(
            [view.name for view in of_views],
            [view.T_base_camera for view in of_views],
            cameras,
            BEFORE_FIT,
            by_landmarks=data.measurements.clicked_views,
        )
        barely = image_notes(data.measurements, measured.placement.barely)
        notes_on_images = [*hints, *measured.placement.notes, *barely]
        if without_gamma := [v.name for v in of_views if not v.camera.gamma_is_given]:
            notes.append(
                f"The gamma of {few_views(without_gamma)} is not given and was taken as 1: "
                "outlines of a camera that encodes light lie off by up to half of the blur; write "
                "gamma of the views in dataset.yaml, or let legcal calibrate estimate it."
            )
        if wrong_arms := arms_of_other_widths(outlines, are_of_arms(outlines, data.machine.legs)):
            description = wrong_arms_in_words(wrong_arms, data.machine.legs)
            notes.append(f"Arms do not look as the model draws them: {description}")
        # Legs of a view that could not be placed are drawn by its rough pose.
        drawn = tuple(
            T if T is not None else rough
            for T, rough in zip(cameras, scene.T_base_camera, strict=True)
        )
        scene = replace(measured.placement, T_base_camera=drawn, arms=arms)
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
        image_notes=tuple(notes_on_images),
        leg_notes=(*notes, *data.unreached_notes()),
        corners=None if board is None else order.restore(board.corners),
    )


def views_to_click(data: OrderedDataset) -> list[str]:
    """Return the views that need clicks or rough poses before they can be searched."""
    if not needs_rough_cameras(data):
        return []
    m, rows = data.measurements, data.photographs.detect.tolist()
    return views_without_rough_camera(m, rows, [view.T_base_camera for view in m.views])


def unsearched(data: OrderedDataset, images: IntArray, views: Sequence[str]) -> Detection:
    """Return a detection without outlines, for clicking, in file order."""
    nominal = nominal_placement(data.machine, data.measurements, data.T_base_platform)
    rows, legs = inverse(data.order.rows), inverse(data.order.legs)
    no_pose = Cause(
        "its images could not be searched: found no rough camera pose, needed one, since the "
        "motors do not determine the pose of the platform; click its joints at the base "
        f"({LANDMARKS_NAME})."
    )
    no_other_pose = Cause(
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
            view.name: NotPlaced(view.name, no_pose if view.name in views else no_other_pose)
            for view in dataset.measurements.views
        },
        image_notes=(),
        leg_notes=(),
    )


def _nominal_arms(data: OrderedDataset) -> dict[int, PlacedArm]:
    """Return the arms with cylinders by the nominal model at the readings of each row."""
    legs, m = data.machine.legs, data.measurements
    if not data.machine.is_determined or not any(leg.arm is not None for leg in legs):
        return {}
    q = measured_readings(legs, *components(data.T_base_platform), m.q_of_poses)
    return placed_arms(legs, q, m.pose)


def _of_arms(
    data: OrderedDataset, measured: MeasuredImages, arms: Mapping[int, PlacedArm]
) -> Outlines:
    """Return the outlines of arms in images with recognised legs and placed cameras."""
    photographs, cameras = measured.photographs, measured.placement.T_base_camera
    rows = [
        row
        for row in photographs.detect.tolist()
        if row not in measured.left_out and cameras[data.measurements.view[row]] is not None
    ]
    photographs_of_arms = replace(
        photographs, detect=np.array(rows, dtype=np.intp), keep=no_outlines()
    )
    placement = replace(measured.placement, arms=arms, window=None)
    outlines = measure_photographs(
        photographs_of_arms, placement, data.progress, stage="Measuring arms"
    )
    of_arms = outlines.choose(are_of_arms(outlines, data.machine.legs))
    return merge_edited(of_arms, photographs.keep)


# The examination


class Finding(Document):
    """A problem or remark about the dataset."""

    check: str  # one of CHECKS
    severity: Severity  # an error prevents calibration, a warning makes the result worse
    what: str  # one sentence, with the remedy
    images: tuple[str, ...] = ()  # affected images


class EncoderUse(Document):
    """The range of the readings of an encoder."""

    column: str
    unit: Literal["m", "rad"]  # unit of the following values
    least: float
    greatest: float
    travel: tuple[float, float] | None  # None if the model has no limits
    used: float | None  # share of the travel


class ViewCondition(Document):
    """Condition of the photographs of a view, and the outlines in them.

    Legs are counted in each image in which they are visible: neither outside nor hidden. A leg is
    found if one of its outlines is used. Fields of outlines are None if none were searched.
    """

    view: str
    images: int
    camera: str  # camera file
    blur_px: float | None  # median blur of sharp edges; None without any
    clipped: float | None  # median share of saturated pixels
    jpeg_quality: int | None  # lowest quality; None for lossless files
    legs_found: int | None = None  # number in all images
    legs_visible: int | None = None
    outlines: int | None = None
    outlines_used: int | None = None
    edited: int | None = None
    contrast: float | None = None  # median of the used outlines [grey levels]
    length: float | None = None  # median of the used outlines [px]
    residual: float | None = None  # median of the used outlines [px]
    rejected: dict[str, int] = Field(default_factory=dict)  # by code of the reason, most first
    problem: str | None = None  # reason why the camera could not be placed


class CheckState(Document):
    """Summary of a check and the severity of its worst finding."""

    name: str
    state: Severity | Literal["ok"]
    found: str


class ExaminationDocument(Document):
    """The output of ``legcal doctor --json`` and ``legcal detect --json``."""

    legcal_doctor: int
    dataset: str
    mechanism: str
    ready: bool
    usable: bool
    checks: list[CheckState]
    findings: list[Finding]
    encoders: list[EncoderUse]
    views: list[ViewCondition]
    images: int
    outlines: int
    used: int
    left_out: list[LeftOut]
    overlays: list[Overlay]  # files relative to the output folder
    diagnosis: list[DiagnosisBlock]


@brief
@dataclass(frozen=True, eq=False)
class Examination:
    """The result of :func:`legcal.doctor`."""

    dataset: str  # dataset, mechanism: folder of the dataset and name of the machine
    mechanism: str
    checks: tuple[CheckState, ...]  # summaries of the checks that could be made
    findings: tuple[Finding, ...]  # findings, the most severe first
    encoders: tuple[EncoderUse, ...]  # range of the readings of each encoder
    views: tuple[ViewCondition, ...]  # condition of the photographs of each view
    # mistakes that explain contradicting images, the likeliest first
    diagnosis: tuple[Diagnosis, ...]
    is_usable: bool  # whether all files can be used
    # the outlines of the legs in the images; None if the images could not be searched
    detection: Detection | None = None
    is_written: bool = False  # whether the outlines were written with pictures and a page

    def count(self, severity: Severity) -> int:
        """Return the number of findings of a severity."""
        return sum(finding.severity == severity for finding in self.findings)

    @property
    def n_used(self) -> int:
        """Number of usable outlines."""
        return sum(view.outlines_used or 0 for view in self.views)

    @property
    def is_ready(self) -> bool:
        """Whether there are no errors."""
        return not self.count("error")

    @property
    def sentence(self) -> str:
        """The verdict with the next command."""
        n_errors, n_warnings = self.count("error"), self.count("warning")
        warnings = f", {n_warnings} warning{'s' * (n_warnings != 1)}" * (n_warnings > 0)
        if n_errors:
            return f"{n_errors} error{'s' * (n_errors != 1)} to fix before calibrating{warnings}."
        folder = shlex.quote(printable(self.dataset))
        return f"Ready to calibrate{warnings}: legcal calibrate {folder} -o OUT"

    def document(self) -> dict[str, Any]:
        """Return the output of ``legcal doctor --json``."""
        detection, overlays, left_out = self.detection, list[Overlay](), list[LeftOut]()
        if detection is not None:
            m = detection.dataset.measurements
            names, left_out = row_names(m), left_out_blocks(m, detection.left_out)
            files = detection.overlay_files if self.is_written else {}
            overlays = [
                Overlay(view=detection.view_of(row), image=names[row], file=file)
                for row, file in files.items()
            ]
        return ExaminationDocument(
            legcal_doctor=1,
            dataset=self.dataset,
            mechanism=self.mechanism,
            ready=self.is_ready,
            usable=self.is_usable,
            checks=list(self.checks),
            findings=list(self.findings),
            encoders=list(self.encoders),
            views=list(self.views),
            images=sum(view.images for view in self.views),
            outlines=sum(view.outlines or 0 for view in self.views),
            used=self.n_used,
            left_out=left_out,
            overlays=overlays,
            diagnosis=[diagnosis.document() for diagnosis in self.diagnosis],
        ).document()
