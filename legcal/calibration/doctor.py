"""Checks of a dataset before it is calibrated: ``legcal doctor`` and ``legcal detect``.

Files, readings, cameras, photographs, legs in the photographs, identifiability and common mistakes
are checked one after the other with the functions of other jobs. Each finding is one sentence with
its remedy. Nothing is fitted. ``detect`` also writes the outlines and draws them over the
photographs.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from legcal.calibration.board import BoardViews, notes_on_views, observe_board
from legcal.calibration.detection import (
    CHECKS,
    DETECTION,
    SEVERITIES,
    CheckState,
    Detection,
    EncoderUse,
    Examination,
    Finding,
    Severity,
    ViewCondition,
    check_detection_destination,
    detected,
    require_images,
    views_to_click,
    write_detection,
)
from legcal.calibration.diagnosis import NONE_EXPLAINS, Diagnosis, notes_beside
from legcal.calibration.doubts import MAX_LEFT_OUT
from legcal.calibration.estimate import unseen_legs
from legcal.calibration.identify.identifiability import check_identifiable
from legcal.calibration.joint_fit.parameter_choices import Choices
from legcal.calibration.mistake_search import MIN_IMAGES, diagnose
from legcal.calibration.ordered_dataset import (
    OrderedDataset,
    contradicting_readings,
    order_dataset,
)
from legcal.calibration.pipeline import chosen_parameters, exact_cameras
from legcal.data.cache import note_on_missing_photographs
from legcal.data.dataset import Dataset, ImageReader, inspect_files, load_dataset
from legcal.data.image_choice import dataset_at
from legcal.data.measurements import few_views, images_in_words, row_names
from legcal.data.outlines import Outlines, along_legs, is_edited
from legcal.data.photograph_notes import compression_notes, notes_on_moves, notes_on_photographs
from legcal.data.reasons import Reason, reason_in_words
from legcal.errors import (
    Cause,
    DatasetError,
    DidNotConverge,
    NotIdentifiable,
    NotVisible,
    Problem,
    by_cause,
)
from legcal.files.folder import output_path
from legcal.files.schema import few
from legcal.geometry.types import Array, BoolArray
from legcal.perception.diagnostics import defect_notes, is_out_of_sight
from legcal.perception.image_quality import Exposure, measure_exposure
from legcal.perception.photographs import defects_of
from legcal.perception.placement import unplaced_notes
from legcal.progress import Progress, Report, shown_progress
from legcal.workers import Run, Workers, worker_pool

LITTLE_USED = 0.1  # smallest range of readings without a warning, relative to the travel
SOFT = 3.0  # largest median blur of a view without a warning [px]
CLIPPED = 0.1  # largest share of clipped pixels of a view without a note
FEW_LEGS = 0.5  # smallest share of the visible legs of a view found without a warning
LOOKING = "Looking at light and sharpness"  # stage of progress


def doctor(
    source: str | Path | Dataset,
    *,
    output: str | Path | None = None,
    progress: Progress = False,
    workers: Workers = 1,
) -> Examination:
    """Check a dataset for all that may prevent its calibration; nothing is fitted.

    Parameters
    ----------
    source : path or Dataset
        The dataset folder, or a dataset of :func:`legcal.load_dataset`.
    output : path, optional
        Write a folder there, as ``legcal detect`` does: ``observations.csv``, ``index.html`` and
        an overlay of each image. Photographs that cannot be searched are then refused.
    progress : bool or callable
        True shows bars on stderr; a function is called as ``progress(stage, done, total)``.
    workers : int, str or executor
        Inspect the images there, as :func:`legcal.calibrate` does.

    Returns
    -------
    Examination

    Raises
    ------
    DatasetError, ModelError, OutOfClass
        If the dataset file, its table, a camera or the model cannot be read. Without an output,
        unusable photographs are findings.
    NotVisible, NotIdentifiable, DidNotConverge
        With an output, if images could not be searched because the calibration board is not
        visible or the motors do not determine the pose.
    UsageError
        If the output is another kind of folder, or contains an edited table of an earlier
        detection.
    """
    if output is not None:
        folder = source.folder if isinstance(source, Dataset) else Path(source)
        folder = folder if folder.is_dir() else folder.parent
        check_detection_destination(output_path(output, DETECTION), folder)
    writes = output is not None
    dataset = source if isinstance(source, Dataset) else load_dataset(source, check_images=writes)
    if writes:
        require_images(dataset)
    dataset, problems = inspect_files(dataset)
    checklist, choices = _Checklist(dataset, writes), chosen_parameters(dataset, ())
    usable = _look_at_files(checklist, problems)
    _look_at_readings(checklist, dataset.table_notes)
    _look_at_cameras(checklist, choices)
    with shown_progress(progress) as report, worker_pool(workers) as pool:
        exposures = _look_at_photographs(checklist, usable, pool, report)
        _look_at_parameters(checklist, usable, choices)
        detection, tried = None, None
        if exposures or (usable and dataset.observations is not None):
            data = order_dataset(dataset_at(dataset, np.array(usable)), pool, report)
            board = _look_at_boards(checklist, data, tells=not exposures)
            tried = _diagnose(checklist, data, board)
            detection = _searched(checklist, data, board) if exposures else None
        views = _conditions(dataset, exposures, detection)
        if detection is not None:
            _look_at_legs(checklist, detection, views, choices)
        if tried == () and _explains_little(checklist, detection, views):
            checklist.add("mistakes", "note", NONE_EXPLAINS)
        examination = Examination(
            dataset=str(dataset.folder),
            mechanism=dataset.machine.name,
            checks=tuple(
                CheckState(name=name, state=checklist.state(name), found=checklist.checks[name])
                for name in CHECKS
                if name in checklist.checks
            ),
            findings=tuple(
                sorted(  # files and mistakes first
                    checklist.findings,
                    key=lambda one: (
                        SEVERITIES.index(one.severity),
                        one.check != "files",
                        one.check != "mistakes",
                    ),
                )
            ),
            encoders=tuple(checklist.encoders),
            views=tuple(views),
            diagnosis=checklist.diagnosis,
            is_usable=len(usable) == dataset.measurements.n_rows,
            detection=detection,
            is_written=writes,
        )
        if output is not None and detection is not None:
            write_detection(examination, detection, Path(output), pool, report)
    return examination


def detect(
    source: str | Path | Dataset,
    *,
    output: str | Path | None = None,
    progress: Progress = False,
    workers: Workers = 1,
) -> Detection:
    """Find and measure the outlines of the legs in all images, without a fit.

    Given or edited outlines are kept; outlines stored by an earlier run are ignored. With an output
    this is :func:`legcal.doctor`, and returns its outlines.

    Parameters
    ----------
    source, output, progress, workers
        As :func:`legcal.doctor` takes them.

    Returns
    -------
    Detection
        Views without recognised legs are in ``unplaced``.

    Raises
    ------
    DatasetError, ModelError, OutOfClass, NotVisible, NotIdentifiable, UsageError
        As :func:`legcal.doctor` with an output.
    """
    if output is not None:
        written = doctor(source, output=output, progress=progress, workers=workers).detection
        if written is not None:
            return written
    dataset = source if isinstance(source, Dataset) else load_dataset(source)
    images = require_images(dataset)
    with shown_progress(progress) as report, worker_pool(workers) as pool:
        return detected(order_dataset(dataset, pool, report), images)


@dataclass
class _Checklist:
    dataset: Dataset
    refuses: bool  # whether unusable photographs are errors rather than findings
    checks: dict[str, str] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)
    encoders: list[EncoderUse] = field(default_factory=list)
    diagnosis: tuple[Diagnosis, ...] = ()

    def add(self, check: str, severity: Severity, message: str, rows: Sequence[int] = ()) -> None:
        """Add a finding; rows are in the order of the dataset's files."""
        names = row_names(self.dataset.measurements)
        images = tuple(names[row] for row in rows)
        self.findings.append(Finding(check=check, severity=severity, what=message, images=images))

    def state(self, check: str) -> Severity | Literal["ok"]:
        """Return the severity of the worst finding of a check."""
        severities = {finding.severity for finding in self.findings if finding.check == check}
        return next((finding for finding in SEVERITIES if finding in severities), "ok")


