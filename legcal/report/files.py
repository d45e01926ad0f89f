"""The output folder: a set of files that appears complete or not at all.

A set of files is first written into a temporary folder beside its destination and moved
there when it is complete. A run that stops before that leaves the destination as it was; what
the temporary folder of a killed run leaves behind is never looked at again.
"""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from legcal.errors import UsageError
from legcal.files.atomic import temporary_folder

RESULT_NAME = "result.json"
RESULT_KEY = "legcal_result"


def check_destination(destination: Path) -> None:
    """Refuse an output folder that holds something else than an earlier result.

    Parameters
    ----------
    destination : Path
        The output folder; it need not exist.

    Raises
    ------
    UsageError
        If it is a file, holds files but no result of legcal, or cannot be written to.
    """
    start = f"{destination}: the result could not be written: found"
    if destination.is_symlink() and not destination.exists():
        raise UsageError(f"{start} a broken link, needed a folder; give another output folder.")
    if destination.exists() and not destination.is_dir():
        raise UsageError(
            f"{start} a file of that name, needed a folder; give another output folder."
        )
    if destination.is_dir() and any(destination.iterdir()) and not _is_result(destination):
        raise UsageError(
            f"{start} a folder with other files and no {RESULT_NAME} of legcal, needed a new or "
            "empty folder or that of an earlier result; give another output folder."
        )
    parent = _existing_parent(destination)
    targets = [parent] + [destination] * destination.is_dir()
    for target in targets:
        if not (target.is_dir() and os.access(target, os.W_OK | os.X_OK)):
            raise UsageError(
                f"{start} that {target} cannot be written to, needed permission to create files "
                "in it; give another output folder."
            )


@contextmanager
def result_folder(destination: Path) -> Iterator[Path]:
    """Give a temporary folder whose files become the result when the block ends well.

    An earlier result is replaced file by file; other files beside it are kept. If the block or
    the moving is interrupted, the destination is as it was before.

    Parameters
    ----------
    destination : Path
        The output folder; it and its parents are created at the end.

    Yields
    ------
    Path
        An empty folder to write into.

    Raises
    ------
    UsageError
        As :func:`check_destination`, before the block runs.
    """
    check_destination(destination)
    with temporary_folder(_existing_parent(destination), destination.name) as temporary:
        new = temporary / "new"
        new.mkdir()
        yield new
        destination.parent.mkdir(parents=True, exist_ok=True)
        if destination.exists():
            _replace_files(new, destination, temporary / "old")
        else:
            os.rename(new, destination)


def _existing_parent(destination: Path) -> Path:
    """Return the nearest folder above that exists."""
    for parent in destination.absolute().parents:
        if parent.exists():
            return parent
    return Path(destination.absolute().anchor)


def _is_result(folder: Path) -> bool:
    """Say whether a folder holds a result that legcal wrote."""
    try:
        found = json.loads((folder / RESULT_NAME).read_bytes())
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(found, dict) and RESULT_KEY in found


def _replace_files(new: Path, destination: Path, old: Path) -> None:
    """Move files into a folder; if that is interrupted, put back what was there."""
    names = [path.relative_to(new) for path in sorted(new.rglob("*")) if path.is_file()]
    kept = [name for name in names if (destination / name).exists()]
    for name in kept:
        (old / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(destination / name, old / name)
    try:
        for name in names:
            (destination / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(new / name, destination / name)
    except BaseException:
        for name in names:
            with suppress(FileNotFoundError):
                if name in kept:
                    os.replace(old / name, destination / name)
                elif not (new / name).exists():
                    os.unlink(destination / name)
        raise
