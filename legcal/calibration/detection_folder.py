"""The folder of ``legcal detect``: the table of outlines, a page and an overlay of every image.

On the page outlines are corrected over the photographs. It contains the written table, the
intrinsics of the cameras, and the expected positions of missing outlines: such an outline is placed
there and dragged onto its edge.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.detection import (
    OVERLAYS,
    PHOTOGRAPHS,
    Detection,
    Examination,
    unique_names,
)
from legcal.data.corners import write_corners
from legcal.data.dataset import CORNERS_NAME, OBSERVATIONS_NAME, ImageReader
from legcal.data.landmarks import LANDMARKS_NAME, SIGMA_PX, joint_names
from legcal.data.measurements import row_names
from legcal.data.outlines import are_of_bodies, format_observations, write_observations
from legcal.data.reasons import WORDS_BY_CODE, Reason, reason_in_words
from legcal.errors import OutOfResources, UsageError
from legcal.files.folder import OutputKind, check_destination, path_problem, result_folder
from legcal.files.quantity import SHOWN_IN
from legcal.files.reading import MAX_IMAGE, read_bytes, read_json
from legcal.geometry.lines import cross
from legcal.geometry.types import Array
from legcal.machine.picture import draw_machine, joint_letter
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
from legcal.perception.overlays import (
    Mark,
    PartMarks,
    draw,
    marks_of_corners,
    marks_of_image,
    marks_of_pairs,
)
from legcal.progress import Report
from legcal.vision.camera import Camera, spline_pieces
from legcal.vision.visibility import PredictedLeg
from legcal.workers import Run

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
    unplaced: tuple[Camera | None, ...]  # cameras that could not be placed
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
    """Return the encoded overlay k, and optionally the plain photograph."""
    image, camera = drawings.load(k), drawings.unplaced[k]
    marks = [] if camera is None else [marks_of_pairs(camera, image)]
    picture = draw(image, [*drawings.marks[k], *marks], drawings.captions[k], drawings.corners[k])
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


def _unplaced_camera(detection: Detection, row: int) -> Camera | None:
    """Return the camera of a row if it could not be placed: edge pairs are drawn then."""
    view = detection.dataset.measurements.views[int(detection.dataset.measurements.view[row])]
    return view.camera if view.name in detection.unplaced else None


def _corner_marks(detection: Detection, row: int) -> tuple[Mark, ...]:
    corners = detection.corners
    return () if corners is None else marks_of_corners(corners.choose(corners.row == row))


def _caption(detection: Detection, row: int) -> str:
    view, outlines = detection.view_of(row), detection.outlines
    measurements = detection.dataset.measurements
    used = outlines.used[(outlines.row == row) & ~are_of_bodies(outlines)]
    state = f"{np.count_nonzero(used)} of {len(used)} outlines used"
    if view in detection.unplaced:
        state = "the camera could not be placed: edge pairs that were found"
        if detection.T_base_camera[int(measurements.view[row])] is not None:
            state += ", and legs where it was expected"
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


def is_overlay(name: Path, folder: str = OVERLAYS) -> bool:
    """Return whether a relative path is that of an overlay, or another picture of an image."""
    return ".." not in name.parts and name.parts[:1] == (folder,) and name.suffix == ".jpg"


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
            legs_of_reason = rejected.setdefault(rejection.summary, [])
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
    editor = OutlineEditor(OBSERVATIONS_NAME, table, images, cameras, SIGMA_BY_HAND, WORDS_BY_CODE)
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
        band = leg.bands[i]
        if segment.link == part and band is not None:
            h, t = leg.outlines[i][edge - 1], np.linspace(0.0, band.length, n)
            xy = band.points(t, band.offsets(h, t))
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
