"""The report of an examination: tables of its figures, and its page with the photographs.

On the page outlines are corrected over the photographs. It contains the written table, the
intrinsics of the cameras, and the expected positions of missing outlines: such an outline is placed
there and dragged onto its edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.detection import Detection, unique_names
from legcal.calibration.examination import Examination, ViewCondition
from legcal.data.dataset import OBSERVATIONS_NAME
from legcal.data.landmarks import LANDMARKS_NAME, SIGMA_PX, joint_names
from legcal.data.measurements import row_names
from legcal.data.outlines import format_observations
from legcal.data.reasons import WORDS_BY_CODE, Reason, reason_in_words
from legcal.files.quantity import SHOWN_IN
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
from legcal.vision.camera import Camera
from legcal.vision.visibility import PredictedLeg

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
            [_outline_cells(view) for view in examination.views if view.outlines is not None],
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


def _outline_cells(view: ViewCondition) -> list[Cell]:
    """Return the figures of the outlines of a view."""
    rejected = ", ".join(f"{n} {reason_in_words(reason)}" for reason, n in view.rejected.items())
    return [
        view.view,
        _share(view.legs_found, view.legs_visible),
        _share(view.outlines_used, view.outlines),
        number(view.contrast, 1),
        number(view.length, 0),
        number(view.residual, 3),
        "camera not placed" if view.problem else rejected,
    ]


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
    """Return the number of used outlines of an image and the reasons for rejecting legs."""
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
            "distortion": view.camera.distortion.tolist(),
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
