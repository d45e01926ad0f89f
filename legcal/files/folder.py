"""The output folder: a set of files that appears complete or not at all.

A set of files is first written into a temporary folder beside its destination (inside it, if it is
a separate file system) and moved there when it is complete. A run that stops before that leaves the
destination as it was; temporary folders left behind by killed runs are ignored.

The files in ``schemas`` are made from the models that read and write the formats, by
``tests/format_schemas.py``. A YAML that legcal writes names its schema in its first line, relative
to itself, and the schema is written beside it: editors find it offline, wherever the folder goes.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Container, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path, PurePosixPath, PureWindowsPath

from legcal.errors import DatasetError, LegcalError, OutOfResources, UsageError
from legcal.files.schema import few, read_json, read_yaml
from legcal.signals import held_back_signals, raise_if_stopped

TEMPORARY_SUFFIX = ".legcal-part"
ANOTHER_FOLDER = "give another folder; nothing was written"  # a remedy where there is no space
_HEAD = 1000  # bytes at the beginning of a file that contain its mark
_MOST_OF_NAME = 40  # maximum letters of a name, which leave room for an addition


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
    """Return in words why a path is not a relative path inside a folder, or None if it is.

    Symbolic links are followed: a link may not lead out of the folder.
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

    noun: str  # the content, with its article, for sentences: "the camera"
    what: str  # name of the file in messages about reading it: "camera file"
    key: str  # the entry that identifies a YAML file of this kind; "" if it has none
    needed: str  # acceptable file in its place, for sentences: "a new file or an earlier location"
    mark: bytes = b""  # bytes near the beginning that identify a file of another format

    def check_place(self, path: Path, *, force: bool = False) -> None:
        """Refuse a path where no file can be written, or, without *force*, with another file."""
        found, remedy = "", "give another file"
        may_go = os.path.isfile(path) if force else self.is_at(path)
        if not path.name or os.path.isdir(path):
            found, remedy = "a folder, needed the name of a file", "give one in it"
        elif not os.path.isdir(path.parent):
            found = f"no folder {path.parent}, needed one that exists"
            remedy = f"create it or {remedy}"
        elif refusal := takes_no_files(path.parent):
            found = refusal
        elif os.path.lexists(path) and not may_go:
            found = f"another file of that name, needed {self.needed}"
        if found:
            raise UsageError(f"{path}: {self.noun} could not be written: found {found}; {remedy}.")

    def is_at(self, path: Path) -> bool:
        """Return whether a file is of this kind."""
        try:
            if self.mark:
                with path.open("rb") as file:
                    return self.mark in file.read(_HEAD)
            return self.key != "" and self.key in read_yaml(path, self.what)
        except (DatasetError, OSError):
            return False

    def write(self, path: Path, content: str | bytes, *, force: bool = False) -> None:
        """Write a file; an earlier file of its kind is replaced, any other only with *force*."""
        self.check_place(path, force=force)
        with out_of_resources(path, self.noun, "give another file"):
            write_atomically(path, content.encode() if isinstance(content, str) else content)


@dataclass(frozen=True)
class OutputKind:
    """A kind of output folder."""

    noun: str  # the content of the folder, for sentences
    marker: str  # the JSON document that legcal leaves in such a folder; "" if others may be there
    key: str  # a key of that document

    def is_in(self, folder: Path) -> bool:
        """Return whether a folder holds an output of this kind written by legcal."""
        try:
            document = read_json(folder / self.marker)
        except (OSError, ValueError):
            return False
        return isinstance(document, dict) and self.key in document


RESULT = OutputKind("result", "result.json", "legcal_result")


def output_path(output: str | Path, kind: OutputKind = RESULT) -> Path:
    """Return the path of an output folder; refuse an empty text, which would mean "."."""
    if output == "":
        raise UsageError(
            f"The {kind.noun} could not be written: found an empty text, needed the path of a "
            "folder; name one, '.' for the current folder."
        )
    return Path(output)


