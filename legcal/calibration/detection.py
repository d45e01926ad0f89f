"""The result of ``legcal detect``: figures of every view, and the folder that people look at.

:class:`Detection` has all outlines and its document; :func:`write_detection` writes the folder with
the table of outlines, a page (HTML) and an overlay of every image.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.calibration.documents import LeftOut, Overlay, left_out_blocks
from legcal.calibration.outline_editor import outline_editor
from legcal.data.corners import Corners, write_corners
from legcal.data.dataset import CORNERS_NAME, OBSERVATIONS_NAME, Dataset, ImageReader
from legcal.data.measurements import row_names
from legcal.data.outlines import Outlines, along_legs, is_edited, write_observations
from legcal.data.reasons import Reason, Rejection, reason_in_words
from legcal.errors import OutOfResources, UsageError
from legcal.files.folder import OutputKind, check_destination, path_problem, result_folder
from legcal.files.reading import MAX_IMAGE, read_bytes, read_json
from legcal.files.schema import Document
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import Cylinder
from legcal.pages.document import (
    MAX_ROWS,
    Cell,
    Link,
    Page,
    Picture,
    Row,
    Section,
    Table,
    Text,
    number,
)
from legcal.pages.html import page_html
from legcal.perception.diagnostics import images_left_out, is_out_of_sight
from legcal.perception.overlays import (
    Mark,
    PartMarks,
    draw,
    marks_of_corners,
    marks_of_image,
    marks_of_pairs,
)
from legcal.perception.placement import PlacedArm, predict_legs_and_arms
from legcal.progress import Report
from legcal.vision.camera import Camera
from legcal.vision.visibility import PredictedLeg
from legcal.workers import Run

DETECTION = OutputKind("detection", "detection.json", "legcal_detection")
DETECTION_PAGE = "index.html"
OVERLAYS, PHOTOGRAPHS = "overlays", "photographs"  # the subfolders
JPEG_QUALITY = 88  # percent
_UNSAFE = re.compile(r"[^A-Za-z0-9_.-]+")  # in names of files
_MAX_NAME = 80  # letters of such a name
_TABLE_HEADINGS = ("view", ">images", ">legs found", ">of visible", ">outlines used", ">of",
                   ">contrast", ">length [px]", ">residual [px]", "rejected")  # fmt: skip
_HOW_TO_CORRECT = (
    "Use or reject outlines, and drag their ends, over the photographs; then download the table "
    "and copy it into the dataset, where legcal calibrate takes it. An end that is placed by hand "
    "has the standard deviation that you state. Nothing changes in the files beside this page."
)
_TOO_MANY = (
    "There are more outlines than a page should hold. To correct one, edit its row in "
    "observations.csv: set its verdict, or its line (a, b, c) and ends, and its source to edited; "
    "then copy the file into the dataset."
)


@brief
@dataclass(frozen=True, eq=False)
class Detection:
    """The result of :func:`legcal.detect`, in the order of the files.

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
    notes : tuple of str
        These, and what else a reader should know.
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
    unplaced: dict[str, str]
    image_notes: tuple[str, ...]
    notes: tuple[str, ...]
    corners: Corners | None = None
    arms: Mapping[int, PlacedArm] = field(default_factory=dict)

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
        folders = _unique_names(view.name for view in measurements.views)
        files: dict[int, str] = {}
        for v, folder in enumerate(folders):
            rows = [row for row in self.rows.tolist() if measurements.view[row] == v]
            images = [measurements.image[row] for row in rows]
            stems = [Path(image).stem for image in images]
            if len({stem.lower() for stem in stems}) < len(stems):
                stems = images
            for row, stem in zip(rows, _unique_names(stems), strict=True):
                files[row] = f"{OVERLAYS}/{folder}/{stem}.jpg"
        return files

    @property
    def photograph_files(self) -> dict[int, str]:
        """The file of each row's photograph as it was searched, relative to the folder."""
        return {
            row: file.replace(OVERLAYS, PHOTOGRAPHS, 1) for row, file in self.overlay_files.items()
        }

    @cached_property
    def document(self) -> dict[str, Any]:
        """What ``--json`` prints; files are relative to the folder."""
        names = row_names(self.dataset.measurements)
        return DetectionDocument(
            legcal_detection=1,
            mechanism=self.dataset.machine.name,
            views=_view_figures(self),
            images=len(self.rows),
            outlines=len(self.outlines),
            used=int(np.count_nonzero(self.outlines.used)),
            overlays=[
                Overlay(view=self.view_of(row), image=names[row], file=file)
                for row, file in self.overlay_files.items()
            ],
            notes=list(self.notes),
            left_out=left_out_blocks(self.dataset.measurements, self.left_out),
        ).document()


