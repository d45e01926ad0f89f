"""What ``legcal doctor`` and ``legcal detect`` find: the legs in the images, and an examination.

Nothing is fitted: cameras are placed and outlines measured as in the first stage of
:func:`legcal.calibrate`. An examination has the figures, and findings with remedies.
"""

from __future__ import annotations

import hashlib
import json
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from pydantic import Field
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.calibration.board import BoardViews, needs_rough_cameras, rough_placement
from legcal.calibration.diagnosis import Diagnosis
from legcal.calibration.documents import (
    DiagnosisBlock,
    LeftOut,
    Overlay,
    left_out_blocks,
    overlay_blocks,
)
from legcal.calibration.joint_fit.diagnostics import arms_of_other_widths, wrong_arms_in_words
from legcal.calibration.ordered_dataset import OrderedDataset
from legcal.data.corners import Corners, join_corners, write_corners
from legcal.data.dataset import (
    CORNERS_NAME,
    OBSERVATIONS_NAME,
    Dataset,
    ImageReader,
    rows_with_image,
)
from legcal.data.image_tables import inverse
from legcal.data.landmarks import LANDMARKS_NAME, SIGMA_PX, joint_names
from legcal.data.measurements import few_views, image_notes, places, row_names
from legcal.data.outlines import (
    Outlines,
    are_of_arms,
    are_of_bodies,
    format_observations,
    join_outlines,
    merge_edited,
    no_outlines,
    reject_unused_legs,
    write_observations,
)
from legcal.data.reasons import Reason, Rejection, reason_in_words
from legcal.errors import Cause, DatasetError, OutOfResources, UsageError, printable
from legcal.files.folder import OutputKind, check_destination, path_problem, result_folder
from legcal.files.quantity import SHOWN_IN
from legcal.files.schema import MAX_IMAGE, Document, read_bytes, read_json
from legcal.geometry.lines import cross
from legcal.geometry.motions import components
from legcal.geometry.types import Array, IntArray
from legcal.machine.leg import Cylinder
from legcal.machine.picture import draw_machine, joint_letter
from legcal.machine.rods import measured_readings
from legcal.pages.document import (
    MAX_ROWS,
    Cell,
    Items,
    LandmarkEditor,
    Number,
    OutlineEditor,
    Page,
    Picture,
    Row,
    Section,
    Table,
    Text,
    Verdict,
    number,
    page_html,
)
from legcal.perception.diagnostics import BEFORE_FIT, hint_notes, images_left_out
from legcal.perception.free_poses import views_without_rough_camera
from legcal.perception.overlays import (
    OVERLAYS,
    PHOTOGRAPHS,
    Mark,
    PartMarks,
    draw,
    is_overlay,
    marks_of_corners,
    marks_of_image,
)
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
from legcal.progress import Report
from legcal.vision.camera import Camera, spline_pieces
from legcal.vision.visibility import PredictedLeg
from legcal.workers import Run

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
        folders = unique_names(measurements.view_names)
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


def require_images(dataset: Dataset) -> IntArray:
    """Return the rows that have an image file; refuse a dataset without any."""
    rows = rows_with_image(dataset)
    if not len(rows):
        raise DatasetError(
            f"{dataset.table_path}: the images could not be searched: found no image, "
            "needed images of the legs; name them in the table of measurements."
        )
    return rows


def detected(
    data: OrderedDataset,
    images: IntArray,
    to_click: Sequence[str] = (),
    board: BoardViews | None = None,
) -> Detection:
    """Recognise and measure the legs; return the detection in the order of the files.

    Nothing is searched where views have to be clicked first: see :func:`views_to_click`. Boards are
    looked for in the images if they have not been before.
    """
    dataset, order, photographs = data.dataset, data.order, data.photographs
    if to_click:
        scene = nominal_placement(data.machine, data.measurements, data.T_base_platform)
        board, outlines, unplaced = None, no_outlines(), _to_click(data, to_click)
    else:
        scene, board = rough_placement(data, board)
        outlines, unplaced = given_outlines(photographs), dict[str, NotPlaced]()
    cylinders = photographs.cylinders
    notes_on_images, notes = list[str](), list[str]()
    if len(photographs.detect) and not to_click:
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
        clicked = data.measurements.clicked_views
        hints = hint_notes(of_views, cameras, BEFORE_FIT, by_landmarks=clicked)
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


