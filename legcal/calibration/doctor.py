"""A look at a dataset before it is calibrated: ``legcal doctor`` and ``legcal detect``.

Files, readings, cameras, photographs, what these show of the legs, what they can determine, and
common mistakes are looked at one after the other, by what other jobs compute. What is found is one
sentence each, with the remedy. Nothing is fitted. ``detect`` writes the outlines as well, and shows
them over the photographs.
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

from legcal.calibration.detection import (
    Detection,
    detected,
    rows_with_image,
    unsearched,
    views_to_click,
)
from legcal.calibration.detection_folder import (
    DETECTION,
    check_detection_destination,
    write_detection,
)
from legcal.calibration.diagnosis.diagnosis import MIN_IMAGES, Diagnosis, diagnose, notes_beside
from legcal.calibration.estimate import unseen_legs
from legcal.calibration.examination import (
    CHECKS,
    SEVERITIES,
    CheckState,
    EncoderUse,
    Examination,
    Finding,
    Severity,
    ViewCondition,
)
from legcal.calibration.identify.identifiability import check_identifiable
from legcal.calibration.joint_fit.parameter_choices import Choices
from legcal.calibration.ordered_dataset import (
    OrderedDataset,
    contradicting_readings,
    order_dataset,
)
from legcal.calibration.pipeline import chosen_parameters, exact_cameras
from legcal.causes import Cause, by_cause
from legcal.data.dataset import Dataset, ImageReader, inspect_files, load_dataset
from legcal.data.holdout import dataset_at
from legcal.data.image_causes import images_in_words
from legcal.data.measurements import few, few_views, reading_columns, row_names
from legcal.data.outlines import Outlines, along_legs, is_edited
from legcal.data.photograph_notes import compression_notes, notes_on_photographs
from legcal.data.reasons import Reason, reason_in_words
from legcal.errors import DatasetError, DidNotConverge, NotIdentifiable, NotVisible, Problem
from legcal.files.folder import output_path
from legcal.geometry.types import Array, BoolArray
from legcal.perception.diagnostics import defect_notes, is_out_of_sight
from legcal.perception.image_quality import Exposure, measure_exposure
from legcal.perception.photographs import defects_of
from legcal.perception.placement import unplaced_notes
from legcal.progress import Progress, Report, shown_progress
from legcal.workers import Run, Workers, worker_pool

LITTLE_USED = 0.1  # of the travel: poses that differ by less determine little
SOFT = 3.0  # usual blur of a view [px], from which on outlines lose much of their precision
CLIPPED = 0.1  # of the pixels of a view
FEW_LEGS = 0.5  # of those that a view should show
MIN_READINGS = 6  # that have the same last digit by more than chance
MAX_DIGITS = 10  # of readings in metres
LOOKING = "Looking at light and sharpness"  # a stage of progress


def doctor(
    source: str | Path | Dataset,
    *,
    output: str | Path | None = None,
    progress: Progress = False,
    workers: Workers = 1,
) -> Examination:
    """Look for all that can stand in the way of calibrating a dataset; nothing is fitted.

    Parameters
    ----------
    source : path or Dataset
        The dataset folder, or what :func:`legcal.load_dataset` returned.
    output : path, optional
        Write a folder there, as ``legcal detect`` does: ``observations.csv``, ``index.html`` and
        each image with what was found in it. Photographs that cannot be searched are refused then.
    progress : bool or callable
        True shows bars on stderr; a function is called as ``progress(stage, done, total)``.
    workers : int, str or executor
        Look at the images there, as :func:`legcal.calibrate` does.

    Returns
    -------
    Examination

    Raises
    ------
    DatasetError, ModelError, OutOfClass
        If the dataset file, its table, a camera or the model cannot be read. Without an output,
        photographs that cannot be used are findings.
    NotVisible, NotIdentifiable, DidNotConverge
        With an output, if images could not be searched: they do not show the calibration board that
        they should, or the motors do not determine where the legs are.
    UsageError
        If the output holds something else, or a table of an earlier detection that was corrected.
    """
    if output is not None:
        folder = source.folder if isinstance(source, Dataset) else _folder(Path(source))
        check_detection_destination(output_path(output, DETECTION), folder)
    writes = output is not None
    dataset = source if isinstance(source, Dataset) else load_dataset(source, check_images=writes)
    if writes:
        rows_with_image(dataset)
    dataset, problems = inspect_files(dataset)
    found, choices = _Found(dataset, writes), chosen_parameters(dataset, ())
    usable = _look_at_files(found, problems)
    _look_at_readings(found, dataset.table_notes)
    _look_at_cameras(found, choices)
    with shown_progress(progress) as report, worker_pool(workers) as pool:
        exposures = _look_at_photographs(found, usable, pool, report)
        _look_at_parameters(found, usable, choices)
        seen = None
        if exposures or (usable and dataset.observations is not None):
            data = order_dataset(dataset_at(dataset, np.array(usable)), pool, report)
            _diagnose(found, data)
            seen = _searched(found, data) if exposures else None
        views = _conditions(dataset, exposures, seen)
        if seen is not None:
            _look_at_legs(found, seen, views, choices)
        examination = Examination(
            dataset=str(dataset.folder),
            mechanism=dataset.machine.name,
            checks=tuple(
                CheckState(name=name, state=found.state(name), found=found.checks[name])
                for name in CHECKS
                if name in found.checks
            ),
            findings=tuple(sorted(found.findings, key=_severest_first)),
            encoders=tuple(found.encoders),
            views=tuple(views),
            diagnosis=found.diagnosis,
            is_usable=len(usable) == dataset.measurements.n_rows,
            detection=seen,
            is_written=writes,
        )
        if output is not None and seen is not None:
            write_detection(examination, seen, Path(output), pool, report)
    return examination


def detect(
    source: str | Path | Dataset,
    *,
    output: str | Path | None = None,
    progress: Progress = False,
    workers: Workers = 1,
) -> Detection:
    """Find and measure the outlines of the legs in all images, without a fit.

    Outlines that were given or edited are taken as they are; those that an earlier run left beside
    the dataset are not. With an output this is :func:`legcal.doctor`, of which it returns the
    outlines.

    Parameters
    ----------
    source, output, progress, workers
        As :func:`legcal.doctor` takes them.

    Returns
    -------
    Detection
        With views in ``unplaced`` whose images do not show the legs where they should be.

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
    images = rows_with_image(dataset)
    with shown_progress(progress) as report, worker_pool(workers) as pool:
        return detected(order_dataset(dataset, pool, report), images)