def _unique_names(names: Iterable[str]) -> list[str]:
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


class ViewFigures(Document):
    """What was found in the images of a view."""

    images: int
    legs_visible: int
    legs_found: int
    outlines: int
    used: int
    edited: int
    contrast: float | None  # median of the used outlines, as the next ones [grey levels]
    length: float | None  # [px]
    residual: float | None  # [px]
    rejected: dict[str, int]  # by the code of the reason, the most first
    problem: str | None  # why its camera could not be placed


class DetectionDocument(Document):
    """What ``legcal detect --json`` prints."""

    legcal_detection: int
    mechanism: str
    views: dict[str, ViewFigures]
    images: int
    outlines: int
    used: int
    overlays: list[Overlay]
    notes: list[str]
    left_out: list[LeftOut]


def _view_figures(detection: Detection) -> dict[str, ViewFigures]:
    """Return the figures of every view that has images or outlines.

    Legs are counted in each image that should show them: neither outside nor hidden. They are found
    where one of their outlines is used.
    """
    measurements = detection.dataset.measurements
    found = {}
    for v in np.unique(measurements.view).tolist():
        name = measurements.views[v].name
        here = measurements.view[detection.outlines.row] == v
        outlines = detection.outlines.choose(here)
        used = outlines.used
        rods = along_legs(outlines, detection.dataset.machine.legs)
        rejected = Counter(
            str(why.reason) for why, ok in zip(outlines.reason, used, strict=True) if not ok
        )
        found[name] = ViewFigures(
            images=int(np.count_nonzero(measurements.view[detection.rows] == v)),
            legs_visible=_count_legs(rods, ~is_out_of_sight(rods) | rods.used),
            legs_found=_count_legs(rods, rods.used),
            outlines=len(outlines),
            used=int(np.count_nonzero(used)),
            edited=int(np.count_nonzero(is_edited(outlines))),
            contrast=_median(outlines.contrast[used]),
            length=_median(outlines.length[used]),
            residual=_median(outlines.residual[used]),
            rejected=dict(rejected.most_common()),
            problem=detection.unplaced.get(name) or None,
        )
    return found


def _count_legs(outlines: Outlines, chosen: BoolArray) -> int:
    """Return how many legs in images have one of the chosen outlines."""
    return len(set(zip(outlines.row[chosen].tolist(), outlines.leg[chosen].tolist(), strict=True)))


def _median(values: Array) -> float | None:
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else None


def _page(detection: Detection) -> str:
    """Return the text of ``index.html``."""
    document, files = detection.document, detection.overlay_files
    views, names = document["views"], row_names(detection.dataset.measurements)
    anchors = dict(zip(views, _unique_names(f"view-{view}" for view in views), strict=True))
    found = (
        f"{document['used']} of {document['outlines']} outlines in {document['images']} images are "
        "used."
    )
    table = Table(_TABLE_HEADINGS, [_cells(name, views[name], to) for name, to in anchors.items()])
    dataset, photographs = detection.dataset, detection.photograph_files
    editor = outline_editor(dataset, detection.outlines, detection.predicted, photographs)
    correct = [Text([_TOO_MANY])] if editor is None else [Text([_HOW_TO_CORRECT]), editor]
    sections = [
        Section("found", "What was found", [table, *(Text([n]) for n in document["notes"])]),
        Section("correct", "To correct an outline", correct),
    ]
    place = {} if editor is None else {row: k for k, row in enumerate(files)}
    shown = _worst(detection)
    if len(shown) < len(files):
        few = f"The {len(shown)} of {len(files)} images with the fewest used outlines are shown."
        sections[0] = replace(sections[0], blocks=[*sections[0].blocks, Text([few])])
    for view, figures in views.items():
        rows = [row for row in files if row in shown and detection.view_of(row) == view]
        pictures = [
            Picture(files[row], *_summary(detection, names, row), place.get(row)) for row in rows
        ]
        problem = [Text([figures["problem"]])] if figures["problem"] else []
        sections.append(Section(anchors[view], view, [*problem, Row(pictures)]))
    return page_html(Page(f"Outlines of {detection.dataset.machine.name}", found, None, sections))