def _look_at_files(checklist: _Checklist, problems: Sequence[tuple[int, Problem]]) -> list[int]:
    """Look for missing and unreadable photographs; return the usable rows."""
    dataset, m = checklist.dataset, checklist.dataset.measurements
    n, views = sum(map(bool, m.image)), len(np.unique(m.view))
    checklist.checks["files"] = (
        f"{n} photograph{'s' * (n != 1)} of {views} view{'s' * (views != 1)}, {m.n_poses} "
        f"pose{'s' * (m.n_poses != 1)}, model {dataset.machine.name}"
    )
    bad = [row for row, _ in problems]
    paths = {row: dataset.image_path(row) for row in bad}
    missing = [row for row, path in paths.items() if path is not None and not path.exists()]
    if missing:
        checklist.add(
            "files",
            "error",
            f"{dataset.table_path}: found no file of {images_in_words(m, missing)} in "
            f"{dataset.folder}, needed one for each row; copy them there, correct their names, or "
            "remove the rows.",
            missing,
        )
    of_files = {row: problem for row, problem in problems if row not in missing}
    unread = {row: problem for row, problem in of_files.items() if problem.name}
    causes = {row: Cause("{} {}", (error.found, error.needed)) for row, error in unread.items()}
    for cause, rows in by_cause(causes):
        if len(rows) > 1:
            problem_text = f"{images_in_words(m, rows)} could not be read"
            error = replace(
                unread[rows[0]], what=problem_text, found=str(cause.values[0]), row=None
            )
            checklist.add("files", "error", str(error), rows)
            of_files = {row: problem for row, problem in of_files.items() if row not in rows}
    for row, problem in of_files.items():
        checklist.add("files", "error", str(problem), [row])
    for note in note_on_missing_photographs(dataset):
        checklist.add("files", "note", note)
    return [row for row in range(m.n_rows) if row not in bad]