def check_destination(
    destination: Path, kind: OutputKind = RESULT, *, replaces: bool = True
) -> None:
    """Refuse an output folder that holds files, unless it *replaces* earlier output of its kind."""
    check_path(destination, kind)
    is_earlier = kind.is_in(destination)
    is_new = not destination.is_dir() or not holds_files(destination)
    if is_new or (replaces and (is_earlier or not kind.marker)):
        return
    found, needed, remedy = "a folder with files", "a new or empty folder", "give another folder"
    if is_earlier:
        found, remedy = f"an earlier {kind.noun}", f"{remedy}, or remove that one"
    elif replaces:
        found = "a folder with other files and"
        needed += f" or that of an earlier {kind.noun}"
        if (destination / kind.marker).is_file():
            found += f" a {kind.marker} that is damaged or not of legcal"
            remedy = f"remove a damaged {kind.noun}, or {remedy}"
        else:
            found += f" no {kind.marker} of legcal"
    raise UsageError(
        f"{destination}: the {kind.noun} could not be written: found {found}, needed {needed}; "
        f"{remedy}."
    )


def check_path(destination: Path, kind: OutputKind = RESULT) -> None:
    """Refuse a path where no folder exists or can be made, or that cannot be written to."""
    needed = "needed a path that can be created"
    try:
        os.lstat(destination)
        if destination.is_dir():
            os.listdir(destination)
            found = takes_no_files(destination)
        elif destination.exists():
            found = "a file of that name, needed a folder"
        else:
            found = "a broken link, needed a folder"
    except FileNotFoundError:
        found = takes_no_files(existing_parent(destination))
    except NotADirectoryError:
        found = f"that {existing_parent(destination)} is a file, {needed}"
    except OSError as error:
        found = f"'{error.strerror}', {needed}"
    if found:
        raise UsageError(
            f"{destination}: the {kind.noun} could not be written: found {found}; give another "
            "output folder."
        )


def in_the_way(destination: Path, kind: OutputKind, actual: str) -> str:
    """Return the message about an obstacle at the path of an output file."""
    return (
        f"{destination}: the {kind.noun} could not be written: found {actual}, needed its place; "
        "move it away, or give another folder; nothing was changed."
    )


def takes_no_files(folder: Path) -> str:
    """Return in words why files cannot be created in a folder and the remedy, or "" if they can.

    A file is created as a test: permissions do not tell of full or read-only disks, or ``/proc``.
    """
    try:
        with temporary_folder(folder, "try") as trial:
            (trial / "file").write_bytes(b"legcal")
    except OSError as error:
        return (
            f"that {folder} takes no files ('{error.strerror or error}'), needed permission and "
            "room to create some"
        )
    return ""


def holds_files(folder: Path) -> bool:
    """Return whether a folder holds files other than leftovers of killed runs."""
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
    """Give a temporary folder; its files become the result when the block ends without error.

    An earlier result is replaced file by file; other files beside it are kept. If the block or
    the moving is interrupted, the destination is unchanged.
    """
    check_destination(destination, kind)
    with (
        out_of_resources(destination, f"the {kind.noun}", ANOTHER_FOLDER),
        temporary_folder(_workshop(destination), destination.name) as temporary,
    ):
        new = temporary / "new"
        new.mkdir()
        try:
            yield new
        except LegcalError as error:
            raise error.map_problems(lambda problem: problem.moved(new, destination)) from error
        for path in sorted(new.rglob("*.yaml")):
            write_schemas(path)
        _check_places(new, destination, kind, replaceable)
        destination.parent.mkdir(parents=True, exist_ok=True)
        raise_if_stopped()
        if destination.exists():
            _replace_files(new, destination, temporary / "old", stale)
        else:
            os.rename(new, destination)


@contextmanager
def out_of_resources(place: Path, noun: str, remedy: str) -> Iterator[None]:
    """Make errors of the system in the block a refusal; *remedy* is the other way out."""
    try:
        yield
    except OSError as error:
        raise OutOfResources(
            f"{noun} could not be written",
            f"'{error.strerror or error}'",
            "a folder that takes it",
            f"free some space or {remedy}",
            place,
        ) from error


