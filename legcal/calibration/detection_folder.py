"""The folder of ``legcal detect``: the table of outlines, a page and an overlay of every image."""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from legcal.calibration.detection import OVERLAYS, PHOTOGRAPHS, Detection
from legcal.calibration.examination import Examination
from legcal.calibration.examination_page import DETECTION_PAGE, examination_page
from legcal.data.corners import write_corners
from legcal.data.dataset import CORNERS_NAME, OBSERVATIONS_NAME, ImageReader
from legcal.data.outlines import write_observations
from legcal.errors import OutOfResources, UsageError
from legcal.files.folder import OutputKind, check_destination, path_problem, result_folder
from legcal.files.reading import MAX_IMAGE, read_bytes, read_json
from legcal.perception.overlays import (
    Mark,
    PartMarks,
    draw,
    marks_of_corners,
    marks_of_image,
    marks_of_pairs,
)
from legcal.progress import Report
from legcal.vision.camera import Camera
from legcal.workers import Run

DETECTION = OutputKind("detection", "detection.json", "legcal_detection")
JPEG_QUALITY = 88  # percent


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
    """Return the marks of the parts in the image of a row."""
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
    """Return the marks of the board corners in the image of a row."""
    corners = detection.corners
    return () if corners is None else marks_of_corners(corners.choose(corners.row == row))


def _caption(detection: Detection, row: int) -> str:
    """Return the caption of the overlay of a row."""
    view, outlines = detection.view_of(row), detection.outlines
    measurements = detection.dataset.measurements
    used = outlines.used[outlines.row == row]
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
    named = _earlier(destination).get("files", [])
    names = [name for name in named if isinstance(name, str)] if isinstance(named, list) else []
    return [
        Path(name)
        for name in dict.fromkeys(names)
        if path_problem(destination, name) is None and _is_place(Path(name))
    ]


def _is_place(name: Path) -> bool:
    """Return whether a detection may contain a file of this relative path."""
    if ".." in name.parts:
        return False
    tables = {
        Path(OBSERVATIONS_NAME),
        Path(CORNERS_NAME),
        Path(DETECTION_PAGE),
        Path(DETECTION.marker),
    }
    return name in tables or is_overlay(name) or is_overlay(name, PHOTOGRAPHS)


def is_overlay(name: Path, folder: str = OVERLAYS) -> bool:
    """Return whether a relative path is that of an overlay, or another picture of an image."""
    return ".." not in name.parts and name.parts[:1] == (folder,) and name.suffix == ".jpg"