def _look_at_readings(checklist: _Checklist, notes: Sequence[str]) -> None:
    """Check readings against each other and the travel."""
    dataset = checklist.dataset
    for note in notes:
        checklist.add("readings", "warning", note)
    contradicting = contradicting_readings(dataset.machine, dataset.measurements)
    for contradiction, rows in by_cause(contradicting):
        checklist.add(
            "readings",
            "warning",
            f"The readings of {images_in_words(dataset.measurements, rows)} contradict each other: "
            f"found {contradiction}; check them, or leave it to the images to show which is wrong.",
            rows,
        )
    checklist.encoders = _encoder_uses(dataset)
    shares = {
        encoder.column: encoder.used for encoder in checklist.encoders if encoder.used is not None
    }
    checklist.checks["readings"] = f"{len(checklist.encoders)} encoders"
    if shares:
        used = _range([100.0 * share for share in shares.values()])
        checklist.checks["readings"] += f", {used} % of their travel used"
    _look_for_still_encoders(checklist, shares)


def _encoder_uses(dataset: Dataset) -> list[EncoderUse]:
    """Return the range of the readings of each encoder, and its share of the travel."""
    legs, q, uses = dataset.machine.legs, dataset.measurements.q, list[EncoderUse]()
    for j, name in zip(dataset.machine.motors, dataset.machine.motor_names, strict=True):
        lower, upper = map(float, legs[j].travel)
        has_travel = bool(np.isfinite(upper - lower)) and upper > lower
        smallest, largest = float(q[:, j].min()), float(q[:, j].max())
        uses.append(
            EncoderUse(
                column=name,
                unit=legs[j].reading_unit,
                least=smallest,
                greatest=largest,
                travel=(lower, upper) if has_travel else None,
                used=(largest - smallest) / (upper - lower) if has_travel else None,
            )
        )
    return uses


def _look_for_still_encoders(checklist: _Checklist, shares: Mapping[str, float]) -> None:
    """Look for encoders that use a small part of their travel."""
    moves = any(shares.values())  # an encoder that never does is noted by the table, beside others
    still = [x for x, share in shares.items() if share < LITTLE_USED and (share or not moves)]
    if still:
        percent = _range([100.0 * shares[name] for name in still])
        checklist.add(
            "readings",
            "warning",
            f"The readings hardly move: found {few(still)} in {percent} % of the travel, needed "
            f"{100 * LITTLE_USED:.0f} % or more of every encoder for poses that tell parameters "
            "apart; take photographs at poses that differ more, and check the unit of readings.",
        )


def _look_at_cameras(checklist: _Checklist, choices: Choices) -> None:
    dataset, m = checklist.dataset, checklist.dataset.measurements
    shown_views = sorted({int(v) for v in m.view})
    files = {dataset.camera_paths[v]: m.views[v].camera for v in shown_views}
    checklist.checks["camera"] = ", ".join(
        f"{path.name}: {camera.width} x {camera.height} px" for path, camera in files.items()
    )
    for note in notes_on_photographs(m, dataset.camera_paths, dataset.facts):
        checklist.add("camera", "error" if note.is_certain else "warning", note.what)
    for message in exact_cameras(dataset, choices):
        checklist.add("camera", "note", message)


