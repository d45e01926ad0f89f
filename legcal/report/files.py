"""The output folder: a set of files that appears complete or not at all.

A set of files is first written into a temporary folder beside its destination (in it, where it
is a file system of its own) and moved there when it is complete. A run that stops before that
leaves the destination as it was; what the temporary folder of a killed run leaves behind is never
looked at again.
"""

import os
import shutil
from collections.abc import Container, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from legcal.errors import LegcalError, OutOfResources, UsageError
from legcal.files.atomic import temporary_folder
from legcal.report.destination import (
    RESULT,
    OutputKind,
    check_destination,
    existing_parent,
    in_the_way,
    is_writable,
)


@contextmanager
def result_folder(
    destination: Path,
    kind: OutputKind = RESULT,
    stale: Iterable[Path] = (),
    *,
    replaceable: Container[Path] | None = None,
) -> Iterator[Path]:
    """Give a temporary folder whose files become the result when the block ends well.

    An earlier result is replaced file by file; other files beside it are kept. If the block or
    the moving is interrupted, the destination is as it was before.

    Parameters
    ----------
    destination : Path
        The output folder; it and its parents are created at the end.
    kind : OutputKind
        What it is to hold.
    stale : iterable of Path
        Files of an earlier output, relative to the folder, that go where they are not replaced.
    replaceable : container of Path, optional
        The only files, relative to the folder, that may be replaced; all without it.

    Yields
    ------
    Path
        An empty folder to write into.

    Raises
    ------
    UsageError
        As :func:`check_destination`, before the block runs; or if something else stands in the
        place of a file, after it.
    OutOfResources
        If the files cannot be written, as on a full disk.
    """
    check_destination(destination, kind)
    try:
        with temporary_folder(_workshop(destination), destination.name) as temporary:
            new = temporary / "new"
            new.mkdir()
            with _named(destination, new):
                yield new
            _check_places(new, destination, kind, replaceable)
            destination.parent.mkdir(parents=True, exist_ok=True)
            if destination.exists():
                _replace_files(new, destination, temporary / "old", stale)
            else:
                os.rename(new, destination)
    except OSError as error:
        raise OutOfResources(
            f"{destination}: the {kind.noun} could not be written: found '{error.strerror}', "
            "needed a folder that takes its files; free some space or give another output folder; "
            "nothing was written."
        ) from error


@contextmanager
def _named(destination: Path, new: Path) -> Iterator[None]:
    """Let what is refused in the block speak of the destination, not of the temporary folder."""
    try:
        yield
    except LegcalError as error:
        said = [problem.replace(str(new), str(destination)) for problem in error.problems]
        raise type(error)(said) from error


def _check_places(
    new: Path, destination: Path, kind: OutputKind, replaceable: Container[Path] | None
) -> None:
    """Refuse to replace what is no file of an earlier output, and to write through links."""
    for name in _files_in(new):
        found = ""
        for parent in [destination / above for above in name.parents if above != Path()]:
            if parent.is_symlink() or (parent.exists() and not parent.is_dir()):
                found = f"{parent.relative_to(destination)}, which is no folder of its own"
        if not found and os.path.lexists(destination / name):
            if (destination / name).is_dir():
                found = f"{name}, which is a folder"
            elif replaceable is not None and name not in replaceable:
                found = f"{name}, which legcal did not write"
        if found:
            raise UsageError(in_the_way(destination, kind, found))


def _files_in(folder: Path) -> list[Path]:
    """Return the files of a folder, relative to it."""
    return [path.relative_to(folder) for path in sorted(folder.rglob("*")) if path.is_file()]


def _workshop(destination: Path) -> Path:
    """Return the folder for temporary files: beside the destination if they can move from there.

    Files do not move from one file system to another, and a folder that is one of its own (a
    mount) may stand where nothing else may be written: then it is the destination itself.
    """
    parent = existing_parent(destination)
    if not destination.is_dir():
        return parent
    is_near = parent.stat().st_dev == destination.stat().st_dev
    return parent if is_near and is_writable(parent) else destination


def _replace_files(new: Path, destination: Path, old: Path, stale: Iterable[Path]) -> None:
    """Move files into a folder; if that is interrupted, put back what was there."""
    names = _files_in(new)
    gone = [name for name in stale if name not in names and (destination / name).is_file()]
    kept = [name for name in names if os.path.lexists(destination / name)] + gone
    for name in kept:
        (old / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(destination / name, old / name, follow_symlinks=False)
    try:
        for name in names:
            (destination / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(new / name, destination / name)
        for name in gone:
            os.unlink(destination / name)
    except BaseException:
        for name in [*names, *gone]:
            with suppress(FileNotFoundError):
                if name in kept:
                    os.replace(old / name, destination / name)
                elif not (new / name).exists():
                    os.unlink(destination / name)
        raise
