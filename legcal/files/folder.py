"""The output folder: a set of files that appears complete or not at all.

A set of files is first written into a temporary folder beside its destination (in it, where it
is a file system of its own) and moved there when it is complete. A run that stops before that
leaves the destination as it was; what the temporary folder of a killed run leaves behind is never
looked at again.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Container, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath

from legcal.errors import DatasetError, LegcalError, OutOfResources, UsageError
from legcal.files.published import SCHEMAS, write_schemas
from legcal.files.reading import read_json
from legcal.files.schema import read_yaml
from legcal.signals import held_back_signals, raise_if_stopped

TEMPORARY_SUFFIX = ".legcal-part"
_HEAD = 1000  # bytes of a file, in which its mark stands
_MOST_OF_NAME = 40  # letters: a name of the greatest length leaves none for what is added to it


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file so that any other program sees its old or its new content, never a part."""
    with temporary_folder(path.parent, path.name) as folder:
        (folder / path.name).write_bytes(content)
        raise_if_stopped()
        os.replace(folder / path.name, path)
    if path.suffix == ".yaml":
        write_schemas(path)


@contextmanager
def temporary_folder(parent: Path, name: str) -> Iterator[Path]:
    """Give a folder of a name that nobody else uses, and remove it when the block ends."""
    folder = Path(
        tempfile.mkdtemp(prefix=f".{name[:_MOST_OF_NAME]}.", suffix=TEMPORARY_SUFFIX, dir=parent)
    )
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def path_problem(folder: Path, named: str) -> str | None:
    """Return what keeps a path from being a relative path inside a folder, or None.

    Symbolic links are followed: a link that leads out of the folder is a way out of it.
    """
    if PurePosixPath(named).is_absolute() or PureWindowsPath(named).is_absolute():
        return "an absolute path"
    try:
        target = (folder / named).resolve()
    except (OSError, RuntimeError, ValueError):
        return "a path that cannot be followed"
    if not target.is_relative_to(folder.resolve()):
        return "a path that leads out of the dataset folder"
    return None


@dataclass(frozen=True)
class OutputFile:
    """A kind of file."""

    noun: str  # what is written, with its article, for sentences: "the camera"
    what: str  # what the file is called where it cannot be read: "camera file"
    key: str  # the entry by which a YAML file of this kind is known; "" if it has none
    needed: str  # what may stand in its place, for sentences: "a new file or an earlier location"
    mark: bytes = b""  # by which any other file is known, near its beginning

    def check_place(self, path: Path, *, force: bool = False) -> None:
        """Refuse a place where no file can be written, or, without *force*, another one stands."""
        start = f"{path}: {self.noun} could not be written: found"
        if not path.name or os.path.isdir(path):
            raise UsageError(f"{start} a folder, needed the name of a file; give one in it.")
        if not os.path.isdir(path.parent):
            raise UsageError(
                f"{start} no folder {path.parent}, needed one that exists; create it or give "
                "another file."
            )
        said = _takes_no_files(path.parent)
        if said:
            raise UsageError(f"{start} {said}; give another file.")
        may_go = os.path.isfile(path) if force else self.is_at(path)
        if os.path.lexists(path) and not may_go:
            raise UsageError(
                f"{start} another file of that name, needed {self.needed}; give another file."
            )

    def is_at(self, path: Path) -> bool:
        """Say whether a file is of this kind."""
        try:
            if self.mark:
                with path.open("rb") as file:
                    return self.mark in file.read(_HEAD)
            return self.key != "" and self.key in read_yaml(path, self.what)
        except (DatasetError, OSError):
            return False

    def write(self, path: Path, content: str | bytes, *, force: bool = False) -> None:
        """Write a file; an earlier one of its kind is replaced, any other only with *force*."""
        self.check_place(path, force=force)
        try:
            data = content.encode() if isinstance(content, str) else content
            write_atomically(path, data)
        except OSError as error:
            raise OutOfResources(
                f"{path}: {self.noun} could not be written: found '{error.strerror}', needed a "
                "folder that takes it; free some space or give another file."
            ) from error


@dataclass(frozen=True)
class OutputKind:
    """A kind of output folder."""

    noun: str  # what the folder holds
    marker: str  # the JSON document that legcal leaves in such a folder; "" if others may be there
    key: str  # a key of that document

    def is_in(self, folder: Path) -> bool:
        """Say whether a folder holds an output of this kind that legcal wrote."""
        try:
            found = read_json(folder / self.marker)
        except (OSError, ValueError):
            return False
        return isinstance(found, dict) and self.key in found


RESULT = OutputKind("result", "result.json", "legcal_result")


def output_path(output: str | Path, kind: OutputKind = RESULT) -> Path:
    """Return the path of an output folder; refuse an empty text, which as a path would be "."."""
    if output == "":
        raise UsageError(
            f"The {kind.noun} could not be written: found an empty text, needed the path of a "
            "folder; name one, '.' for the current folder."
        )
    return Path(output)


