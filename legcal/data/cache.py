"""The table of outlines as a cache of detection: the images to detect again, the rows to keep.

After detection the outlines are written to ``observations.csv`` beside the dataset, with a
fingerprint of all that detection depends on in ``.legcal-cache.json``. A table without that
file was given by the user: its images are not detected. Rows marked ``edited`` always win.
"""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from pydantic import Field, ValidationError

from legcal.data.dataset import CACHE_NAME, OBSERVATIONS_NAME, Dataset, rows_with_image
from legcal.data.image_tables import canonical_order, reorder_measurements
from legcal.data.measurements import places
from legcal.data.outlines import (
    Outlines,
    is_edited,
    no_outlines,
    with_body_edges,
    write_observations,
)
from legcal.files.folder import write_atomically
from legcal.files.schema import MAX_DOCUMENT, MAX_IMAGE, FileSchema, few, read_bytes
from legcal.geometry.types import BoolArray, IntArray
from legcal.version import __version__
from legcal.vision.board import board_document
from legcal.vision.image_file import Move

FORMAT = 1
_INCOMPLETE = "incomplete"  # the fingerprint while the table is being written: it matches nothing


class CacheEntry(FileSchema):
    """The content of ``.legcal-cache.json``."""

    format: int
    fingerprint: str  # of all that the detected outlines in the table came from
    given: list[tuple[str, str]]  # images with outlines from the user; they are never detected
    notes: tuple[str, ...] = ()  # notes on the images
    outlines: int = 0  # rows of the table; a table with fewer rows was changed
    moves: dict[str, Move] = Field(default_factory=dict)  # of images, by name


@dataclass(frozen=True, eq=False)
class DetectionPlan:
    """The images to detect, and the outlines to keep."""

    detect: IntArray  # (n,) rows of the measurements with images to be detected
    keep: Outlines  # outlines to use as they are
    given: BoolArray  # (n_rows,) rows with outlines from the user
    notes: tuple[str, ...] = ()  # notes on the images from the earlier detection
    is_cached: bool = False  # whether all outlines come from an earlier run
    moves: Mapping[str, Move] = field(default_factory=dict)  # of images, found by the earlier run


def plan_detection(
    table: Outlines | None,
    has_image: BoolArray,  # (n_rows,) whether a row has an image file
    recorded: str | None,
    current: str,
    from_user: BoolArray,  # (n_rows,)
) -> DetectionPlan:
    """Return the images to detect and the outlines of the table to keep."""
    if table is None:
        return DetectionPlan(np.flatnonzero(has_image), no_outlines(), np.zeros_like(has_image))
    edited = is_edited(table)
    listed = np.zeros_like(has_image)
    listed[table.row[~edited]] = True
    if recorded is None:
        return DetectionPlan(np.flatnonzero(has_image & ~listed), table, listed)
    if recorded == current:
        return DetectionPlan(np.zeros(0, dtype=np.intp), table, from_user)
    detect = has_image & ~(from_user & listed)
    keep = table.choose(edited | ~detect[table.row])
    return DetectionPlan(np.flatnonzero(detect), keep, from_user & listed)


def plan_dataset(dataset: Dataset, current: str) -> DetectionPlan:
    """Return :func:`plan_detection` for a dataset with the files in its folder."""
    entry = _read_entry(dataset.folder / CACHE_NAME)
    has_image = np.isin(np.arange(dataset.measurements.n_rows), rows_with_image(dataset))
    given_names = set(entry.given) if entry else set()
    from_user = np.array(
        [name in given_names for name in places(dataset.measurements)], dtype=np.bool_
    )
    recorded = entry.fingerprint if entry else None  # the format is part of the fingerprint
    if entry and dataset.observations is not None and len(dataset.observations) < entry.outlines:
        recorded = _INCOMPLETE
    plan = plan_detection(dataset.observations, has_image, recorded, current, from_user)
    if entry is None or recorded != current or len(plan.detect):
        return plan
    return replace(plan, notes=entry.notes, is_cached=True, moves=entry.moves)


def with_kept_moves(dataset: Dataset) -> Dataset:
    """Return a dataset whose images are shown as its kept outlines have them."""
    entry = _read_entry(dataset.folder / CACHE_NAME)
    return dataset if entry is None else replace(dataset, moves=entry.moves)


def note_on_missing_photographs(dataset: Dataset) -> list[str]:
    """Return a note on outlines of earlier detection whose photographs are no longer there."""
    entry, table = _read_entry(dataset.folder / CACHE_NAME), dataset.observations
    if entry is None or table is None:
        return []
    m, given = dataset.measurements, set(entry.given)
    names = places(m)
    missing = [
        m.image[row]
        for row in np.unique(table.row[~is_edited(table)]).tolist()
        if names[row] not in given
        and (path := dataset.image_path(row)) is not None
        and not os.path.exists(path)
    ]
    if not missing:
        return []
    if len(missing) == 1:
        return [f"The photograph {missing[0]} is missing; its cached outlines are used."]
    return [
        f"{len(missing)} photographs are missing ({few(missing)}); their cached outlines are used."
    ]


