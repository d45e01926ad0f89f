"""The folder of ``legcal detect``: the table, the pictures, a page and a document.

Its table is there to be corrected: one that was changed since is never written over.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from legcal.dataset.dataset import ImageReader
from legcal.dataset.folder import OBSERVATIONS_NAME
from legcal.errors import OutOfResources, UsageError
from legcal.files.inside import path_problem
from legcal.observations.sets import choose_outlines
from legcal.observations.table import row_names, write_observations
from legcal.overlays.detected import Detection
from legcal.overlays.drawing import draw
from legcal.overlays.figures import view_figures
from legcal.overlays.marks import PartMarks, marks_of_image
from legcal.overlays.page import overlay_page
from legcal.progress import Report
from legcal.report.destination import OutputKind, check_destination
from legcal.report.files import result_folder
from legcal.workers import Run

DETECTION = OutputKind("detection", "detection.json", "legcal_detection")
PAGE = "index.html"
PICTURES = "overlays"
QUALITY_JPEG = 88
_SAFE = re.compile(r"[^A-Za-z0-9_.-]+")
_LONGEST = 80  # letters of a name


def check_detection_destination(destination: Path, dataset: Path | None) -> None:
    """Refuse an output folder that holds something else, or a table that was corrected.

    Parameters
    ----------
    destination : Path
        The output folder.
    dataset : Path or None
        The dataset folder, where it is known: a corrected table that was copied there is safe.

    Raises
    ------
    UsageError
        With what is there instead.
    """
    check_destination(destination, DETECTION)
    table = destination / OBSERVATIONS_NAME
    written = _earlier(destination).get("table")
    with suppress(OSError):
        content = table.read_bytes()
        if written == hashlib.sha256(content).hexdigest():
            return
        if dataset is not None:
            with suppress(OSError):
                if (dataset / OBSERVATIONS_NAME).read_bytes() == content:
                    return
        raise UsageError(
            f"{table}: the detection could not be written: found a table that was changed since "
            "legcal wrote it, needed one to write over; copy it into the dataset, where its edited "
            "rows are kept, or give another output folder; nothing was changed."
        )


def write_detection(
    detection: Detection, destination: Path, run: Run, progress: Report
) -> dict[str, Any]:
    """Write the folder, all of it or nothing, and return its document.

    Parameters
    ----------
    detection : Detection
        What was found.
    destination : Path
        The output folder.
    run : callable
        How pictures are drawn: in turn or by several processes.
    progress : callable
        Called as ``progress(stage, done, total)``.

    Raises
    ------
    UsageError
        As :func:`check_detection_destination`.
    OutOfResources
        If the files cannot be written.
    """
    dataset = detection.dataset
    check_detection_destination(destination, dataset.folder)
    earlier = _own_files(destination)
    pictures = picture_names(detection)
    with result_folder(destination, DETECTION, earlier, replaceable=earlier) as folder:
        table = folder / OBSERVATIONS_NAME
        names = dataset.mechanism.leg_names
        write_observations(table, detection.outlines, dataset.measurements, names)
        _draw_all(detection, folder, pictures, run, progress)
        document = detection_document(detection, pictures)
        (folder / PAGE).write_text(
            overlay_page(detection, document, pictures), encoding="utf-8", newline="\n"
        )
        files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.*"))
        record = {
            **document,
            "table": hashlib.sha256(table.read_bytes()).hexdigest(),
            "files": [*files, DETECTION.marker],
        }
        (folder / DETECTION.marker).write_text(json.dumps(record, indent=1) + "\n", "utf-8")
    return document


def detection_document(detection: Detection, pictures: Mapping[int, str]) -> dict[str, Any]:
    """Return what ``--json`` prints; *pictures* are the files of rows, relative to the folder."""
    figures = view_figures(detection)
    outlines = detection.outlines
    names = row_names(detection.dataset.measurements)
    return {
        "legcal_detection": 1,
        "mechanism": detection.dataset.mechanism.name,
        "views": {name: view.document() for name, view in figures.items()},
        "images": len(detection.rows),
        "outlines": len(outlines),
        "used": int(np.count_nonzero(outlines.used)),
        "overlays": [
            {"view": detection.view_of(row), "image": names[row], "file": file}
            for row, file in pictures.items()
        ],
        "notes": list(detection.notes),
    }


def picture_names(detection: Detection) -> dict[int, str]:
    """Return the file of each row's picture, relative to the folder: by view and image."""
    measurements = detection.dataset.measurements
    folders = _unique([view.name for view in measurements.views])
    found: dict[int, str] = {}
    for v, folder in enumerate(folders):
        rows = [row for row in detection.rows.tolist() if measurements.view[row] == v]
        images = [measurements.image[row] for row in rows]
        stems = [Path(image).stem for image in images]
        if len({stem.lower() for stem in stems}) < len(stems):
            stems = images
        for row, stem in zip(rows, _unique(stems), strict=True):
            found[row] = f"{PICTURES}/{folder}/{stem}.jpg"
    return found