def _look_at_boards(
    checklist: _Checklist, data: OrderedDataset, *, tells: bool
) -> BoardViews | None:
    """Return the boards in the images, None without any or if they cannot be used.

    Whether they place the cameras of given outlines is told here, which nothing else is asked of.
    """
    try:
        board = observe_board(data)
    except (DatasetError, NotVisible) as error:
        for problem in error.problems if tells else ():
            checklist.add("camera", "error", problem)
        return None
    if board is not None and tells:
        corners, rows = data.order.restore(board.corners), np.arange(data.measurements.n_rows)
        for note in notes_on_views(data.dataset, corners, rows):
            checklist.add("camera", "warning", note)
    return board


def _look_at_parameters(checklist: _Checklist, rows: Sequence[int], choices: Choices) -> None:
    """Check whether the given images can determine all parameters to be estimated."""
    if not rows:
        return
    try:
        notes = check_identifiable(dataset_at(checklist.dataset, np.array(rows)), choices)
    except (DatasetError, NotIdentifiable, DidNotConverge) as error:
        checklist.checks["parameters"] = "not all of them can be identified"
        if isinstance(error, DatasetError):  # the model does not reach the readings
            checklist.checks["parameters"] = "they could not be checked"
        for message in error.problems:
            checklist.add("parameters", "error", message)
        return
    checklist.checks["parameters"] = "identifiable, if every view shows its legs"
    for message in notes:
        checklist.add("parameters", "note", message)


def _look_at_photographs(
    checklist: _Checklist, usable: list[int], pool: Run, report: Report
) -> dict[int, Exposure]:
    """Check exposure, sharpness and duplicates of photographs; return the exposures by row.

    Photographs that cannot be decoded are removed from the usable rows.
    """
    dataset, m = checklist.dataset, checklist.dataset.measurements
    rows = [row for row in usable if m.image[row] in dataset.facts]
    exposures, pixels = dict[int, Exposure](), dict[str, list[int]]()
    if not rows:
        return {}
    report(LOOKING, 0, len(rows))
    look = partial(_look, dataset.image_reader(range(m.n_rows)))
    for k, (row, (exposure, digest)) in enumerate(zip(rows, pool(look, rows), strict=True)):
        if exposure is None and checklist.refuses:
            raise DatasetError(digest)
        if exposure is None:
            checklist.add("files", "error", digest, [row])
            usable.remove(row)
        else:
            exposures[row] = exposure
            if not exposure.defect:
                pixels.setdefault(digest, []).append(row)
        report(LOOKING, k + 1, len(rows))
    defects = defects_of(m, exposures)
    blurs = [light.blur for row, light in exposures.items() if row not in defects]
    checklist.checks["photographs"] = (
        f"{len(exposures) - len(defects)} of {len(rows)} show something"
    )
    if blurs:
        checklist.checks["photographs"] += f", blurred by {float(np.median(blurs)):.1f} px"
    for message in defect_notes(m, defects):
        checklist.add("photographs", "warning", message)
    for duplicates in (
        rows_of_digest for rows_of_digest in pixels.values() if len(rows_of_digest) > 1
    ):
        several = len({int(m.pose[row]) for row in duplicates}) > 1
        same = images_in_words(m, duplicates)
        checklist.add(
            "files",
            "error" if several else "warning",
            f"{same[0].upper()}{same[1:]} are the same photograph, "
            + (
                "with different readings: only one of them can be right"
                if several
                else "which would count more than once"
            )
            + "; remove the other rows, or name the photographs that belong to them.",
            duplicates,
        )
    _look_at_views(
        checklist, {row: light for row, light in exposures.items() if row not in defects}
    )
    for message in compression_notes(m, dataset.facts):
        checklist.add("photographs", "note", message)
    return exposures


def _look(load: ImageReader, row: int) -> tuple[Exposure | None, str]:
    """Return the exposure of an image and a digest of its pixels, or None and the error."""
    try:
        grey = load(row)
    except DatasetError as error:
        return None, error.problems[0]
    return measure_exposure(grey), hashlib.sha256(grey.tobytes()).hexdigest()


