"""The one Monte Carlo runner: all cores, resumable, the same results however it is run.

Run i has child i of the study's seed, whatever the number of runs and of processes. Every run
goes to the checkpoint as it comes; the summary reads them back in the order of their numbers, one
at a time, so that neither the order nor memory depends on how they were computed.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from io import FileIO
from math import isfinite
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any, BinaryIO, Protocol

import numpy as np
from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky.process_executor import BrokenProcessPool

from legcal.errors import DidNotConverge, LegcalError, OutOfResources, UsageError
from legcal.files import TEMPORARY_SUFFIX, write_atomically
from legcal.processors import processors
from legcal.progress import Report, no_progress
from legcal.version import __version__

if TYPE_CHECKING:
    from rich.console import RenderableType

Record = dict[str, Any]
"""What one run found, as a JSON document: numbers, texts, lists, null; never NaN."""


class Summary(Protocol):
    """What all runs of a study found together."""

    def document(self) -> dict[str, Any]:
        """Return it as a JSON document."""

    def table(self) -> RenderableType:
        """Return it for people."""

    def files(self) -> dict[str, bytes]:
        """Return the files that belong to it, such as figures, by name."""


class Study(Protocol):
    """A Monte Carlo study: many independent runs of one experiment.

    It is sent to worker processes: it must pickle, and keep nothing from one run to the next that
    changes a result.
    """

    @property
    def name(self) -> str:
        """Its name on the command line."""

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that decides a run beside its seed, as a JSON document."""

    def one_run(self, seed: np.random.SeedSequence) -> Record:
        """Return the record of one run; a LegcalError is recorded as a failed run."""

    def is_record(self, found: Any) -> bool:
        """Return whether what a checkpoint has of a run is what :meth:`one_run` returns."""

    def summary(self, records: Iterable[Record]) -> Summary:
        """Return what the records of all runs that did not fail say, read once and in order."""


_KEY = "legcal_study"
_VERSION = 1

_LARGEST_CHUNK = 10  # runs between two lines of the checkpoint reaching the disk
_PROCESSES = 4  # for each core; more only wait for each other
_CHUNKS = 16  # for each process: the work is shared evenly to the end

IsRecord = Callable[[Any], bool]
"""Tells what a study records from anything else."""