def _to_click(data: OrderedDataset, views: Sequence[str]) -> dict[str, NotPlaced]:
    """Return why no view is searched where some need clicks, by name."""
    no_pose = Cause(
        "its images could not be searched: found no rough camera pose, needed one, since the "
        "motors do not determine the pose of the platform; click its joints at the base "
        f"({LANDMARKS_NAME})."
    )
    no_other_pose = Cause(
        "its images could not be searched: found a rough camera pose here and none of other views, "
        "needed one of every view."
    )
    names = data.dataset.measurements.view_names
    return {name: NotPlaced(name, no_pose if name in views else no_other_pose) for name in names}


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
            of_rows = places(detection.dataset.measurements)
            left_out = left_out_blocks(of_rows, detection.left_out)
            if self.is_written:
                overlays = overlay_blocks(of_rows, detection.overlay_files)
        return ExaminationDocument.describing(
            self,
            legcal_doctor=1,
            ready=self.is_ready,
            usable=self.is_usable,
            images=sum(view.images for view in self.views),
            outlines=sum(view.outlines or 0 for view in self.views),
            used=self.n_used,
            left_out=left_out,
            overlays=overlays,
        ).document()


# The folder: the table of outlines, a page and an overlay of every image
#
# On the page outlines are corrected over the photographs. It contains the written table, the
# intrinsics of the cameras, and the expected positions of missing outlines: such an outline is
# placed there and dragged onto its edge.


DETECTION = OutputKind("detection", "detection.json", "legcal_detection")
JPEG_QUALITY = 88  # percent
DETECTION_PAGE = "index.html"
# Standard deviation of an end placed by hand over an enlarged photograph [px]: the eye finds the
# centre of an edge that is blurred over a pixel or two to about half a pixel.
SIGMA_BY_HAND = 0.5
MAX_BYTES = 8_300_000  # largest size of the outline editor in a page
_ALONG = 12  # points along an edge, which lenses bend
_OF_IMAGE = 250  # bytes in the page for each image
_STATES = {"ok": "ok", "note": "ok", "warning": "look", "error": "wrong"}
_HOW_TO_CORRECT = (
    "Use or reject outlines, and drag their ends, over the photographs; then download the table "
    "and copy it into the dataset, where legcal calibrate takes it. An end that is placed by hand "
    "has the standard deviation that you state. Nothing changes in the files beside this page."
)
_HOW_TO_PLACE = (
    "Where the photographs do not place a camera, click the centres of joints in one picture of "
    "its view; then download the table and copy it into the dataset, where every command begins at "
    "the camera that follows. "
)
_NOT_SERVED = "To see the legs at the camera of the clicks, run legcal detect with --edit."
_TOO_MANY = (
    "There are more outlines than a page should hold. To correct one, edit its row in "
    "observations.csv: set its verdict, or its line (a, b, c) and ends, and its source to edited; "
    "then copy the file into the dataset."
)


def check_detection_destination(destination: Path, dataset: Path | None) -> None:
    """Refuse an output folder of another kind, or with an edited table.

    An edited table may be replaced if a copy is in the dataset folder. Raises UsageError.
    """
    check_destination(destination, DETECTION)
    table = destination / OBSERVATIONS_NAME
    written = _earlier(destination).get("table")
    with suppress(OSError):
        content = read_bytes(table, MAX_IMAGE)
        if written == hashlib.sha256(content).hexdigest():
            return
        if dataset is not None:
            with suppress(OSError):
                if read_bytes(dataset / OBSERVATIONS_NAME, MAX_IMAGE) == content:
                    return
        raise UsageError(
            f"{table}: the detection could not be written: found a table that was changed since "
            "legcal wrote it, needed one to write over; copy it into the dataset, where its edited "
            "rows are kept, or give another output folder; nothing was changed."
        )