def _folder(path: Path) -> Path:
    """Return the folder of a dataset that is named by it or by its ``dataset.yaml``."""
    return path if path.is_dir() else path.parent


@dataclass
class _Found:
    """What was found so far."""

    dataset: Dataset
    refuses: bool  # what cannot be searched; else it is a finding
    checks: dict[str, str] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)
    encoders: list[EncoderUse] = field(default_factory=list)
    diagnosis: tuple[Diagnosis, ...] = ()

    def add(self, check: str, severity: Severity, what: str, rows: Sequence[int] = ()) -> None:
        """Add a finding; rows are those of the dataset's files."""
        names = row_names(self.dataset.measurements)
        images = tuple(names[row] for row in rows)
        self.findings.append(Finding(check=check, severity=severity, what=what, images=images))

    def state(self, check: str) -> Severity | Literal["ok"]:
        """Return the severity of the worst finding of a check."""
        of_check = {one.severity for one in self.findings if one.check == check}
        return next((one for one in SEVERITIES if one in of_check), "ok")


def _severest_first(one: Finding) -> tuple[int, bool, bool]:
    """Return what findings are sorted by: mistakes explain others, files are needed for all."""
    return SEVERITIES.index(one.severity), one.check != "files", one.check != "mistakes"


def _look_at_files(found: _Found, problems: Sequence[tuple[int, Problem]]) -> list[int]:
    """Look for photographs that are not there or cannot be used; return the rows that can."""
    dataset, m = found.dataset, found.dataset.measurements
    n, views = sum(map(bool, m.image)), len(np.unique(m.view))
    found.checks["files"] = (
        f"{n} photograph{'s' * (n != 1)} of {views} view{'s' * (views != 1)}, {m.n_poses} "
        f"pose{'s' * (m.n_poses != 1)}, model {dataset.machine.name}"
    )
    bad = [row for row, _ in problems]
    paths = {row: dataset.image_path(row) for row in bad}
    missing = [row for row, path in paths.items() if path is not None and not path.exists()]
    if missing:
        found.add(
            "files",
            "error",
            f"{dataset.table_path}: found no file of {images_in_words(m, missing)} in "
            f"{dataset.folder}, needed one for each row; copy them there, correct their names, or "
            "remove the rows.",
            missing,
        )
    of_files = {row: problem for row, problem in problems if row not in missing}
    unread = {row: problem for row, problem in of_files.items() if problem.name}  # of an image
    causes = {row: Cause("{} {}", (one.found, one.needed)) for row, one in unread.items()}
    for cause, alike in by_cause(causes):
        if len(alike) > 1:
            what = f"{images_in_words(m, alike)} could not be read"
            one = replace(unread[alike[0]], what=what, found=str(cause.values[0]), row=None)
            found.add("files", "error", str(one), alike)
            of_files = {row: problem for row, problem in of_files.items() if row not in alike}
    for row, problem in of_files.items():
        found.add("files", "error", str(problem), [row])
    return [row for row in range(m.n_rows) if row not in bad]