@contextmanager
def new_files(
    folder: Path, noun: str, names: Iterable[str], *, force: bool | None = None
) -> Iterator[Path]:
    """Give a temporary folder for files of some names, as :func:`result_folder`.

    Files that are there are replaced only with *force*, None where the command has no such option.
    """
    there = [name for name in names if os.path.lexists(folder / name)]
    if there and not force:
        replaced = "" if force is None else ", or --force to replace them"
        raise UsageError(
            f"{folder}: the {noun} could not be written: found {few(there)} already there, needed "
            f"new files; give another folder or name{replaced}."
        )
    with result_folder(folder, OutputKind(noun, "", "")) as temporary:
        yield temporary


def _check_places(
    new: Path, destination: Path, kind: OutputKind, replaceable: Container[Path] | None
) -> None:
    """Refuse to replace anything but files of an earlier output, and to write through links."""
    for name in _files_in(new):
        obstacle = ""
        for parent in [destination / above for above in name.parents if above != Path()]:
            if parent.is_symlink() or (parent.exists() and not parent.is_dir()):
                obstacle = f"{parent.relative_to(destination)}, which is no folder of its own"
        if not obstacle and os.path.lexists(destination / name):
            if (destination / name).is_dir():
                obstacle = f"{name}, which is a folder"
            elif (destination / name).exists() and not (destination / name).is_file():
                obstacle = f"{name}, which is a pipe or a device"
            elif (
                replaceable is not None and name not in replaceable and name.parent.name != SCHEMAS
            ):
                obstacle = f"{name}, which legcal did not write"
        if obstacle:
            raise UsageError(in_the_way(destination, kind, obstacle))


def _files_in(folder: Path) -> list[Path]:
    """Return the files of a folder, relative to it."""
    return [path.relative_to(folder) for path in sorted(folder.rglob("*")) if path.is_file()]


def _workshop(destination: Path) -> Path:
    """Return the folder for temporary files: beside the destination if they can move from there.

    Files do not move between file systems, and the folder above a mount point may not be writable:
    then it is the destination itself.
    """
    parent = existing_parent(destination)
    if not destination.is_dir():
        return parent
    is_near = parent.stat().st_dev == destination.stat().st_dev
    return parent if is_near and not takes_no_files(parent) else destination


def _replace_files(new: Path, destination: Path, old: Path, stale: Iterable[Path]) -> None:
    """Move files into a folder; if that is interrupted, restore the previous files."""
    names = sorted(_files_in(new), key=lambda name: name.suffix == ".yaml")  # they name the others
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


SCHEMAS = ".schemas"  # folder of schemas beside a YAML
_HEADER = f"# yaml-language-server: $schema={SCHEMAS}/%s.json\n"
_NAMED = re.compile(re.escape(_HEADER).replace("%s", r"([\w.-]+)").encode())


def schema_names() -> list[str]:
    """Return the names of the formats that have a schema."""
    file_names = (entry.name for entry in files("legcal.files").joinpath("schemas").iterdir())
    return sorted(name.removesuffix(".json") for name in file_names)


def schema_content(name: str) -> bytes:
    """Return the content of the schema file of a format."""
    return files("legcal.files").joinpath("schemas", f"{name}.json").read_bytes()


def with_schema(name: str, text: str) -> str:
    """Return the text of a YAML with a header that names its schema."""
    return _HEADER % name + text


def write_schemas(path: Path) -> None:
    """Write the schema that a YAML names beside it, or nothing where there is no place for it."""
    with suppress(OSError):  # it only helps editors
        with path.open("rb") as file:
            named = _NAMED.match(file.readline())
        if named is not None and (name := named[1].decode()) in schema_names():
            place = path.parent / SCHEMAS / f"{name}.json"
            if not place.is_symlink() and not place.parent.is_symlink():
                place.parent.mkdir(exist_ok=True)
                place.write_bytes(schema_content(name))