def write_detection(
    examination: Examination, detection: Detection, destination: Path, run: Run, progress: Report
) -> None:
    """Write the folder of an examination and its detection atomically.

    Raises UsageError as :func:`check_detection_destination` does, and OutOfResources if the files
    cannot be written.
    """
    dataset = detection.dataset
    check_detection_destination(destination, dataset.folder)
    earlier = _own_files(destination)
    with result_folder(destination, DETECTION, earlier, replaceable=earlier) as folder:
        table = folder / OBSERVATIONS_NAME
        names = dataset.machine.leg_names
        write_observations(table, detection.outlines, dataset.measurements, names)
        if detection.corners is not None:
            write_corners(folder / CORNERS_NAME, detection.corners, dataset.measurements)
        draw_images(detection, folder, run, progress, photographs=True)
        (folder / DETECTION_PAGE).write_text(
            examination_page(examination, detection), encoding="utf-8", newline="\n"
        )
        files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.*"))
        record = {
            "legcal_detection": 1,
            **examination.document(),
            "table": hashlib.sha256(read_bytes(table, MAX_IMAGE)).hexdigest(),
            "files": [*files, DETECTION.marker],
        }
        (folder / DETECTION.marker).write_text(json.dumps(record, indent=1) + "\n", "utf-8")


@dataclass(frozen=True)
class _Drawings:
    """The overlays of all images with their file names, as sent to worker processes."""

    load: ImageReader
    marks: tuple[tuple[PartMarks, ...], ...]
    corners: tuple[tuple[Mark, ...], ...]
    captions: tuple[str, ...]
    names: tuple[str, ...]
    photographs: bool  # whether the images are also written without marks


def draw_images(
    detection: Detection, folder: Path, run: Run, progress: Report, *, photographs: bool = False
) -> None:
    """Write the overlay of every row with an image, and optionally the plain photograph."""
    rows = list(detection.overlay_files)
    files, bare = (
        tuple(folder / file for file in named.values())
        for named in (detection.overlay_files, detection.photograph_files if photographs else {})
    )
    for file in (*files, *bare):
        file.parent.mkdir(parents=True, exist_ok=True)
    corners = join_corners([]) if detection.corners is None else detection.corners
    drawings = _Drawings(
        detection.dataset.image_reader(rows),
        tuple(tuple(_marks(detection, row)) for row in rows),
        tuple(marks_of_corners(corners.choose(corners.row == row)) for row in rows),
        tuple(_caption(detection, row) for row in rows),
        tuple(file.name for file in files),
        photographs,
    )
    progress("Drawing overlays", 0, len(rows))
    pictures = run(partial(_overlay, drawings), range(len(rows)))
    places = zip(files, bare, strict=True) if photographs else zip(files)
    for done, (paths, contents) in enumerate(zip(places, pictures, strict=True), start=1):
        for path, content in zip(paths, contents, strict=True):
            path.write_bytes(content)
        progress("Drawing overlays", done, len(rows))


def _overlay(drawings: _Drawings, k: int) -> list[bytes]:
    """Return the encoded overlay k, and optionally the plain photograph."""
    image = drawings.load(k)
    picture = draw(image, drawings.marks[k], drawings.captions[k], drawings.corners[k])
    grey = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    files = []
    for pixels in (picture, grey)[: 1 + drawings.photographs]:
        ok, content = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        if not ok:
            raise OutOfResources(
                f"{drawings.names[k]}: the picture could not be written: found that it cannot be "
                "encoded, needed enough memory; try again with fewer workers."
            )
        files.append(content.tobytes())
    return files


def _marks(detection: Detection, row: int) -> list[PartMarks]:
    measurements, outlines = detection.dataset.measurements, detection.outlines
    camera = measurements.views[int(measurements.view[row])].camera
    return marks_of_image(
        camera,
        outlines.choose(outlines.row == row),
        detection.predicted(row),
        detection.dataset.machine.leg_names,
    )