def _look_at_readings(found: _Found, notes: Sequence[str]) -> None:
    """Compare readings with each other, with travel, and their digits with their stated noise."""
    dataset = found.dataset
    for note in notes:
        found.add("readings", "warning", note)
    contradicting = contradicting_readings(dataset.machine, dataset.measurements)
    for what, rows in by_cause(contradicting):
        found.add(
            "readings",
            "warning",
            f"The readings of {images_in_words(dataset.measurements, rows)} contradict each other: "
            f"found {what}; check them, or leave it to the images to show which is wrong.",
            rows,
        )
    found.encoders = _encoder_uses(dataset)
    shares = {one.column: one.used for one in found.encoders if one.used is not None}
    found.checks["readings"] = f"{len(found.encoders)} encoders"
    if shares:
        used = _range([100.0 * share for share in shares.values()])
        found.checks["readings"] += f", {used} % of their travel used"
    _look_for_still_encoders(found, shares)
    _look_for_rounded_readings(found)


def _encoder_uses(dataset: Dataset) -> list[EncoderUse]:
    """Return the range of the readings of each encoder, and its share of the travel."""
    legs, q, uses = dataset.machine.legs, dataset.measurements.q, list[EncoderUse]()
    for j, column in zip(dataset.machine.motors, reading_columns(legs), strict=True):
        lower, upper = map(float, legs[j].travel)
        has_travel = bool(np.isfinite(upper - lower)) and upper > lower
        least, greatest = float(q[:, j].min()), float(q[:, j].max())
        uses.append(
            EncoderUse(
                column=column.name,
                unit=legs[j].reading_unit,
                least=least,
                greatest=greatest,
                travel=(lower, upper) if has_travel else None,
                used=(greatest - least) / (upper - lower) if has_travel else None,
            )
        )
    return uses


def _look_for_still_encoders(found: _Found, shares: Mapping[str, float]) -> None:
    """Look for encoders that read the same in all rows, or use little of their travel."""
    constant = [one.column for one in found.encoders if one.least == one.greatest]
    if 0 < len(constant) < len(found.encoders):
        found.add(
            "readings",
            "warning",
            f"{found.dataset.table_path}: found the same reading in all rows of {few(constant)}, "
            "while other encoders move; check that these were recorded, and move these legs as "
            "well.",
        )
        shares = {name: share for name, share in shares.items() if name not in constant}
    still = [name for name, share in shares.items() if share < LITTLE_USED]
    if still:
        percent = _range([100.0 * shares[name] for name in still])
        found.add(
            "readings",
            "warning",
            f"The readings hardly move: found {few(still)} in {percent} % of the travel, needed "
            f"{100 * LITTLE_USED:.0f} % or more of every encoder for poses that tell parameters "
            "apart; take photographs at poses that differ more, and check the unit of readings.",
        )


