"""The checkpoint of a study: a file with a line for every run that is done.

The first line says which study this is, with all of its settings; runs follow in the order in which
they end. A line that was being written when the process was killed is done again.
"""

from __future__ import annotations

import json
import os
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from io import FileIO
from itertools import islice
from math import isfinite
from pathlib import Path
from typing import Any, BinaryIO

from legcal.errors import OutOfResources, UsageError
from legcal.signals import raise_if_stopped
from legcal.version import __version__

CHECKPOINT_NAME = "runs.jsonl"
_KEY = "legcal_study"
_VERSION = 1
_INTERRUPTED = b"NonIpopt_Exception_Thrown"  # an interrupt that earlier versions took for a failure
_MERGED = 100  # lines that reach the disk together
_MOST_OF_LINE = 4_000_000  # bytes
_NEXT = "free some space and start the same command again; the runs before are kept"
_NEXT_WITHOUT = "free some space, or give an output folder elsewhere, which keeps what is done"

MOST_RUNS = 1_000_000

IsRecord = Callable[[Any], bool]
"""Whether a document is what a study records."""


@contextmanager
def open_checkpoint(
    path: Path, expected: dict[str, Any], is_record: IsRecord, *, kept: bool = True
) -> Iterator[Checkpoint]:
    """Open the checkpoint of a study, or begin it."""
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
        offsets, end = _read(path, reader, expected, is_record)
        writer.truncate(end)
        checkpoint = Checkpoint(path, reader, writer, offsets, kept=kept)
        if end == 0:
            checkpoint.begin(expected)
        yield checkpoint


class _Places:
    """Where the line of each run begins: 8 bytes a run."""

    def __init__(self) -> None:
        self._at = array("q")

    def __contains__(self, run: int) -> bool:
        return run < len(self._at) and self._at[run] >= 0

    def __getitem__(self, run: int) -> int:
        return self._at[run]

    def add(self, run: int, place: int) -> None:
        """Remember the first line of a run."""
        self._at.extend([-1] * (run + 1 - len(self._at)))
        if self._at[run] < 0:
            self._at[run] = place


class Checkpoint:
    """The runs of a study that are done, in a file."""

    def __init__(
        self,
        path: Path,
        reader: BinaryIO,
        writer: FileIO,
        offsets: _Places,
        *,
        kept: bool,
    ) -> None:
        self.path = path
        self.offsets = offsets
        self._kept = kept
        self._reader = reader
        self._writer = writer

    def append(self, lines: Sequence[dict[str, Any]]) -> None:
        """Add the lines of some runs; they are on the disk when this returns."""
        place = self._writer.seek(0, os.SEEK_END)
        content = [_encoded(line) for line in lines]
        self._write(b"".join(content))
        for line, text in zip(lines, content, strict=True):
            self.offsets.add(int(line["run"]), place)
            place += len(text)

    def begin(self, first: dict[str, Any]) -> None:
        """Write the first line of an empty checkpoint; raises as :meth:`append`."""
        self._write(_encoded(first))

    def lines(self, runs: Iterable[int]) -> Iterator[dict[str, Any]]:
        """Return the lines of runs, in the order of their numbers."""
        for run in runs:
            self._reader.seek(self.offsets[run])
            yield json.loads(self._reader.readline())

    def merge(self, other: Path, runs: Iterable[int], is_record: IsRecord) -> None:
        """Add the lines of runs that another checkpoint of the same study has, and this lacks.

        Raises
        ------
        UsageError
            If the other one cannot be read, or is of another study.
        """
        self._reader.seek(0)
        expected = json.loads(self._reader.readline())
        try:
            file = other.open("rb")
        except OSError as error:
            raise UsageError(
                f"{other}: the runs could not be merged: found '{error.strerror}', needed the "
                f"{CHECKPOINT_NAME} of a part of the study; name its folder."
            ) from error
        with file:
            places, _ = _read(other, file, expected, is_record)
            new = (run for run in runs if run in places and run not in self.offsets)
            for some in iter(lambda: list(islice(new, _MERGED)), []):
                lines = []
                for run in some:
                    file.seek(places[run])
                    lines.append(json.loads(file.readline()))
                self.append(lines)

    def _write(self, content: bytes) -> None:
        """Append bytes and wait until the disk has them; nothing once a signal was heard."""
        raise_if_stopped()
        try:
            rest = memoryview(content)
            while rest:
                rest = rest[self._writer.write(rest) :]
            os.fsync(self._writer.fileno())
        except OSError as error:
            raise OutOfResources(
                f"{self.path}: the checkpoint could not be written: found '{error.strerror}', "
                f"needed a folder that takes its lines; {_NEXT if self._kept else _NEXT_WITHOUT}."
            ) from error


