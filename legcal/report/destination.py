"""Where an output folder may be: what stands there already, and whether it may be replaced."""

import json
import os
from dataclasses import dataclass
from pathlib import Path

from legcal.errors import UsageError
from legcal.files.atomic import TEMPORARY_SUFFIX


@dataclass(frozen=True)
class OutputKind:
    """A kind of output folder.

    Attributes
    ----------
    noun : str
        What the folder holds.
    marker, key : str
        The JSON document that legcal leaves in such a folder, and a key in it.
    """

    noun: str
    marker: str
    key: str

    def is_in(self, folder: Path) -> bool:
        """Say whether a folder holds an output of this kind that legcal wrote."""
        try:
            found = json.loads((folder / self.marker).read_bytes())
        except (OSError, ValueError, RecursionError):
            return False
        return isinstance(found, dict) and self.key in found


RESULT = OutputKind("result", "result.json", "legcal_result")


def output_path(output: str | Path, kind: OutputKind = RESULT) -> Path:
    """Return the path of an output folder; an empty text is none, where a path would be ".".

    Raises
    ------
    UsageError
        If it is empty.
    """
    if output == "":
        raise UsageError(
            f"The {kind.noun} could not be written: found an empty text, needed the path of a "
            "folder; name one, '.' for the current folder."
        )
    return Path(output)


def check_destination(destination: Path, kind: OutputKind = RESULT) -> None:
    """Refuse an output folder that holds something else than an earlier output of its kind.

    Parameters
    ----------
    destination : Path
        The output folder; it need not exist.
    kind : OutputKind
        What it is to hold.

    Raises
    ------
    UsageError
        If it is a file, holds files but nothing of this kind, or cannot be written to.
    """
    check_path(destination, kind)
    start = f"{destination}: the {kind.noun} could not be written: found"
    if destination.is_dir() and holds_files(destination) and not kind.is_in(destination):
        raise UsageError(
            f"{start} a folder with other files and no {kind.marker} of legcal, needed a new or "
            f"empty folder or that of an earlier {kind.noun}; give another output folder."
        )
    target = destination if destination.is_dir() else existing_parent(destination)
    if not is_writable(target):
        raise UsageError(
            f"{start} that {target} cannot be written to, needed permission to create files "
            "in it; give another output folder."
        )


def check_path(destination: Path, kind: OutputKind = RESULT) -> None:
    """Refuse a path at which no folder is and none can be made.

    Parameters
    ----------
    destination, kind
        As in :func:`check_destination`.

    Raises
    ------
    UsageError
        If it is too long, a file or below one, or a folder that cannot be listed.
    """
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


def in_the_way(destination: Path, kind: OutputKind, found: str) -> str:
    """Return what is said about something that stands where a file of an output belongs."""
    return (
        f"{destination}: the {kind.noun} could not be written: found {found}, needed its place; "
        "move it away, or give another folder; nothing was changed."
    )


def is_writable(folder: Path) -> bool:
    """Say whether files can be created in a folder."""
    return folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)


def holds_files(folder: Path) -> bool:
    """Say whether a folder holds more than what killed runs left behind."""
    return any(not path.name.endswith(TEMPORARY_SUFFIX) for path in folder.iterdir())


def existing_parent(destination: Path) -> Path:
    """Return the nearest folder above that exists."""
    for parent in destination.absolute().parents:
        if parent.exists():
            return parent
    return Path(destination.absolute().anchor)