def _look_for_rounded_readings(found: _Found) -> None:
    """Look for readings whose last digit is coarser than the noise that is stated for them."""
    dataset, legs = found.dataset, found.dataset.machine.legs
    sigma = dataset.measurements.sigma_of(legs)
    for unit in ("m", "rad"):
        of_unit = [j for j in dataset.machine.motors if legs[j].reading_unit == unit]
        digit = _last_digit(dataset.measurements.q[:, of_unit])
        if digit is None or digit / np.sqrt(12.0) <= (stated := float(sigma[of_unit].min())):
            continue
        step = f"{1e3 * digit:g} mm" if unit == "m" else f"{digit:g} rad"
        found.add(
            "readings",
            "warning",
            f"{dataset.table_path}: found readings in steps of {step}, whose rounding alone has a "
            f"standard deviation of {digit / np.sqrt(12.0):.2g} {unit}, needed no more than the "
            f"encoder_sigma of {stated:.2g} {unit} in {dataset.yaml_path.name}; write more digits, "
            "or state a greater encoder_sigma.",
        )


def _last_digit(q: Array) -> float | None:
    """Return the size of the last digit that readings have; None where they are too few."""
    values = q[np.isfinite(q)]
    if len(values) < MIN_READINGS:
        return None
    for digits in range(MAX_DIGITS):
        scaled = values * 10.0**digits
        if np.all(np.abs(scaled - np.rint(scaled)) < 1e-6):
            return float(10.0**-digits)
    return None


def _look_at_cameras(found: _Found, choices: Choices) -> None:
    """Look at what photographs say of how they were made, against camera files and each other."""
    dataset, m = found.dataset, found.dataset.measurements
    shown = sorted({int(v) for v in m.view})
    files = {dataset.camera_paths[v]: m.views[v].camera for v in shown}
    found.checks["camera"] = ", ".join(
        f"{path.name}: {camera.width} x {camera.height} px" for path, camera in files.items()
    )
    for note in notes_on_photographs(m, dataset.camera_paths, dataset.facts):
        found.add("camera", "error" if note.is_certain else "warning", note.what)
    for what in exact_cameras(dataset, choices):
        found.add("camera", "note", what)


def _look_at_parameters(found: _Found, rows: Sequence[int], choices: Choices) -> None:
    """Say whether some images can determine all that is planned to be estimated."""
    if not rows:
        return
    try:
        notes = check_identifiable(dataset_at(found.dataset, np.array(rows)), choices)
    except (NotIdentifiable, DidNotConverge) as error:
        found.checks["parameters"] = "not all of them can be identified"
        for what in error.problems:
            found.add("parameters", "error", what)
        return
    found.checks["parameters"] = "identifiable, if every view shows its legs"
    for what in notes:
        found.add("parameters", "note", what)


def _look_at_photographs(
    found: _Found, usable: list[int], pool: Run, report: Report
) -> dict[int, Exposure]:
    """Look at light, sharpness and equal pixels of photographs; return the first two by row.

    Those that cannot be decoded are taken out of the usable rows.
    """
    dataset, m = found.dataset, found.dataset.measurements
    rows = [row for row in usable if m.image[row] in dataset.facts]
    exposures, pixels = dict[int, Exposure](), dict[str, list[int]]()
    if not rows:
        return {}
    report(LOOKING, 0, len(rows))
    look = partial(_look, dataset.image_reader(range(m.n_rows)))
    for k, (row, (exposure, digest)) in enumerate(zip(rows, pool(look, rows), strict=True)):
        if exposure is None and found.refuses:
            raise DatasetError(digest)
        if exposure is None:
            found.add("files", "error", digest, [row])
            usable.remove(row)
        else:
            exposures[row] = exposure
            if not exposure.defect:
                pixels.setdefault(digest, []).append(row)
        report(LOOKING, k + 1, len(rows))
    defects = defects_of(m, exposures)
    blurs = [one.blur for row, one in exposures.items() if row not in defects]
    found.checks["photographs"] = f"{len(exposures) - len(defects)} of {len(rows)} show something"
    if blurs:
        found.checks["photographs"] += f", blurred by {float(np.median(blurs)):.1f} px"
    for what in defect_notes(m, defects):
        found.add("photographs", "warning", what)
    for same in (own for own in pixels.values() if len(own) > 1):
        several = len({int(m.pose[row]) for row in same}) > 1
        found.add(
            "files",
            "error" if several else "warning",
            f"{_sentence(images_in_words(m, same))} are the same photograph, "
            + (
                "with different readings: only one of them can be right"
                if several
                else "which would count more than once"
            )
            + "; remove the other rows, or name the photographs that belong to them.",
            same,
        )
    _look_at_views(found, {row: one for row, one in exposures.items() if row not in defects})
    for what in compression_notes(m, dataset.facts):
        found.add("photographs", "note", what)
    return exposures


