"""YAML files that a command writes and may replace: its own, and no others."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from legcal.errors import DatasetError, OutOfResources, UsageError
from legcal.files.atomic import write_atomically
from legcal.files.schema import parse_yaml, read_text


@dataclass(frozen=True)
class OwnYaml:
    """A kind of file.

    Attributes
    ----------
    noun : str
        What is written, with its article, for sentences: "the camera".
    what : str
        What the file is called where it cannot be read: "camera file".
    key : str
        The entry by which a file of this kind is known.
    needed : str
        What may stand in its place, for sentences: "a new file or an earlier location".
    """

    noun: str
    what: str
    key: str
    needed: str

    def check_place(self, path: Path) -> None:
        """Refuse a place where no file can be written, or where another one stands.

        Raises
        ------
        UsageError
            With what is there instead.
        """
        start = f"{path}: {self.noun} could not be written: found"
        if not path.name or os.path.isdir(path):
            raise UsageError(f"{start} a folder, needed the name of a file; give one in it.")
        if not os.path.isdir(path.parent):
            raise UsageError(
                f"{start} no folder {path.parent}, needed one that exists; create it or give "
                "another file."
            )
        if not os.access(path.parent, os.W_OK | os.X_OK):
            raise UsageError(
                f"{start} that {path.parent} cannot be written to, needed permission to create "
                "files in it; give another file."
            )
        if os.path.lexists(path) and not self._is_own(path):
            raise UsageError(
                f"{start} another file of that name, needed {self.needed}; give another file."
            )

    def _is_own(self, path: Path) -> bool:
        """Say whether a file is of this kind."""
        try:
            return self.key in parse_yaml(read_text(path, self.what), path, self.what)
        except DatasetError:
            return False

    def write(self, path: Path, text: str) -> None:
        """Write a file; an earlier one of its kind is replaced, any other is not.

        Raises
        ------
        UsageError
            As :meth:`check_place`.
        OutOfResources
            If the file cannot be written.
        """
        self.check_place(path)
        try:
            write_atomically(path, text.encode())
        except OSError as error:
            raise OutOfResources(
                f"{path}: {self.noun} could not be written: found '{error.strerror}', needed a "
                "folder that takes it; free some space or give another file."
            ) from error