def _worst(detection: Detection) -> set[int]:
    """Return the rows whose images a page shows: all, or those with the fewest used outlines."""
    rows = list(detection.overlay_files)
    used = np.bincount(detection.outlines.row[detection.outlines.used], minlength=max(rows) + 1)
    order = np.argsort(used[rows], kind="stable")[:MAX_ROWS].tolist()
    return {rows[k] for k in order}


def _cells(name: str, view: Mapping[str, Any], to: str) -> list[Cell]:
    """Return the figures of a view as cells of the table."""
    rejected = ", ".join(f"{n} {reason_in_words(why)}" for why, n in view["rejected"].items())
    return [
        Link(name, f"#{to}"),
        *(
            number(view[key], digits)
            for key, digits in (
                ("images", 0), ("legs_found", 0), ("legs_visible", 0), ("used", 0),
                ("outlines", 0), ("contrast", 1), ("length", 0), ("residual", 3),
            )
        ),
        "camera not placed" if view["problem"] else rejected,
    ]  # fmt: skip


def _summary(detection: Detection, names: Sequence[str], row: int) -> tuple[str, str]:
    """Return what was found in the image of a row, and why legs are rejected."""
    outlines, legs = detection.outlines, detection.dataset.machine.leg_names
    here = np.flatnonzero(outlines.row == row).tolist()
    used = f"{np.count_nonzero(outlines.used[here])} of {len(here)} used"
    rejected: dict[str, list[str]] = {}
    for i in here:
        why = outlines.reason[i]
        if not outlines.used[i] and why.reason is not Reason.OUTSIDE:
            name = legs[outlines.leg[i]]
            of_reason = rejected.setdefault(why.summary, [])
            if name not in of_reason:
                of_reason.append(name)
    reasons = "; ".join(f"{', '.join(legs)}: {why}" for why, legs in rejected.items())
    return f"{names[row]}: {used}", f"({reasons})" if reasons else ""


def check_detection_destination(destination: Path, dataset: Path | None) -> None:
    """Refuse an output folder that holds something else, or a table that was corrected.

    A corrected table is safe where it was copied into the dataset folder. Raises UsageError with
    what is there instead.
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


def write_detection(detection: Detection, destination: Path, run: Run, progress: Report) -> None:
    """Write the folder, all of it or nothing.

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
        (folder / DETECTION_PAGE).write_text(_page(detection), encoding="utf-8", newline="\n")
        files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.*"))
        record = {
            **detection.document,
            "table": hashlib.sha256(read_bytes(table, MAX_IMAGE)).hexdigest(),
            "files": [*files, DETECTION.marker],
        }
        (folder / DETECTION.marker).write_text(json.dumps(record, indent=1) + "\n", "utf-8")


class _Drawings(NamedTuple):
    """What is drawn over each image, and the name of its file; it travels to worker processes."""

    load: ImageReader
    marks: tuple[tuple[PartMarks, ...], ...]
    corners: tuple[tuple[Mark, ...], ...]
    captions: tuple[str, ...]
    unplaced: tuple[Camera | None, ...]  # cameras that could not be placed
    names: tuple[str, ...]
    photographs: bool  # whether the images are wanted with nothing drawn over them