def _look(load: ImageReader, row: int) -> tuple[Exposure | None, str]:
    """Return how an image was exposed and a digest of its pixels, or None and why it has none."""
    try:
        grey = load(row)
    except DatasetError as error:
        return None, error.problems[0]
    return measure_exposure(grey), hashlib.sha256(grey.tobytes()).hexdigest()


def _look_at_views(found: _Found, exposures: Mapping[int, Exposure]) -> None:
    """Look for views whose photographs are all blurred, or too bright."""
    m = found.dataset.measurements
    of_views = {
        view.name: own
        for v, view in enumerate(m.views)
        if (own := [one for row, one in exposures.items() if m.view[row] == v])
    }
    blur = {name: float(np.median([one.blur for one in own])) for name, own in of_views.items()}
    clipped = {
        name: float(np.median([one.clipped for one in own])) for name, own in of_views.items()
    }
    if soft := [name for name in blur if blur[name] > SOFT]:
        found.add(
            "photographs",
            "warning",
            f"The photographs of {few_views(soft)} are blurred by "
            f"{_range([blur[name] for name in soft])} px, needed {SOFT:g} px or less for outlines "
            "that are precise; focus on the legs, close the aperture, and let machine and camera "
            "stand still.",
        )
    if bright := [name for name in clipped if clipped[name] > CLIPPED]:
        found.add(
            "photographs",
            "note",
            f"In photographs of {few_views(bright)} "
            f"{_range([100.0 * clipped[name] for name in bright])} % of the pixels are as bright "
            "as a file can say: edges beside such places cannot be measured well; expose less if "
            "these are legs or what is behind them.",
        )


def _diagnose(found: _Found, data: OrderedDataset) -> None:
    """Try common mistakes where images contradict the session."""
    found.diagnosis = diagnose(data)
    found.checks["mistakes"] = (
        "one explains the images better" if found.diagnosis else "none explains the images better"
    )
    most = int(np.bincount(data.measurements.view).max())
    if most < MIN_IMAGES and not found.diagnosis and data.dataset.board_on("base") is None:
        found.checks["mistakes"] = "not tried: too few images of each view"
        found.add(
            "mistakes",
            "note",
            f"Mistakes in readings, model and images could not be looked for: found at most {most} "
            f"image{'s' * (most > 1)} of a view, needed {MIN_IMAGES} or more, since some camera "
            "pose suits fewer whatever is wrong; photograph more poses from one place.",
        )
    for one in found.diagnosis:
        found.add("mistakes", "error", one.sentence)


def _searched(found: _Found, data: OrderedDataset) -> Detection | None:
    """Search the images for the legs; None if that is refused."""
    m = data.dataset.measurements
    rows = np.array([row for row in range(m.n_rows) if m.image[row]], dtype=np.intp)
    if found.refuses and (views := views_to_click(data)):  # on the page that is written
        return unsearched(data, rows, views)
    try:
        return detected(data, rows)
    except (DatasetError, NotIdentifiable, NotVisible, DidNotConverge) as error:
        if found.refuses:
            raise
        found.checks["legs"] = "they could not be looked for"
        for what in error.problems:
            found.add("legs", "error", what)
        return None


