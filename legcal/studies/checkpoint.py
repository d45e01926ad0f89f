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
from legcal.studies.checkpoint_lines import IsRecord, check_header, encoded, is_run, parsed

CHECKPOINT_NAME = "runs.jsonl"
_NEXT = "free some space and start the same command again; the runs before are kept"
_NEXT_WITHOUT = "free some space, or give an output folder elsewhere, which keeps what is done"


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
        self,
        path: Path,
        reader: BinaryIO,
        writer: FileIO,
        offsets: dict[int, int],
        *,
        kept: bool,
    ) -> None:
        self.path = path
        self.offsets = offsets
        self._kept = kept
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
        places, content = {}, [encoded(line) for line in lines]
        for line, text in zip(lines, content, strict=True):
            places[int(line["run"])] = place
            place += len(text)
        self._write(b"".join(content))
        self.offsets.update(places)

    def begin(self, first: dict[str, Any]) -> None:
        """Write the first line of an empty checkpoint; raises as :meth:`append`."""
        self._write(encoded(first))

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
                f"needed a folder that takes its lines; {_NEXT if self._kept else _NEXT_WITHOUT}."
            ) from error


@contextmanager
def open_checkpoint(
    path: Path, expected: dict[str, Any], is_record: IsRecord, *, kept: bool = True
) -> Iterator[Checkpoint]:
    """Open the checkpoint of a study, or begin it.

    Parameters
    ----------
    path : Path
        The file; its folder exists.
    expected : dict
        Its first line, from :func:`header`.
    is_record : callable
        Tells what the study records from anything else.
    kept : bool
        Whether the file is still there afterwards, for messages.

    Raises
    ------
    UsageError
        If it belongs to another study, or is no checkpoint, or is damaged, or is being
        written by another process. It is left as it was.
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
        offsets, end = _read(path, reader, expected, is_record)
        writer.truncate(end)
        checkpoint = Checkpoint(path, reader, writer, offsets, kept=kept)
        if end == 0:
            checkpoint.begin(expected)
        yield checkpoint


def is_begun(path: Path) -> bool:
    """Return whether a file holds the first line of a checkpoint, or of something else."""
    if not path.is_file():
        return False
    with open(path, "rb") as file:
        return file.readline().endswith(b"\n")


def _read(
    path: Path, file: BinaryIO, expected: dict[str, Any], is_record: IsRecord
) -> tuple[dict[int, int], int]:
    """Return where the line of each run begins, and where the last complete line ends."""
    first = file.readline()
    if not first.endswith(b"\n") and encoded(expected).startswith(first):
        return {}, 0  # empty, or killed while it was begun
    check_header(path, first, expected)
    offsets: dict[int, int] = {}
    end, broken, number = len(first), 0, 1
    for line in file:
        number += 1
        if broken:
            raise _damaged(path, broken)
        found = parsed(line) if line.endswith(b"\n") else None
        if found is None:
            broken = number  # only the last line may be
            continue
        if not is_run(found, is_record):
            raise _damaged(path, number)
        offsets.setdefault(found["run"], end)
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
