"""The folder of a simulated dataset, with the truth beside what a calibration may see.

``truth/`` holds the true model, the exact outlines and ``truth.json``: settings and seed, where the
cameras and the platform really were. Nothing of the method reads it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from legcal.dataset.folder import CACHE_NAME, OBSERVATIONS_NAME
from legcal.errors import UsageError
from legcal.files.inside import path_problem
from legcal.report.files import OutputKind, check_destination, holds_files, result_folder

AXES_NAME = "axes.csv"
TRUTH = "truth"
TRUTH_NAME = f"{TRUTH}/truth.json"
SIMULATED = OutputKind("dataset", TRUTH_NAME, "legcal_truth")


def check_dataset_destination(destination: Path, *, force: bool) -> None:
    """Refuse an output folder that holds anything; with *force* only if that was not simulated.

    Raises
    ------
    UsageError
        With what is there instead.
    """
    if destination.is_dir() and holds_files(destination) and not force:
        there = "a simulated dataset" if SIMULATED.is_in(destination) else "a folder with files"
        remedy = "give another folder"
        if SIMULATED.is_in(destination):
            remedy += ", or replace it with --force"
        raise UsageError(
            f"{destination}: the dataset could not be written: found {there}, needed a new or "
            f"empty folder; {remedy}."
        )
    check_destination(destination, SIMULATED)


@contextmanager
def dataset_folder(destination: Path, *, force: bool) -> Iterator[Path]:
    """Give a temporary folder that becomes the dataset when the block ends well.

    With *force* the files of an earlier simulated dataset go, and so do the outlines that a
    calibration left there; other files beside them are kept.

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
    with result_folder(destination, SIMULATED, _earlier(destination)) as folder:
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
    names += [OBSERVATIONS_NAME, AXES_NAME, CACHE_NAME]
    return [Path(name) for name in dict.fromkeys(names) if path_problem(destination, name) is None]