def _look_at_views(checklist: _Checklist, exposures: Mapping[int, Exposure]) -> None:
    m = checklist.dataset.measurements
    of_views = {
        view.name: of_view
        for v, view in enumerate(m.views)
        if (of_view := [exposure for row, exposure in exposures.items() if m.view[row] == v])
    }
    blur = {
        name: float(np.median([exposure.blur for exposure in of_view]))
        for name, of_view in of_views.items()
    }
    clipped = {
        name: float(np.median([exposure.clipped for exposure in of_view]))
        for name, of_view in of_views.items()
    }
    if soft := [name for name in blur if blur[name] > SOFT]:
        checklist.add(
            "photographs",
            "warning",
            f"The photographs of {few_views(soft)} are blurred by "
            f"{_range([blur[name] for name in soft])} px, needed {SOFT:g} px or less for outlines "
            "that are precise; focus on the legs, close the aperture, and let machine and camera "
            "stand still.",
        )
    if bright := [name for name in clipped if clipped[name] > CLIPPED]:
        checklist.add(
            "photographs",
            "note",
            f"In photographs of {few_views(bright)} "
            f"{_range([100.0 * clipped[name] for name in bright])} % of the pixels are as bright "
            "as a file can say: edges beside such places cannot be measured well; expose less if "
            "these are legs or what is behind them.",
        )


def _diagnose(
    checklist: _Checklist, data: OrderedDataset, board: BoardViews | None
) -> tuple[Diagnosis, ...] | None:
    tried = diagnose(data, board)
    checklist.diagnosis = tried or ()
    checklist.checks["mistakes"] = (
        "one explains the images better"
        if checklist.diagnosis
        else "none explains the images better"
    )
    most_images = int(np.bincount(data.measurements.view).max())
    if (
        most_images < MIN_IMAGES
        and not checklist.diagnosis
        and data.dataset.board_on("base") is None
    ):
        checklist.checks["mistakes"] = "not tried: too few images of each view"
        checklist.add(
            "mistakes",
            "note",
            "Mistakes in readings, model and images could not be looked for: found at most "
            f"{most_images} image{'s' * (most_images > 1)} of a view, needed {MIN_IMAGES} or more, "
            "since some camera pose fits fewer images in any case; photograph more poses from one "
            "position.",
        )
    for diagnosis in checklist.diagnosis:
        checklist.add("mistakes", "error", diagnosis.sentence)
    return tried


def _searched(
    checklist: _Checklist, data: OrderedDataset, board: BoardViews | None
) -> Detection | None:
    """Search the images for the legs; None if that fails."""
    m = data.dataset.measurements
    for message in notes_on_moves(m, data.dataset.moves):
        checklist.add("photographs", "note", message)
    rows = np.array([row for row in range(m.n_rows) if m.image[row]], dtype=np.intp)
    try:
        to_click = views_to_click(data) if checklist.refuses else ()
        return detected(data, rows, to_click, board)
    except (DatasetError, NotIdentifiable, NotVisible, DidNotConverge) as error:
        if checklist.refuses:
            raise
        checklist.checks["legs"] = "they could not be looked for"
        for problem in error.problems:
            checklist.add("legs", "error", problem)
        return None


def _look_at_legs(
    checklist: _Checklist, detection: Detection, views: Sequence[ViewCondition], choices: Choices
) -> None:
    """Check the legs found in the images, and identifiability by them."""
    outlines = detection.outlines
    checklist.checks["legs"] = (
        f"{sum(view.legs_found or 0 for view in views)} of "
        f"{sum(view.legs_visible or 0 for view in views)} found, "
        f"{np.count_nonzero(outlines.used)} of {len(outlines)} outlines can be used"
    )
    m = detection.dataset.measurements
    n_images = dict(zip(m.view_names, np.bincount(m.view).tolist(), strict=True))
    # A few images of a camera in the hand are left out, as single images of other views are
    is_few = len(detection.unplaced) <= MAX_LEFT_OUT * m.n_rows
    is_left_out = is_few and all(n_images[name] == 1 for name in detection.unplaced)
    for message in unplaced_notes(detection.unplaced):
        checklist.add("legs", "warning" if is_left_out else "error", message)
    texts = {text.what for text in checklist.findings}
    new_notes = [text for text in detection.image_notes if text not in texts]
    for message in notes_beside(checklist.diagnosis, new_notes, "legcal doctor"):
        checklist.add("legs", "note" if checklist.diagnosis else "warning", message)
    for message in detection.leg_notes:
        checklist.add("legs", "note", message)
    for view in views:
        n_found, n_visible = view.legs_found or 0, view.legs_visible or 0
        if not view.problem and n_found < FEW_LEGS * n_visible:
            reason = reason_in_words(next(iter(view.rejected), Reason.OTHER))
            checklist.add(
                "legs",
                "warning",
                f"The photographs of view {view.view} show {n_found} of {n_visible} legs that they "
                f"should, needed most of them (the others mostly because {reason}); look at legcal "
                "detect, and improve light and background.",
            )
    _check_remaining_images(checklist, detection, choices)