def fingerprint(dataset: Dataset, settings: Mapping[str, object]) -> str:
    """Return a fingerprint of all that detected outlines depend on.

    It covers the images, readings, views and cameras, the board and its pose, the mechanism's
    files, the encoder sigma, the settings of detection and the version of legcal; not the order
    of the rows.
    """
    digest = hashlib.sha256()
    for part in (*_described(dataset, settings), *_files(dataset)):
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)
    return digest.hexdigest()


def _described(dataset: Dataset, settings: Mapping[str, object]) -> list[bytes]:
    """Return settings, views, readings and board as bytes that do not depend on the rows' order."""
    leg_names = dataset.machine.leg_names
    order = canonical_order(dataset.measurements, leg_names)
    measurements = reorder_measurements(dataset.measurements, order)
    views = [
        [
            view.name,
            None if view.T_base_camera is None else view.T_base_camera.as_matrix().tolist(),
            None if view.legs is None else sorted(view.legs),
            [view.camera.model, view.camera.width, view.camera.height],
            [view.camera.gamma, view.camera.gamma_is_given],
            [view.camera.K.tolist(), view.camera.distortion.tolist()],
            None if view.camera.covariance is None else view.camera.covariance.tolist(),
            *(["placed"] if view.is_placed else []),
        ]
        for view in measurements.views
    ]
    rows = [measurements.image, measurements.view.tolist(), measurements.pose.tolist()]
    document = [FORMAT, __version__, settings, views, rows, measurements.sigma_q.tolist()]
    for fixed in dataset.boards:  # they place the cameras for the search of outlines
        T = fixed.T_link_board
        document.append(board_document(fixed.board))
        document.append(None if T is None else T.as_matrix().tolist())
        document += [] if fixed.link == "base" else [fixed.link]
    return [
        json.dumps(document, sort_keys=True).encode(),
        np.ascontiguousarray(measurements.q, dtype="<f8").tobytes(),
    ]


def _files(dataset: Dataset) -> list[bytes]:
    """Return meshes, and digests of the mechanism's files and of the images, sorted by name."""
    machine = dataset.machine
    models = [path for path in (machine.yaml_path, machine.urdf_path) if path is not None]
    images = sorted({image for image in dataset.measurements.image if image})
    meshes = [o.corners.tobytes() for o in machine.occluders if o.triangles is not None]
    files = [_digest(path) for path in (*models, *(dataset.folder / name for name in images))]
    return meshes + files


def _digest(path: Path) -> bytes:
    """Return the SHA-256 of a file; empty if it cannot be read."""
    try:
        return hashlib.sha256(read_bytes(path, MAX_IMAGE)).digest()
    except OSError:
        return b""


def store_outlines(
    dataset: Dataset,
    outlines: Outlines,
    current: str,
    from_user: BoolArray,  # (n_rows,) ``DetectionPlan.given``
    notes: Sequence[str] = (),
    body_edges: Outlines | None = None,
) -> str | None:
    """Write outlines and the fingerprint of their inputs beside the dataset.

    Until the table is complete the fingerprint matches nothing: if writing is interrupted, detected
    outlines are never mistaken for outlines from the user or for current ones.
    """
    names = zip(places(dataset.measurements), from_user, strict=True)
    entry = {
        "format": FORMAT,
        "fingerprint": _INCOMPLETE,
        "given": sorted(list(name) for name, is_given in names if is_given),
        "notes": list(notes),
        "outlines": len(outlines),
    } | ({"moves": dict(dataset.moves)} if dataset.moves else {})
    path = dataset.folder / OBSERVATIONS_NAME
    try:
        _write_entry(dataset.folder, entry)
        table = with_body_edges(outlines, body_edges)
        write_observations(path, table, dataset.measurements, dataset.machine.leg_names)
        _write_entry(dataset.folder, entry | {"fingerprint": current})
    except OSError as error:
        return (
            f"{path}: the outlines could not be kept: found '{error.strerror}', needed a folder "
            "that can be written to; the images will be searched again next time."
        )
    return None


def _write_entry(folder: Path, entry: Mapping[str, object]) -> None:
    write_atomically(folder / CACHE_NAME, (json.dumps(entry) + "\n").encode())


def _read_entry(path: Path) -> CacheEntry | None:
    """Return the content of the fingerprint file; an unreadable file matches nothing."""
    try:
        content = read_bytes(path, MAX_DOCUMENT)
        entry = CacheEntry.model_validate_json(content)
    except FileNotFoundError:
        return None
    except (OSError, ValidationError):
        return CacheEntry(format=0, fingerprint="unreadable", given=[])
    return entry
