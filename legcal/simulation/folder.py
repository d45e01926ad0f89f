"""The folder of a simulated dataset, with the truth beside what a calibration may see.

``truth/`` holds the true model, the exact outlines and ``truth.json``: settings and seed, where the
cameras and the platform really were. Nothing of the method reads it.
"""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from legcal.dataset.folder import CACHE_NAME, OBSERVATIONS_NAME
from legcal.dataset.given_axes import AXES_NAME
from legcal.dataset.given_corners import CORNERS_NAME
from legcal.errors import UsageError
from legcal.files.inside import path_problem
from legcal.report.destination import (
    OutputKind,
    check_destination,
    check_path,
    holds_files,
    in_the_way,
)
from legcal.report.files import result_folder

TRUTH = "truth"
TRUTH_NAME = f"{TRUTH}/truth.json"
_FOLDERS = ("images", "models", "urdf", TRUTH)
_TABLES = ("measurements.csv", OBSERVATIONS_NAME, AXES_NAME, CORNERS_NAME)
_FILES = ("dataset.yaml", *_TABLES, "camera_info*.yaml")
SIMULATED = OutputKind("dataset", TRUTH_NAME, "legcal_truth")


def check_dataset_destination(destination: Path, *, force: bool) -> None:
    """Refuse an output folder that holds anything; with *force* only if that was not simulated.

    Raises
    ------
    UsageError
        With what is there instead. With *force* also if something else than the files of the
        simulated dataset stands where a dataset has its own.
    """
    check_path(destination, SIMULATED)
    if destination.is_dir() and holds_files(destination) and not force:
        there = "a simulated dataset" if SIMULATED.is_in(destination) else "a folder with files"
        remedy = "give another folder"
        if SIMULATED.is_in(destination):
            remedy += ", or replace it with --force (in Python: force=True)"
        raise UsageError(
            f"{destination}: the dataset could not be written: found {there}, needed a new or "
            f"empty folder; {remedy}."
        )
    check_destination(destination, SIMULATED)
    foreign = _foreign(destination)
    if foreign:
        raise UsageError(in_the_way(destination, SIMULATED, foreign))


@contextmanager
def dataset_folder(destination: Path, *, force: bool) -> Iterator[Path]:
    """Give a temporary folder that becomes the dataset when the block ends well.

    With *force* the files of an earlier simulated dataset go, and so do the outlines that a
    calibration left there; other files beside them are kept. Nothing else is replaced.

    Parameters
    ----------
    destination : Path
        The folder of the dataset.
    force : bool
        Replace a simulated dataset that is there.

    Raises
    ------
    UsageError
        As :func:`check_dataset_destination`.
    OutOfResources
        If the files cannot be written; nothing is then changed.
    """
    check_dataset_destination(destination, force=force)
    earlier = _earlier(destination)
    with result_folder(destination, SIMULATED, earlier, replaceable=earlier) as folder:
        yield folder


def files_in(folder: Path) -> list[str]:
    """Return the files of a folder, relative to it, in order."""
    found = [path.relative_to(folder) for path in folder.rglob("*") if path.is_file()]
    return [path.as_posix() for path in sorted(found)]


def _earlier(destination: Path) -> list[Path]:
    """Return the files of the simulated dataset in a folder, and what calibration left there."""
    if not SIMULATED.is_in(destination):
        return []
    named = json.loads((destination / TRUTH_NAME).read_bytes()).get("files", [])
    names = [name for name in named if isinstance(name, str)] if isinstance(named, list) else []
    if _is_detected(destination):
        names += [OBSERVATIONS_NAME, CACHE_NAME]
    own = [Path(name) for name in dict.fromkeys(names) if path_problem(destination, name) is None]
    return [name for name in own if _is_place(name) or name == Path(CACHE_NAME)]


def _is_detected(folder: Path) -> bool:
    """Say whether a calibration left the table of outlines, and nobody gave or corrected a row."""
    try:
        if json.loads((folder / CACHE_NAME).read_bytes()).get("given"):
            return False
        with (folder / OBSERVATIONS_NAME).open(encoding="utf-8-sig", newline="") as file:
            return all(row.get("source") != "edited" for row in csv.DictReader(file))
    except FileNotFoundError as error:
        return Path(error.filename).name == OBSERVATIONS_NAME
    except (OSError, ValueError, AttributeError, RecursionError, csv.Error):
        return False


def _is_place(name: Path) -> bool:
    """Say whether a path in a dataset is one where simulation writes."""
    if ".." in name.parts:
        return False
    is_file = len(name.parts) == 1 and any(name.match(file) for file in _FILES)
    return is_file or name.parts[:1] in {(folder,) for folder in _FOLDERS}


def _foreign(destination: Path) -> str:
    """Return what stands in the places of a dataset and is none of its files, "" for nothing."""
    if not destination.is_dir():
        return ""
    own = set(_earlier(destination))
    folders = {parent for name in own for parent in name.parents}
    for above, inside, files in os.walk(destination):
        here = Path(above).relative_to(destination)
        for name in sorted([here / name for name in inside + files]):
            path = destination / name
            if not _is_place(name) or name.name.startswith("."):
                continue
            if path.is_symlink():
                return f"{name}, which is a link"
            if path.is_dir() and name not in folders and not _is_plain(name):
                return f"{name}, which is a folder"
            if not path.is_dir() and name not in own:
                return f"{name}, which an earlier simulation did not write"
        if here == Path():
            inside[:] = [name for name in inside if name in _FOLDERS]
    return ""


def _is_plain(name: Path) -> bool:
    """Say whether every dataset may have a folder of that name."""
    return name.as_posix() in (*_FOLDERS, f"{TRUTH}/models", f"{TRUTH}/urdf")