def _explains_little(
    checklist: _Checklist, detection: Detection | None, views: Sequence[ViewCondition]
) -> bool:
    """Whether so many images or legs are not found that a mistake may be the cause."""
    if detection is None or checklist.state("legs") == "error":
        return True
    few = any((v.legs_found or 0) < FEW_LEGS * (v.legs_visible or 0) for v in views)
    return few or len(detection.left_out) > MAX_LEFT_OUT * len(detection.rows)


def _check_remaining_images(checklist: _Checklist, detection: Detection, choices: Choices) -> None:
    """Check whether the images with recognised legs determine the parameters."""
    dataset, m = detection.dataset, detection.dataset.measurements
    names = np.array(m.view_names)
    out = np.isin(np.arange(m.n_rows), list(detection.left_out)) | np.isin(
        names[m.view], list(detection.unplaced)
    )
    unseen = unseen_legs(dataset.machine, m, detection.outlines)
    if unseen and not out.all():
        checklist.add(
            "legs",
            "error",
            f"No photograph shows {few(unseen)} so that an outline can be used, needed some of "
            "every leg; add images that show it, or name the legs of each view in dataset.yaml to "
            "leave it to the readings.",
        )
    if out.any() and not out.all() and checklist.state("parameters") != "error":
        try:
            check_identifiable(dataset_at(dataset, np.flatnonzero(~out)), choices)
        except (NotIdentifiable, DidNotConverge) as error:
            checklist.checks["parameters"] = "the images that are left cannot determine all of them"
            for problem in error.problems:
                checklist.add("parameters", "error", problem)


def _conditions(
    dataset: Dataset, exposures: Mapping[int, Exposure], detection: Detection | None
) -> list[ViewCondition]:
    """Return figures of the photographs and outlines of each view."""
    m = dataset.measurements
    conditions = []
    for v in np.unique(m.view).tolist():
        rows = [row for row in np.flatnonzero(m.view == v).tolist() if row in exposures]
        blurs = [exposures[row].blur for row in rows if not exposures[row].defect]
        qualities = [
            quality
            for row in rows
            if (quality := dataset.facts[m.image[row]].jpeg_quality) is not None
        ]
        condition = ViewCondition(
            view=m.views[v].name,
            images=len(rows),
            camera=dataset.camera_paths[v].name,
            blur_px=_median(blurs),
            clipped=_median([exposures[row].clipped for row in rows]),
            jpeg_quality=min(qualities, default=None),
        )
        if detection is not None:
            condition = condition.model_copy(update=_outline_figures(detection, condition.view))
        conditions.append(condition)
    return conditions


def _outline_figures(detection: Detection, view: str) -> dict[str, Any]:
    """Return the figures of the outlines of a view, by the names of their fields."""
    m = detection.dataset.measurements
    names = np.array([view_of_dataset.name for view_of_dataset in m.views])
    outlines = detection.outlines.choose(names[m.view[detection.outlines.row]] == view)
    used, rods = outlines.used, along_legs(outlines, detection.dataset.machine.legs)
    rejected = Counter(
        str(rejection.reason) for rejection, ok in zip(outlines.reason, used, strict=True) if not ok
    )
    return {
        "legs_visible": _count_legs(rods, ~is_out_of_sight(rods) | rods.used),
        "legs_found": _count_legs(rods, rods.used),
        "outlines": len(outlines),
        "outlines_used": int(np.count_nonzero(used)),
        "edited": int(np.count_nonzero(is_edited(outlines))),
        "contrast": _median(outlines.contrast[used]),
        "length": _median(outlines.length[used]),
        "residual": _median(outlines.residual[used]),
        "rejected": dict(rejected.most_common()),
        "problem": str(detection.unplaced[view]) if view in detection.unplaced else None,
    }


def _count_legs(outlines: Outlines, chosen: BoolArray) -> int:
    return len(set(zip(outlines.row[chosen].tolist(), outlines.leg[chosen].tolist(), strict=True)))


def _median(values: Sequence[float] | Array) -> float | None:
    finite = [value for value in values if np.isfinite(value)]
    return float(np.median(finite)) if finite else None


def _range(values: Sequence[float]) -> str:
    least, greatest = (f"{float(f'{end(values):.2g}'):g}" for end in (min, max))
    return least if least == greatest else f"{least} to {greatest}"