def _caption(detection: Detection, row: int) -> str:
    view, outlines = detection.view_of(row), detection.outlines
    measurements = detection.dataset.measurements
    used = outlines.used[(outlines.row == row) & ~are_of_bodies(outlines)]
    state = f"{np.count_nonzero(used)} of {len(used)} outlines used"
    if view in detection.unplaced:
        state = "the camera could not be placed"
        if detection.T_base_camera[int(measurements.view[row])] is not None:
            state += "; legs are where it was expected"
    text = f"{view}  {measurements.image[row]}  {state}"
    return text.encode("ascii", "replace").decode()


def _earlier(destination: Path) -> dict[str, Any]:
    """Return the document of an earlier detection in a folder; empty if there is none."""
    if not DETECTION.is_in(destination):
        return {}
    document: dict[str, Any] = read_json(destination / DETECTION.marker)
    return document


def _own_files(destination: Path) -> list[Path]:
    """Return the files of an earlier detection in a folder, relative to it."""
    tables = OBSERVATIONS_NAME, CORNERS_NAME, DETECTION_PAGE, DETECTION.marker
    named = _earlier(destination).get("files", [])
    names = [name for name in named if isinstance(name, str)] if isinstance(named, list) else []
    return [
        Path(name)
        for name in dict.fromkeys(names)
        if path_problem(destination, name) is None
        and (name in tables or is_overlay(Path(name)) or is_overlay(Path(name), PHOTOGRAPHS))
    ]


# The page


def tables_of(examination: Examination) -> list[Table]:
    """Return the figures of an examination: a line for each check, view and encoder."""
    tables = [
        Table(
            ("check", "", "found"),
            [(check.name, _STATES[check.state], check.found) for check in examination.checks],
            sortable=False,
        ),
        Table(
            ("photographs of", ">images", ">blur [px]", ">clipped [%]", ">JPEG"),
            [
                (
                    view.view,
                    number(view.images, 0),
                    number(view.blur_px, 1),
                    number(None if view.clipped is None else 100.0 * view.clipped, 0),
                    number(view.jpeg_quality, 0),
                )
                for view in examination.views
            ],
        ),
        Table(
            ("view", ">legs", ">outlines used", ">contrast", ">length [px]", ">residual [px]",
             "not used"),
            [
                [
                    view.view,
                    _share(view.legs_found, view.legs_visible),
                    _share(view.outlines_used, view.outlines),
                    number(view.contrast, 1),
                    number(view.length, 0),
                    number(view.residual, 3),
                    "camera not placed" if view.problem else ", ".join(
                        f"{n} {reason_in_words(reason)}" for reason, n in view.rejected.items()
                    ),
                ]
                for view in examination.views
                if view.outlines is not None
            ],
        ),
    ]  # fmt: skip
    units = dict.fromkeys(SHOWN_IN[check.unit][1] for check in examination.encoders)
    rows = list[list[Cell]]()
    for encoder in examination.encoders:
        scale = SHOWN_IN[encoder.unit][0]
        low_high = None if encoder.travel is None else [scale * end for end in encoder.travel]
        rows.append(
            [
                encoder.column,
                number(scale * encoder.least, 3),
                number(scale * encoder.greatest, 3),
                "" if low_high is None else " to ".join(f"{end:z.6g}" for end in low_high),
                number(None if encoder.used is None else 100.0 * encoder.used, 0),
            ]
        )
    heading = f"encoder [{', '.join(units)}]"
    tables.append(Table((heading, ">least", ">greatest", ">travel", ">used [%]"), rows))
    return [table for table in tables if table.rows]


def _share(part: int | None, whole: int | None) -> Cell:
    return Number(part, f"{part}/{whole}")