def header(name: str, settings: dict[str, Any], seed: int) -> dict[str, Any]:
    """Return the first line of the checkpoint of a study."""
    found: dict[str, Any] = json.loads(
        encoded(
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


def encoded(document: dict[str, Any]) -> bytes:
    """Return a document as one line."""
    return json.dumps(document, allow_nan=False, separators=(",", ":")).encode() + b"\n"


def parsed(line: bytes) -> Any:
    """Return the document on a line, None if there is none."""
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None


def is_run(found: Any, is_record: IsRecord) -> bool:
    """Return whether a document says what a run found, or how it failed."""
    if not isinstance(found, dict) or type(found.get("run")) is not int or found["run"] < 0:
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


def check_header(path: Path, line: bytes, expected: dict[str, Any]) -> None:
    """Refuse a first line that is not the expected one."""
    start = f"{path}: the study could not be continued: found"
    end = "give another output folder, or this one the command that began it."
    found = parsed(line)
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


CHECKPOINT_NAME = "runs.jsonl"
_NEXT = "free some space and start the same command again; the runs before are kept"
_NEXT_WITHOUT = "free some space, or give an output folder elsewhere, which keeps what is done"


class Checkpoint:
    """The runs of a study that are done, in a file."""

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
        """Add the lines of some runs; they are on the disk when this returns."""
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


def child_seed(seed: int, run: int) -> np.random.SeedSequence:
    """Return the seed of a run: child ``run`` of the study's seed, however many there are."""
    return np.random.SeedSequence(seed, spawn_key=(run,))


def lines_of_runs(
    study: Study, seed: int, runs: Sequence[int], workers: int
) -> Generator[list[dict[str, Any]]]:
    """Return the lines of runs, chunk by chunk, in the order in which they are finished.

    Chunks are handed out as processes get free, so that memory does not grow with their number.
    """
    workers = min(workers, max(len(runs), 1), _PROCESSES * processors())
    chunks = _chunks(runs, workers)
    if workers == 1:
        for chunk in chunks:
            yield run_chunk(study, seed, chunk)
        return
    with (
        _without_advice(),
        parallel_config(
            "loky",
            n_jobs=workers,
            inner_max_num_threads=1,
            initializer=_follow,
            initargs=(os.getpid(),),
        ),
    ):
        parallel = Parallel(
            return_as="generator_unordered", pre_dispatch="2 * n_jobs", batch_size=1
        )
        tasks = (delayed(run_chunk)(study, seed, chunk) for chunk in chunks)
        try:
            yield from parallel(tasks)
        except BrokenProcessPool as error:
            raise OutOfResources(
                f"The study could not be finished: found that one of {workers} processes was "
                "ended from outside, needed all of them to the end; see that there is enough "
                "memory and start the same command again."
            ) from error


def run_chunk(study: Study, seed: int, runs: Iterable[int]) -> list[dict[str, Any]]:
    """Return the line of each run; one that legcal refuses is a failure, and no other error is."""
    lines: list[dict[str, Any]] = []
    for run in runs:
        try:
            lines.append({"run": run, "record": study.one_run(child_seed(seed, run))})
        except LegcalError as error:
            lines.append({"run": run, "failure": failure_of(error)})
    return lines


def failure_of(error: LegcalError) -> dict[str, str]:
    """Return what a record says about a failure."""
    return {"kind": type(error).__name__, "message": str(error)}


def _chunks(runs: Sequence[int], workers: int) -> Iterator[Sequence[int]]:
    size = min(max(len(runs) // (_CHUNKS * workers), 1), _LARGEST_CHUNK)
    return (runs[first : first + size] for first in range(0, len(runs), size))


@contextmanager
def _without_advice() -> Iterator[None]:
    """Keep joblib from advising its user where a study is stopped or killed before its end."""
    of_processes = "ignore:resource_tracker"  # handed to those that joblib starts
    sys.warnoptions.append(of_processes)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", r"\d+ tasks (which were|have been) ", UserWarning)
            yield
    finally:
        sys.warnoptions.remove(of_processes)


def _follow(parent: int) -> None:
    """Leave the answer to Ctrl-C to the process that started this one, and end when it does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


DOCUMENT_NAME = "study.json"
MOST_RUNS = 1_000_000


@dataclass(frozen=True, eq=False)
class StudyResult:
    """A finished study."""

    study: str  # its name
    settings: dict[str, Any]  # its settings
    seed: int  # seed, n_runs: seed and number of runs
    n_runs: int
    failures: dict[str, int]  # how many runs failed as a whole, by kind of error
    summary: Summary  # what the others found

    def document(self) -> dict[str, Any]:
        """Return the document that ``legcal study --json`` prints."""
        return {
            **self.summary.document(),
            "study": self.study,
            "settings": self.settings,
            "seed": self.seed,
            "runs": self.n_runs,
            "failures": self.failures,
        }


def run_study(
    study: Study,
    n_runs: int,
    *,
    seed: int = 0,
    workers: int = 1,
    output: Path | None = None,
    progress: Report = no_progress,
) -> StudyResult:
    """Run a study, or what is missing of it.

    Parameters
    ----------
    study : Study
        The study.
    n_runs : int
        Number of runs.
    seed : int
        Seed of the study.
    workers : int
        Number of processes; more than a few for each core are not started.
    output : Path, optional
        Folder for the checkpoint, the document and the figures. One that holds a checkpoint of
        the same study is continued; more runs than before are added to those that are there.
    progress : callable
        Told how many runs are done.

    Returns
    -------
    StudyResult

    Raises
    ------
    UsageError
        If a number makes no sense, or the folder holds something else than this study.
    DidNotConverge
        If every run failed.
    OutOfResources
        If a file cannot be written or a process is ended from outside.
    """
    _check_numbers(n_runs, seed, workers)
    stage = f"Study {study.name}"
    with _folder(output) as folder:
        path = folder / CHECKPOINT_NAME
        first = header(study.name, study.settings, seed)
        kept = output is not None
        with open_checkpoint(path, first, study.is_record, kept=kept) as checkpoint:
            missing = [run for run in range(n_runs) if run not in checkpoint.offsets]
            done = n_runs - len(missing)
            progress(stage, done, n_runs)
            with closing(lines_of_runs(study, seed, missing, workers)) as chunks:
                for lines in chunks:
                    checkpoint.append(lines)
                    done += len(lines)
                    progress(stage, done, n_runs)
            result = _result(study, seed, n_runs, checkpoint)
        if output is not None:
            _write(result, folder)
    return result


def _result(study: Study, seed: int, n_runs: int, checkpoint: Checkpoint) -> StudyResult:
    """Return what all runs found."""
    failures: Counter[str] = Counter()
    messages: list[str] = []

    def records() -> Iterator[Record]:
        for line in checkpoint.lines(n_runs):
            if "record" in line:
                yield line["record"]
            else:
                failures[line["failure"]["kind"]] += 1
                if not messages:
                    messages.append(line["failure"]["message"])

    summary = study.summary(records())
    if failures.total() == n_runs:
        raise DidNotConverge(
            f"The study {study.name} found nothing: all of its {n_runs} runs failed, needed one "
            f"that does not; the first one says: {messages[0]}"
        )
    return StudyResult(study.name, study.settings, seed, n_runs, dict(failures), summary)


def _write(result: StudyResult, folder: Path) -> None:
    """Write the document and the figures."""
    document = json.dumps(result.document(), indent=1, allow_nan=False).encode() + b"\n"
    try:
        for name, content in {**result.summary.files(), DOCUMENT_NAME: document}.items():
            write_atomically(folder / name, content)
    except OSError as error:
        raise OutOfResources(
            f"{folder}: the result of the study could not be written: found '{error.strerror}', "
            "needed a folder that takes its files; free some space and start the same command "
            "again; all runs are kept."
        ) from error


@contextmanager
def _folder(output: Path | None) -> Iterator[Path]:
    """Give the output folder, or one that is removed in the end."""
    if output is None:
        with tempfile.TemporaryDirectory(prefix="legcal-study-") as folder:
            yield Path(folder)
        return
    try:
        _check_folder(output)
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(
            f"{output}: the study could not be written: found '{error.strerror}', needed a folder "
            "that can be created and read; give another output folder."
        ) from error
    yield output


def _check_folder(output: Path) -> None:
    """Refuse a path that holds something else than a study."""
    start = f"{output}: the study could not be written: found"
    if output.exists() and not output.is_dir():
        raise UsageError(
            f"{start} a file of that name, needed a folder; give another output folder."
        )
    checkpoint = output / CHECKPOINT_NAME
    if not output.is_dir() or is_begun(checkpoint):
        return
    others = [path for path in output.iterdir() if not path.name.endswith(TEMPORARY_SUFFIX)]
    if any(path != checkpoint or path.is_dir() for path in others):
        raise UsageError(
            f"{start} a folder with other files and no {CHECKPOINT_NAME} of a study, needed a new "
            "or empty folder or that of the same study; give another output folder."
        )


def _check_numbers(n_runs: int, seed: int, workers: int) -> None:
    """Refuse numbers that make no sense."""
    if n_runs > MOST_RUNS:
        raise UsageError(
            f"The study could not be run: found runs = {n_runs}, needed {MOST_RUNS} at most; give "
            "another number."
        )
    for name, found, least in (("runs", n_runs, 1), ("seed", seed, 0), ("workers", workers, 1)):
        if found < least:
            raise UsageError(
                f"The study could not be run: found {name} = {found}, needed {least} or more; "
                "give another number."
            )