def _unique(names: Sequence[str]) -> list[str]:
    """Return names that can be those of files, each another one whatever the file system."""
    found: list[str] = []
    taken: set[str] = set()
    for name in names:
        plain = _SAFE.sub("_", name).lstrip(".")[:_LONGEST] or "_"
        k, chosen = 1, plain
        while chosen.lower() in taken:
            k += 1
            chosen = f"{plain}-{k}"
        taken.add(chosen.lower())
        found.append(chosen)
    return found


@dataclass(frozen=True, eq=False)
class _Gallery:
    """What is drawn of every row, and where; it travels to worker processes."""

    load: ImageReader
    marks: tuple[tuple[PartMarks, ...], ...]
    captions: tuple[str, ...]
    files: tuple[Path, ...]


def _draw_all(
    detection: Detection, folder: Path, pictures: Mapping[int, str], run: Run, progress: Report
) -> None:
    """Write the picture of every row that has an image."""
    rows = list(pictures)
    for file in pictures.values():
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
    gallery = _Gallery(
        detection.dataset.image_reader(rows),
        tuple(tuple(_marks(detection, row)) for row in rows),
        tuple(_caption(detection, row) for row in rows),
        tuple(folder / file for file in pictures.values()),
    )
    progress("Drawing overlays", 0, len(rows))
    for done, _ in enumerate(run(partial(_write_picture, gallery), range(len(rows))), start=1):
        progress("Drawing overlays", done, len(rows))


def _write_picture(gallery: _Gallery, k: int) -> None:
    """Draw picture k and write it."""
    picture = draw(gallery.load(k), gallery.marks[k], gallery.captions[k])
    ok, content = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY_JPEG])
    if not ok:
        raise OutOfResources(
            f"{gallery.files[k].name}: the picture could not be written: found that it cannot be "
            "encoded, needed enough memory; try again with fewer workers."
        )
    gallery.files[k].write_bytes(content.tobytes())


def _marks(detection: Detection, row: int) -> list[PartMarks]:
    """Return what is drawn over the image of a row."""
    measurements, outlines = detection.dataset.measurements, detection.outlines
    camera = measurements.views[int(measurements.view[row])].camera
    return marks_of_image(
        camera,
        choose_outlines(outlines, outlines.row == row),
        detection.predicted(row),
        detection.dataset.mechanism.leg_names,
    )


def _caption(detection: Detection, row: int) -> str:
    """Return what stands below the picture of a row."""
    view, outlines = detection.view_of(row), detection.outlines
    measurements = detection.dataset.measurements
    here = outlines.used[outlines.row == row]
    said = f"{np.count_nonzero(here)} of {len(here)} outlines used"
    if view in detection.unplaced:
        said = "the camera could not be placed"
        if detection.T_base_camera[int(measurements.view[row])] is not None:
            said += ": legs are drawn where it was expected"
    text = f"{view}  {measurements.image[row]}  {said}"
    return text.encode("ascii", "replace").decode()


def _earlier(destination: Path) -> dict[str, Any]:
    """Return the document of an earlier detection in a folder; empty if there is none."""
    if not DETECTION.is_in(destination):
        return {}
    found: dict[str, Any] = json.loads((destination / DETECTION.marker).read_bytes())
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
    own = {Path(OBSERVATIONS_NAME), Path(PAGE), Path(DETECTION.marker)}
    return name in own or (name.parts[0] == PICTURES and name.suffix == ".jpg")