def examination_page(examination: Examination, detection: Detection, token: str = "") -> str:
    """Return the text of ``index.html``; *token* identifies a page that is served."""
    files, names = detection.overlay_files, row_names(detection.dataset.measurements)
    anchors = unique_names(f"view-{view.view}" for view in examination.views)
    editor = _outline_editor(detection)
    correct = [Text([_TOO_MANY])] if editor is None else [Text([_HOW_TO_CORRECT]), editor]
    checks, *tables = tables_of(examination)
    findings = Items([f"{finding.severity}: {finding.what}" for finding in examination.findings])
    blocks: list[Any] = [checks, findings, *tables]
    sections = [
        Section("found", "What was found", blocks),
        Section("correct", "To correct an outline", correct),
        Section(
            "place",
            "To place a camera",
            [
                Text([_HOW_TO_PLACE + _NOT_SERVED * (not token)]),
                _landmark_editor(detection, token),
            ],
        ),
    ]
    number_of = {row: k for k, row in enumerate(files)}
    place = {} if editor is None else {row: k for k, row in enumerate(files)}
    shown = _worst(detection)
    if len(shown) < len(files):
        few = f"The {len(shown)} of {len(files)} images with the fewest used outlines are shown."
        blocks.append(Text([few]))
    for view, anchor in zip(examination.views, anchors, strict=True):
        rows = [row for row in files if row in shown and detection.view_of(row) == view.view]
        pictures = [
            Picture(
                files[row],
                *_summary(detection, names, row),
                place.get(row),
                number_of[row] if view.problem else None,
            )
            for row in rows
        ]
        problem = [Text([view.problem])] if view.problem else []
        sections.append(Section(anchor, view.view, [*problem, Row(pictures)]))
    title = f"Outlines of {examination.mechanism}"
    return page_html(Page(title, examination.dataset, _verdict(examination), sections))


def _verdict(examination: Examination) -> Verdict:
    if examination.count("error"):
        return Verdict("bad", "Errors", examination.sentence, [])
    if examination.count("warning"):
        return Verdict("doubtful", "Warnings", examination.sentence, [])
    return Verdict("good", "Ready", examination.sentence, [])


def _worst(detection: Detection) -> set[int]:
    """Return the rows of the images on the page: all, or a number with the fewest used outlines."""
    rows = list(detection.overlay_files)
    used = np.bincount(detection.outlines.row[detection.outlines.used], minlength=max(rows) + 1)
    order = np.argsort(used[rows], kind="stable")[:MAX_ROWS].tolist()
    return {rows[k] for k in order}


def _summary(detection: Detection, names: Sequence[str], row: int) -> tuple[str, str]:
    outlines, legs = detection.outlines, detection.dataset.machine.leg_names
    indices = np.flatnonzero(outlines.row == row).tolist()
    used = f"{np.count_nonzero(outlines.used[indices])} of {len(indices)} used"
    rejected: dict[str, list[str]] = {}
    for i in indices:
        rejection = outlines.reason[i]
        if not outlines.used[i] and rejection.reason is not Reason.OUTSIDE:
            name = legs[outlines.leg[i]]
            legs_of_reason = rejected.setdefault(rejection.reason.words, [])
            if name not in legs_of_reason:
                legs_of_reason.append(name)
    reasons = "; ".join(f"{', '.join(legs)}: {rejection}" for rejection, legs in rejected.items())
    return f"{names[row]}: {used}", f"({reasons})" if reasons else ""


def _outline_editor(detection: Detection) -> OutlineEditor | None:
    """Return the editor of outlines; None if the table is too large for a page."""
    measurements, machine = detection.dataset.measurements, detection.dataset.machine
    images = [
        image | {"camera": int(measurements.view[row]), "expected": _expected(detection, row)}
        for row, image in _images(detection).items()
    ]
    cameras = [
        {
            "K": view.camera.K.tolist(),
            "distortion": spline_pieces(view.camera)
            if view.camera.model == "splined_radial"
            else view.camera.distortion.tolist(),
            "model": view.camera.model,
        }
        for view in measurements.views
    ]
    table = format_observations(detection.outlines, measurements, machine.leg_names)
    words = {str(reason): (reason.words, reason.words_of_detail) for reason in Reason}
    editor = OutlineEditor(OBSERVATIONS_NAME, table, images, cameras, SIGMA_BY_HAND, words)
    size = len(editor.packed) + _OF_IMAGE * len(images)
    return editor if size <= MAX_BYTES else None


def _images(detection: Detection) -> dict[int, dict[str, Any]]:
    """Return the photographs for the editors, by row."""
    measurements = detection.dataset.measurements
    names, images = row_names(measurements), dict[int, dict[str, Any]]()
    for row, file in detection.photograph_files.items():
        view = measurements.views[int(measurements.view[row])]
        images[row] = {
            "view": view.name,
            "image": names[row],
            "label": f"{view.name}, {names[row]}",
            "photograph": file,
            "width": view.camera.width,
            "height": view.camera.height,
        }
    return images