def check_destination(destination: Path, kind: OutputKind = RESULT) -> None:
    """Refuse an output folder that holds something else than an earlier output of its kind."""
    check_path(destination, kind)
    start = f"{destination}: the {kind.noun} could not be written: found"
    is_new = not destination.is_dir() or not holds_files(destination)
    if kind.marker and not (is_new or kind.is_in(destination)):
        marker, remedy = f"no {kind.marker} of legcal", ""
        if (destination / kind.marker).is_file():
            marker = f"a {kind.marker} that is damaged or not of legcal"
            remedy = f"remove a damaged {kind.noun}, or "
        raise UsageError(
            f"{start} a folder with other files and {marker}, needed a new or empty folder or that "
            f"of an earlier {kind.noun}; {remedy}give another output folder."
        )


def check_path(destination: Path, kind: OutputKind = RESULT) -> None:
    """Refuse a path at which no folder is and none can be made, or that takes no files."""
    start = f"{destination}: the {kind.noun} could not be written: found"
    remedy = "needed a path that can be created; give another output folder."
    try:
        os.lstat(destination)
        if destination.is_dir():
            os.listdir(destination)
    except FileNotFoundError:
        pass
    except NotADirectoryError as error:
        above = existing_parent(destination)
        raise UsageError(f"{start} that {above} is a file, {remedy}") from error
    except OSError as error:
        raise UsageError(f"{start} '{error.strerror}', {remedy}") from error
    if destination.is_symlink() and not destination.exists():
        raise UsageError(f"{start} a broken link, needed a folder; give another output folder.")
    if destination.exists() and not destination.is_dir():
        raise UsageError(
            f"{start} a file of that name, needed a folder; give another output folder."
        )
    said = _takes_no_files(destination if destination.is_dir() else existing_parent(destination))
    if said:
        raise UsageError(f"{start} {said}; give another output folder.")


def in_the_way(destination: Path, kind: OutputKind, found: str) -> str:
    """Return what is said about something that stands where a file of an output belongs."""
    return (
        f"{destination}: the {kind.noun} could not be written: found {found}, needed its place; "
        "move it away, or give another folder; nothing was changed."
    )


def _takes_no_files(folder: Path) -> str:
    """Return what keeps files from being created in a folder and what is needed, or "".

    One is created: permissions say nothing of disks that are full or read-only, or of ``/proc``.
    """
    try:
        with temporary_folder(folder, "try") as own:
            (own / "file").write_bytes(b"legcal")
    except OSError as error:
        return (
            f"that {folder} takes no files ('{error.strerror or error}'), needed permission and "
            "room to create some"
        )
    return ""


def holds_files(folder: Path) -> bool:
    """Say whether a folder holds more than what killed runs left behind."""
    return any(not path.name.endswith(TEMPORARY_SUFFIX) for path in folder.iterdir())


def existing_parent(destination: Path) -> Path:
    """Return the nearest folder above that exists."""
    for parent in destination.absolute().parents:
        if parent.exists():
            return parent
    return Path(destination.absolute().anchor)


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
    """
    check_destination(destination, kind)
    try:
        with temporary_folder(_workshop(destination), destination.name) as temporary:
            new = temporary / "new"
            new.mkdir()
            with _named(destination, new):
                yield new
            for path in sorted(new.rglob("*.yaml")):
                write_schemas(path)
            _check_places(new, destination, kind, replaceable)
            destination.parent.mkdir(parents=True, exist_ok=True)
            raise_if_stopped()
            if destination.exists():
                _replace_files(new, destination, temporary / "old", stale)
            else:
                os.rename(new, destination)
    except OSError as error:
        raise OutOfResources(
            f"{destination}: the {kind.noun} could not be written: found "
            f"'{error.strerror or error}', needed a folder that takes its files; free some space "
            "or give another output folder; nothing was written."
        ) from error


@contextmanager
def _named(destination: Path, new: Path) -> Iterator[None]:
    """Let what is refused in the block speak of the destination, not of the temporary folder."""
    try:
        yield
    except LegcalError as error:
        raise error.told(lambda problem: problem.moved(new, destination)) from error


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
            elif (destination / name).exists() and not (destination / name).is_file():
                found = f"{name}, which is a pipe or a device"
            elif (
                replaceable is not None and name not in replaceable and name.parent.name != SCHEMAS
            ):
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
    return parent if is_near and not _takes_no_files(parent) else destination


def _replace_files(new: Path, destination: Path, old: Path, stale: Iterable[Path]) -> None:
    """Move files into a folder; if that is interrupted, put back what was there."""
    names = _files_in(new)
    gone = [name for name in stale if name not in names and (destination / name).is_file()]
    kept = [name for name in names if os.path.lexists(destination / name)] + gone
    for name in kept:
        (old / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(destination / name, old / name, follow_symlinks=False)
    with held_back_signals():
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