def _look_at_legs(
    found: _Found, seen: Detection, views: Sequence[ViewCondition], choices: Choices
) -> None:
    """Judge what the images show of the legs, and what that determines."""
    outlines = seen.outlines
    found.checks["legs"] = (
        f"{sum(view.legs_found or 0 for view in views)} of "
        f"{sum(view.legs_visible or 0 for view in views)} found, "
        f"{np.count_nonzero(outlines.used)} of {len(outlines)} outlines can be used"
    )
    for what in unplaced_notes(seen.unplaced):
        found.add("legs", "error", what)
    told = {one.what for one in found.findings}
    odd = [one for one in seen.image_notes if one not in told]
    for what in notes_beside(found.diagnosis, odd, "legcal doctor"):
        found.add("legs", "note" if found.diagnosis else "warning", what)
    for what in seen.leg_notes:
        found.add("legs", "note", what)
    for view in views:
        n_found, n_visible = view.legs_found or 0, view.legs_visible or 0
        if not view.problem and n_found < FEW_LEGS * n_visible:
            why = reason_in_words(next(iter(view.rejected), Reason.OTHER))
            found.add(
                "legs",
                "warning",
                f"The photographs of view {view.view} show {n_found} of {n_visible} legs that they "
                f"should, needed most of them (the others mostly because {why}); look at legcal "
                "detect, and improve light and background.",
            )
    _judge_what_is_left(found, seen, choices)


def _judge_what_is_left(found: _Found, seen: Detection, choices: Choices) -> None:
    """Say whether the images and legs that were found determine the parameters."""
    dataset, m = seen.dataset, seen.dataset.measurements
    names = np.array([view.name for view in m.views])
    out = np.isin(np.arange(m.n_rows), list(seen.left_out)) | np.isin(
        names[m.view], list(seen.unplaced)
    )
    unseen = unseen_legs(dataset.machine, m, seen.outlines)
    if unseen and not out.all():
        found.add(
            "legs",
            "error",
            f"No photograph shows {few(unseen)} so that an outline can be used, needed some of "
            "every leg; add images that show it, or name the legs of each view in dataset.yaml to "
            "leave it to the readings.",
        )
    if out.any() and not out.all() and found.state("parameters") != "error":
        try:
            check_identifiable(dataset_at(dataset, np.flatnonzero(~out)), choices)
        except (NotIdentifiable, DidNotConverge) as error:
            found.checks["parameters"] = "the images that are left cannot determine all of them"
            for what in error.problems:
                found.add("parameters", "error", what)


def _conditions(
    dataset: Dataset, exposures: Mapping[int, Exposure], seen: Detection | None
) -> list[ViewCondition]:
    """Return what the photographs of each view are like, and what they show."""
    m = dataset.measurements
    found = []
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
        if seen is not None:
            condition = condition.model_copy(update=_outline_figures(seen, condition.view))
        found.append(condition)
    return found


def _outline_figures(seen: Detection, view: str) -> dict[str, Any]:
    """Return the figures of the outlines of a view, by the names of their fields."""
    m = seen.dataset.measurements
    names = np.array([one.name for one in m.views])
    outlines = seen.outlines.choose(names[m.view[seen.outlines.row]] == view)
    used, rods = outlines.used, along_legs(outlines, seen.dataset.machine.legs)
    rejected = Counter(
        str(why.reason) for why, ok in zip(outlines.reason, used, strict=True) if not ok
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
        "problem": str(seen.unplaced[view]) if view in seen.unplaced else None,
    }


def _count_legs(outlines: Outlines, chosen: BoolArray) -> int:
    """Return how many legs in images have one of the chosen outlines."""
    return len(set(zip(outlines.row[chosen].tolist(), outlines.leg[chosen].tolist(), strict=True)))


def _median(values: Sequence[float] | Array) -> float | None:
    """Return the median of the values that are finite; None without any."""
    finite = [value for value in values if np.isfinite(value)]
    return float(np.median(finite)) if finite else None


def _range(values: Sequence[float]) -> str:
    """Return values from the least to the greatest, in words."""
    least, greatest = (f"{float(f'{end(values):.2g}'):g}" for end in (min, max))
    return least if least == greatest else f"{least} to {greatest}"


def _sentence(words: str) -> str:
    return words[0].upper() + words[1:]