def _landmark_editor(detection: Detection, token: str) -> LandmarkEditor:
    """Return the editor of clicks on joints, with the clicks of the dataset."""
    dataset, machine = detection.dataset, detection.dataset.machine
    joints = joint_names(machine.leg_names)
    number_of = {row: k for k, row in enumerate(detection.photograph_files)}
    clicks = []
    if dataset.landmarks is not None:
        place = {joint: i for i, joint in enumerate(joints.values())}
        given = dataset.landmarks
        for (row, leg, end), (u, v), sigma in zip(
            given.row_keys(), given.px.tolist(), given.sigma_px.tolist(), strict=True
        ):
            if row in number_of:
                stated = "" if sigma == SIGMA_PX else f"{sigma:g}"
                clicks.append((number_of[row], place[leg, end], u, v, stated))
    unplaced = [k for row, k in number_of.items() if detection.view_of(row) in detection.unplaced]
    return LandmarkEditor(
        file=LANDMARKS_NAME,
        images=list(_images(detection).values()),
        joints=[
            {"name": name, "label": f"{joint_letter(name.rpartition('.')[2])}{leg + 1}"}
            for name, (leg, _) in joints.items()
        ],
        clicks=clicks,
        drawing=draw_machine(machine, in_page=True).markup(),
        sigma=SIGMA_PX,
        first=min(unplaced, default=0),
        token=token,
    )


def _expected(detection: Detection, row: int) -> dict[str, list[list[float]]]:
    """Return both ends [px] of the missing outlines of an image."""
    measurements, names = detection.dataset.measurements, detection.dataset.machine.leg_names
    outlines = detection.outlines
    here = np.flatnonzero(outlines.row == row)
    is_measured = np.isfinite(outlines.h[here]).all(axis=1) & np.isfinite(outlines.ends[here]).all(
        (1, 2)
    )
    missing = here[~is_measured].tolist()
    if not missing:
        return {}
    camera = measurements.views[int(measurements.view[row])].camera
    legs = {(leg.leg, part.link): leg for leg in detection.predicted(row) for part in leg.segments}
    expected = {}
    for i in missing:
        j, part, edge = int(outlines.leg[i]), outlines.part[i], int(outlines.edge[i])
        leg = legs.get((j, part))
        ends = None if leg is None else _ends(camera, leg, part, edge)
        if ends is not None:
            expected[f"{names[j]}\n{part}\n{edge}"] = np.round(ends, 2).tolist()
    return expected


def _ends(camera: Camera, leg: PredictedLeg, part: str, edge: int, n: int = 2) -> Array | None:
    """Return points (n, 2) of a predicted outline [px], from its end nearer to the base."""
    for i, segment in enumerate(leg.segments):
        if segment.link == part and (xy := leg.points_of(i, edge, n)) is not None:
            h = leg.outlines[i, edge - 1]
            rays = np.column_stack([xy[[0, -1]], np.ones(2)])
            return camera.distort(xy if cross(rays[1], rays[0]) @ h > 0.0 else xy[::-1])
    return None


def edges_seen_from(
    detection: Detection, row: int, T_base_camera: RigidTransform
) -> list[dict[str, Any]]:
    """Return the edges of the legs of an image for a given camera pose: points [px]."""
    measurements, names = detection.dataset.measurements, detection.dataset.machine.leg_names
    v = int(measurements.view[row])
    cameras = list(detection.T_base_camera)
    cameras[v] = T_base_camera
    camera, edges_of_legs = measurements.views[v].camera, []
    for leg in replace(detection, T_base_camera=tuple(cameras)).predicted(row):
        edges = [
            _ends(camera, leg, segment.link, edge, _ALONG)
            for segment in leg.segments
            for edge in (1, 2)
        ]
        shown = [np.round(edge, 2).tolist() for edge in edges if edge is not None]
        edges_of_legs.append({"leg": names[leg.leg], "edges": shown})
    return edges_of_legs
