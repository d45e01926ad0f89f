"""The checkpoint of a study: one JSON line a run, appended and never changed.

The first line says which study it belongs to. A line counts once it is complete: what a killed run
left of its last line is dropped, and that run is done again.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from io import FileIO
from pathlib import Path
from typing import Any, BinaryIO

from legcal.errors import OutOfResources, UsageError
from legcal.version import __version__

CHECKPOINT_NAME = "runs.jsonl"
_KEY = "legcal_study"
_VERSION = 1


class Checkpoint:
    """The runs of a study that are done, in a file.

    Attributes
    ----------
    path : Path
        The file.
    offsets : dict of int to int
        Where the line of each run begins, by the number of the run.
    """

    def __init__(
        self, path: Path, reader: BinaryIO, writer: FileIO, offsets: dict[int, int]
    ) -> None:
        self.path = path
        self.offsets = offsets
        self._reader = reader
        self._writer = writer

    def append(self, lines: Sequence[dict[str, Any]]) -> None:
        """Add the lines of some runs; they are on the disk when this returns.

        Raises
        ------
        OutOfResources
            If they cannot be written, as on a full disk.
        """
        place = self._writer.seek(0, os.SEEK_END)
        places, content = {}, [_encoded(line) for line in lines]
        for line, text in zip(lines, content, strict=True):
            places[int(line["run"])] = place
            place += len(text)
        self._write(b"".join(content))
        self.offsets.update(places)

    def begin(self, first: dict[str, Any]) -> None:
        """Write the first line of an empty checkpoint; raises as :meth:`append`."""
        self._write(_encoded(first))

    def lines(self, n_runs: int) -> Iterator[dict[str, Any]]:
        """Return the lines of the first runs, in the order of their numbers."""
        for run in range(n_runs):
            self._reader.seek(self.offsets[run])
            yield json.loads(self._reader.readline())

    def _write(self, content: bytes) -> None:
        """Append bytes and wait until the disk has them."""
        try:
            rest = memoryview(content)
            while rest:
                rest = rest[self._writer.write(rest) :]
            os.fsync(self._writer.fileno())
        except OSError as error:
            raise OutOfResources(
                f"{self.path}: the checkpoint could not be written: found '{error.strerror}', "
                "needed a folder that takes its lines; free some space and start the same "
                "command again; the runs before are kept."
            ) from error


def header(name: str, settings: dict[str, Any], seed: int) -> dict[str, Any]:
    """Return the first line of the checkpoint of a study."""
    found: dict[str, Any] = json.loads(
        _encoded(
            {
                _KEY: _VERSION,
                "study": name,
                "version": __version__,
                "seed": seed,
                "settings": settings,
            }
        )
    )
    return found


@contextmanager
def open_checkpoint(path: Path, expected: dict[str, Any]) -> Iterator[Checkpoint]:
    """Open the checkpoint of a study, or begin it.

    Parameters
    ----------
    path : Path
        The file; its folder exists.
    expected : dict
        Its first line, from :func:`header`.

    Raises
    ------
    UsageError
        If it belongs to another study, or is no checkpoint, or is being written by another
        process. It is left as it was.
    OutOfResources
        If it cannot be read or written.
    """
    with ExitStack() as files:
        try:
            writer = files.enter_context(open(path, "ab", buffering=0))
            reader = files.enter_context(open(path, "rb"))
        except OSError as error:
            raise OutOfResources(
                f"{path}: the checkpoint could not be opened: found '{error.strerror}', needed a "
                "file that can be read and written; give another output folder."
            ) from error
        _lock(path, writer)
        offsets, end = _read(path, reader, expected)
        writer.truncate(end)
        checkpoint = Checkpoint(path, reader, writer, offsets)
        if end == 0:
            checkpoint.begin(expected)
        yield checkpoint


def _read(path: Path, file: BinaryIO, expected: dict[str, Any]) -> tuple[dict[int, int], int]:
    """Return where the line of each run begins, and where the last complete line ends."""
    first = file.readline()
    if not first.endswith(b"\n") and _encoded(expected).startswith(first):
        return {}, 0  # empty, or killed while it was begun
    _check_header(path, first, expected)
    offsets: dict[int, int] = {}
    end, broken, number = len(first), 0, 1
    for line in file:
        number += 1
        if broken:
            raise UsageError(
                f"{path}: the checkpoint could not be continued: found line {broken} damaged, "
                "needed a complete JSON object on every line but the last; remove that line, or "
                "give another output folder."
            )
        run = _run_of(line)
        if run is None:
            broken = number  # only the last line may be
            continue
        offsets.setdefault(run, end)
        end += len(line)
    return offsets, end


def _run_of(line: bytes) -> int | None:
    """Return the number of the run that a line describes, None if the line is not whole."""
    if not line.endswith(b"\n"):
        return None
    try:
        found = json.loads(line)
    except (ValueError, RecursionError):
        return None
    whole = isinstance(found, dict) and isinstance(found.get("run"), int)
    return found["run"] if whole and ("record" in found or "failure" in found) else None


def _check_header(path: Path, line: bytes, expected: dict[str, Any]) -> None:
    """Refuse a first line that is not the expected one."""
    start = f"{path}: the study could not be continued: found"
    end = "give another output folder, or this one the command that began it."
    try:
        found = json.loads(line)
    except ValueError:
        found = None
    if not isinstance(found, dict) or found.get(_KEY) != _VERSION:
        raise UsageError(
            f"{start} a file that is no checkpoint of legcal, needed one or none; "
            "give another output folder."
        )
    if found.get("study") != expected["study"]:
        raise UsageError(
            f"{start} the checkpoint of the study '{found.get('study')}', needed one of "
            f"'{expected['study']}'; {end}"
        )
    if found != expected:
        different = "; ".join(_differences(found, expected))
        raise UsageError(f"{start} a checkpoint of other settings ({different}); {end}")


def _differences(found: Any, expected: Any, name: str = "") -> Iterator[str]:
    """Name what two documents differ in."""
    if isinstance(found, dict) and isinstance(expected, dict):
        for key in sorted(found.keys() | expected.keys()):
            if found.get(key) != expected.get(key):
                inner = key if name in ("", "settings") else f"{name}.{key}"
                yield from _differences(found.get(key), expected.get(key), inner)
    else:
        yield f"{name} {json.dumps(found)} instead of {json.dumps(expected)}"


def _lock(path: Path, file: FileIO) -> None:
    """Refuse a file that another process is writing, where the system can tell."""
    try:
        import fcntl
    except ImportError:
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise UsageError(
            f"{path}: the study could not be continued: found that another process writes this "
            "checkpoint, needed it alone; wait for that one, or give another output folder."
        ) from error


def _encoded(document: dict[str, Any]) -> bytes:
    """Return a document as one line."""
    return json.dumps(document, allow_nan=False, separators=(",", ":")).encode() + b"\n"