def draw_images(
    detection: Detection, folder: Path, run: Run, progress: Report, *, photographs: bool = False
) -> None:
    """Write the overlay of every row that has an image, and the photograph by itself if asked."""
    rows = list(detection.overlay_files)
    files, bare = (
        tuple(folder / file for file in named.values())
        for named in (detection.overlay_files, detection.photograph_files if photographs else {})
    )
    for file in (*files, *bare):
        file.parent.mkdir(parents=True, exist_ok=True)
    drawings = _Drawings(
        detection.dataset.image_reader(rows),
        tuple(tuple(_marks(detection, row)) for row in rows),
        tuple(_corner_marks(detection, row) for row in rows),
        tuple(_caption(detection, row) for row in rows),
        tuple(_unplaced_camera(detection, row) for row in rows),
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
    """Return the files of overlay k and of the photograph without it."""
    image, camera = drawings.load(k), drawings.unplaced[k]
    marks = [] if camera is None else [marks_of_pairs(camera, image)]
    picture = draw(image, [*drawings.marks[k], *marks], drawings.captions[k], drawings.corners[k])
    grey = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    found = []
    for pixels in (picture, grey)[: 1 + drawings.photographs]:
        ok, content = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        if not ok:
            raise OutOfResources(
                f"{drawings.names[k]}: the picture could not be written: found that it cannot be "
                "encoded, needed enough memory; try again with fewer workers."
            )
        found.append(content.tobytes())
    return found


def _marks(detection: Detection, row: int) -> list[PartMarks]:
    """Return what is drawn over the image of a row."""
    measurements, outlines = detection.dataset.measurements, detection.outlines
    camera = measurements.views[int(measurements.view[row])].camera
    return marks_of_image(
        camera,
        outlines.choose(outlines.row == row),
        detection.predicted(row),
        detection.dataset.machine.leg_names,
    )


def _unplaced_camera(detection: Detection, row: int) -> Camera | None:
    """Return the camera of a row if it could not be placed: edge pairs are drawn then."""
    view = detection.dataset.measurements.views[int(detection.dataset.measurements.view[row])]
    return view.camera if view.name in detection.unplaced else None


def _corner_marks(detection: Detection, row: int) -> tuple[Mark, ...]:
    """Return what is drawn of the boards over the image of a row."""
    corners = detection.corners
    return () if corners is None else marks_of_corners(corners.choose(corners.row == row))


def _caption(detection: Detection, row: int) -> str:
    """Return what stands below the overlay of a row."""
    view, outlines = detection.view_of(row), detection.outlines
    measurements = detection.dataset.measurements
    here = outlines.used[outlines.row == row]
    found = f"{np.count_nonzero(here)} of {len(here)} outlines used"
    if view in detection.unplaced:
        found = "the camera could not be placed: edge pairs that were found"
        if detection.T_base_camera[int(measurements.view[row])] is not None:
            found += ", and legs where it was expected"
    text = f"{view}  {measurements.image[row]}  {found}"
    return text.encode("ascii", "replace").decode()


def _earlier(destination: Path) -> dict[str, Any]:
    """Return the document of an earlier detection in a folder; empty if there is none."""
    if not DETECTION.is_in(destination):
        return {}
    found: dict[str, Any] = read_json(destination / DETECTION.marker)
    return found


def _own_files(destination: Path) -> list[Path]:
    """Return the files of an earlier detection in a folder, relative to it."""
    named = _earlier(destination).get("files", [])
    names = [name for name in named if isinstance(name, str)] if isinstance(named, list) else []
    return [
        Path(name)
        for name in dict.fromkeys(names)
        if path_problem(destination, name) is None and _is_place(Path(name))
    ]


def _is_place(name: Path) -> bool:
    """Say whether a path is one where a detection is written."""
    if ".." in name.parts:
        return False
    own = {
        Path(OBSERVATIONS_NAME),
        Path(CORNERS_NAME),
        Path(DETECTION_PAGE),
        Path(DETECTION.marker),
    }
    return name in own or is_overlay(name) or is_overlay(name, PHOTOGRAPHS)


def is_overlay(name: Path, folder: str = OVERLAYS) -> bool:
    """Say whether a path is one at which overlays, or other pictures of images, are written."""
    return ".." not in name.parts and name.parts[:1] == (folder,) and name.suffix == ".jpg"