def is_begun(path: Path) -> bool:
    """Return whether a file holds the first line of a checkpoint, or of something else."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.readline(_MOST_OF_LINE).endswith(b"\n")


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


def _encoded(document: dict[str, Any]) -> bytes:
    """Return a document as one line."""
    return json.dumps(document, allow_nan=False, separators=(",", ":")).encode() + b"\n"


def _parsed(line: bytes) -> Any:
    """Return the document on a line, None if there is none."""
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None


def _read(
    path: Path, file: BinaryIO, expected: dict[str, Any], is_record: IsRecord
) -> tuple[_Places, int]:
    """Return where the line of each run begins, and where the last complete line ends."""
    first = file.readline(_MOST_OF_LINE)
    if not first.endswith(b"\n") and _encoded(expected).startswith(first):
        return _Places(), 0  # empty, or killed while it was begun
    _check_header(path, first, expected)
    offsets = _Places()
    end, broken, number = len(first), 0, 1
    for line in iter(lambda: file.readline(_MOST_OF_LINE), b""):
        number += 1
        if broken:
            raise _damaged(path, broken)
        found = _parsed(line) if line.endswith(b"\n") else None
        if found is None:
            broken = number  # only the last line may be
            continue
        if not _is_run(found, is_record):
            raise _damaged(path, number)
        if _INTERRUPTED not in line:  # such a run is done again
            offsets.add(found["run"], end)
        end += len(line)
    return offsets, end


def _damaged(path: Path, number: int) -> UsageError:
    """Return the refusal of a line that cannot be what a killed run left of it."""
    return UsageError(
        f"{path}: the checkpoint could not be continued: found line {number} damaged, "
        "needed a complete JSON object of a run on every line but the last; remove that line, or "
        "give another output folder."
    )


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


def _check_header(path: Path, line: bytes, expected: dict[str, Any]) -> None:
    """Refuse a first line that is not the expected one."""
    start = f"{path}: the study could not be continued: found"
    end = "give another output folder, or this one the command that began it."
    found = _parsed(line)
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
        for key in dict.fromkeys([*expected, *found]):
            if found.get(key) != expected.get(key):
                inner = key if name in ("", "settings") else f"{name}.{key}"
                yield from _differences(found.get(key), expected.get(key), inner)
    else:
        yield f"{name} {json.dumps(found)} instead of {json.dumps(expected)}"


# Records


def _is_run(found: Any, is_record: IsRecord) -> bool:
    """Return whether a document is the record of a run, or its failure."""
    if not isinstance(found, dict) or type(found.get("run")) is not int:
        return False
    if not 0 <= found["run"] < MOST_RUNS:
        return False
    if found.keys() == {"run", "record"}:
        return is_record(found["record"])
    return found.keys() == {"run", "failure"} and is_failure(found["failure"])


def is_failure(found: Any) -> bool:
    """Return whether a document describes a failure: its kind and its message."""
    return (
        isinstance(found, dict)
        and found.keys() == {"kind", "message"}
        and all(isinstance(text, str) for text in found.values())
    )


def has_keys(found: Any, keys: set[str]) -> bool:
    """Return whether a document is an object with exactly these keys."""
    return isinstance(found, dict) and found.keys() == keys


def is_number(found: Any) -> bool:
    """Return whether a document is a finite number."""
    return isinstance(found, float | int) and not isinstance(found, bool) and isfinite(found)
