"""The Monte Carlo runner: reproducible for any number of workers, resumable after a stop.

Run i has child i of the study's seed, whatever the number of runs and of processes. ``runs.jsonl``
has the study with its settings and its seed in the first line and one run in every further line,
written as runs end; a run with an incomplete line, after a kill, is done again.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from legcal.brief import brief
from legcal.errors import DidNotConverge, LegcalError, OutOfResources, UsageError
from legcal.files.folder import OutputKind, check_path, holds_files, result_folder
from legcal.files.schema import SparseDocument
from legcal.progress import Progress, shown_progress
from legcal.signals import raise_if_stopped
from legcal.version import __version__
from legcal.workers import Workers, is_number, processors, worker_pool

CHECKPOINT_NAME = "runs.jsonl"
DOCUMENT_NAME = "study.json"
_STUDY = OutputKind("result of the study", "", "")  # in a folder with checkpoint and other files
_KEY, _VERSION = "legcal_study", 1
_MOST_RUNS = 1_000_000
_LARGEST_CHUNK = 10  # maximum number of runs between two writes to the checkpoint
_PROCESSES = 4  # maximum number of processes for each core; more only wait for each other
_MANY = 64  # assumed number of workers of a cluster
_CHUNKS = 16  # chunks for each process, so that the work is shared evenly to the end

Record = dict[str, Any]
"""The result of one run as a JSON document: numbers, texts, lists, null; never NaN."""


class Summary(Protocol):
    """The combined result of all runs of a study."""

    def document(self) -> dict[str, Any]:
        """Return it as a JSON document."""

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

    def summary(self, records: Iterable[Record]) -> Summary:
        """Summarise the records of all runs that did not fail, read once and in order."""


class StudyHeading(SparseDocument):
    """The part of a study's document that is common to all studies."""

    study: str
    settings: dict[str, Any]
    seed: int
    runs: int
    failures: dict[str, int]  # runs that failed as a whole, by kind of error


@brief
@dataclass(frozen=True, eq=False)
class StudyResult:
    """A finished study."""

    study: str  # its name
    settings: dict[str, Any]  # its settings
    seed: int  # seed, n_runs: seed and number of runs
    n_runs: int
    failures: dict[str, int]  # number of failed runs by kind of error
    summary: Summary  # result of the other runs

    def document(self) -> dict[str, Any]:
        """Return the document that ``legcal study --json`` prints."""
        heading = StudyHeading(
            study=self.study,
            settings=self.settings,
            seed=self.seed,
            runs=self.n_runs,
            failures=self.failures,
        )
        return self.summary.document() | heading.document()


def run_study(
    study: Study,
    n_runs: int,
    *,
    seed: int = 0,
    workers: Workers = 1,
    output: Path | None = None,
    progress: Progress = False,
    beside: Callable[[StudyResult, Path], None] | None = None,
) -> StudyResult:
    """Run a study, or the missing runs of a checkpoint.

    Parameters
    ----------
    study : Study
        The study.
    n_runs : int
        Number of runs.
    seed : int
        Seed of the study.
    workers : int, str or executor
        Number of processes, limited to a few for each core, or a cluster, as for
        :func:`legcal.calibrate`.
    output : Path, optional
        Folder for the checkpoint, the document and the figures. A checkpoint of the same study
        there is continued; further runs are added to the existing ones.
    progress : bool or callable
        True shows a bar on stderr; a function is called as ``progress(stage, done, total)``.
    beside : callable, optional
        Called as ``beside(result, folder)`` with the figures in the folder; files that it writes
        there appear in the output with them.

    Returns
    -------
    StudyResult

    Raises
    ------
    UsageError
        If a number is out of range, or the folder has other content than this study.
    DidNotConverge
        If every run failed.
    OutOfResources
        If a file cannot be written or a process is ended from outside.
    """
    _check_numbers(n_runs, seed, workers)
    checkpoint, stage = _Checkpoint(output, _header(study, seed)), f"Study {study.name}"
    missing = [run for run in range(n_runs) if run not in checkpoint.lines]
    with shown_progress(progress) as report:
        done = n_runs - len(missing)
        report(stage, done, n_runs)
        if missing:
            slots = _MANY
            if is_number(workers):
                workers = slots = min(workers, len(missing), _PROCESSES * processors())
            with worker_pool(workers, "The study could not be finished", in_order=False) as run:
                for lines in run(partial(run_chunk, study, seed), _chunks(missing, slots)):
                    checkpoint.add(lines)
                    done += len(lines)
                    report(stage, done, n_runs)
    in_order = [checkpoint.lines[run] for run in range(n_runs)]
    result = _result(study, seed, in_order)
    if output is not None:
        _write(result, output, beside)
    return result


def _result(study: Study, seed: int, lines: Sequence[Record]) -> StudyResult:
    """Combine the lines of runs."""
    failures = [line["failure"] for line in lines if "failure" in line]
    if len(failures) == len(lines):
        raise DidNotConverge(
            f"The study {study.name} found nothing: all of its {len(lines)} runs failed, needed "
            f"one that does not; the first one says: {failures[0]['message']}"
        )
    kinds = dict(Counter(failure["kind"] for failure in failures))
    summary = study.summary(line["record"] for line in lines if "record" in line)
    return StudyResult(study.name, study.settings, seed, len(lines), kinds, summary)


def _write(
    result: StudyResult, folder: Path, beside: Callable[[StudyResult, Path], None] | None
) -> None:
    """Write the document and the figures, all of them or nothing."""
    document = json.dumps(result.document(), indent=1, allow_nan=False).encode() + b"\n"
    with result_folder(folder, _STUDY) as new:
        for name, content in {**result.summary.files(), DOCUMENT_NAME: document}.items():
            (new / name).write_bytes(content)
        if beside is not None:
            beside(result, new)


def _check_numbers(n_runs: int, seed: int, workers: Workers) -> None:
    """Refuse numbers out of range."""
    if n_runs > _MOST_RUNS:
        raise UsageError(
            f"The study could not be run: found runs = {n_runs}, needed {_MOST_RUNS} at most; give "
            "another number."
        )
    processes = workers if is_number(workers) else 1
    for name, number, least in (("runs", n_runs, 1), ("seed", seed, 0), ("workers", processes, 1)):
        if number < least:
            raise UsageError(
                f"The study could not be run: found {name} = {number}, needed {least} or more; "
                "give another number."
            )


# The checkpoint


class _Checkpoint:
    """The lines of completed runs, kept in the file of an output folder if there is one."""

    def __init__(self, output: Path | None, first: Record) -> None:
        self.lines: dict[int, Record] = {}
        self._path = None
        if output is not None:
            _prepare_folder(output)
            self._path = output / CHECKPOINT_NAME
            with _writing(self._path):
                self._read(self._path, first)

    def add(self, lines: Sequence[Record]) -> None:
        """Add the lines of some runs; nothing once a signal was heard."""
        raise_if_stopped()
        if self._path is not None:
            with _writing(self._path), self._path.open("ab") as file:
                file.write(b"".join(map(_encoded, lines)))
        self.lines |= {line["run"]: line for line in lines}

    def _read(self, path: Path, first: Record) -> None:
        """Read existing lines, and drop an incomplete line at the end; or begin the file."""
        content = path.read_bytes() if path.exists() else b""
        heading, end, body = content.partition(b"\n")
        if not end and _encoded(first).startswith(heading):  # new, or killed while it was begun
            path.write_bytes(_encoded(first))
            return
        _check_header(path, heading, first)
        *runs, unfinished = body.split(b"\n")
        if runs and not unfinished and not _parsed(runs[-1]):  # zeros, after a power cut
            unfinished = runs.pop()
        for number, line in enumerate(runs, 2):
            run = _parsed(line)
            if not _is_run(run):
                raise UsageError(
                    f"{path}: the study could not be continued: found line {number} damaged, "
                    "needed a complete JSON object of a run on every line; remove that line, or "
                    "give another output folder."
                )
            self.lines.setdefault(run["run"], run)
        if unfinished:
            path.write_bytes(b"".join(line + b"\n" for line in (heading, *runs)))


def _prepare_folder(output: Path) -> None:
    """Make the output folder; refuse a folder with other content than a study."""
    check_path(output, _STUDY)
    checkpoint = output / CHECKPOINT_NAME
    is_begun = checkpoint.is_file() and (
        checkpoint.stat().st_size > 0 or list(output.iterdir()) == [checkpoint]
    )
    if output.is_dir() and holds_files(output) and not is_begun:
        raise UsageError(
            f"{output}: the study could not be written: found a folder with other files and no "
            f"{CHECKPOINT_NAME} of a study, needed a new or empty folder or that of the same "
            "study; give another output folder."
        )
    with _writing(output):
        output.mkdir(parents=True, exist_ok=True)


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Refuse in one sentence a checkpoint that cannot be read or written."""
    try:
        yield
    except OSError as error:
        raise OutOfResources(
            f"{path}: the runs of the study could not be kept: found '{error.strerror}', needed a "
            "folder that takes them; free some space and start the same command again, which goes "
            "on from the runs that are there."
        ) from error


def _header(study: Study, seed: int) -> Record:
    """Return the first line of the checkpoint of a study."""
    first = {"study": study.name, "version": __version__, "seed": seed, "settings": study.settings}
    return _parsed(_encoded({_KEY: _VERSION, **first}))


def _check_header(path: Path, line: bytes, expected: Record) -> None:
    """Refuse an unexpected first line."""
    header = _parsed(line)
    if header == expected:
        return
    if _KEY not in header:
        raise UsageError(
            f"{path}: the study could not be continued: found a file that is no checkpoint of "
            "legcal, needed one or none; give another output folder."
        )
    flat, needed = ({**first, **dict(first.get("settings") or {})} for first in (header, expected))
    different = [name for name in needed if name != "settings" and flat.get(name) != needed[name]]
    differences = "; ".join(
        f"{name} {flat.get(name)!r} instead of {needed[name]!r}" for name in different
    )
    raise UsageError(
        f"{path}: the study could not be continued: found the runs of another command "
        f"({differences}), needed those of the same; give another output folder, or this one the "
        "command that began it."
    )


def _is_run(entry: Record) -> bool:
    """Return whether a line has the record of a run, or its failure."""
    run, failure = entry.get("run"), entry.get("failure")
    if type(run) is not int or not 0 <= run < _MOST_RUNS:
        return False
    if entry.keys() == {"run", "record"}:
        return isinstance(entry["record"], dict)
    return (
        entry.keys() == {"run", "failure"}
        and isinstance(failure, dict)
        and failure.keys() == {"kind", "message"}
        and all(isinstance(text, str) for text in failure.values())
    )


def _encoded(document: Record) -> bytes:
    """Return a document as one line."""
    return json.dumps(document, allow_nan=False, separators=(",", ":")).encode() + b"\n"


def _parsed(line: bytes) -> Record:
    """Return the object on a line, {} if there is none."""
    try:
        value = json.loads(line)
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


# Runs in processes


def child_seed(seed: int, run: int) -> np.random.SeedSequence:
    """Return the seed of a run: child ``run`` of the study's seed, however many there are."""
    return np.random.SeedSequence(seed, spawn_key=(run,))


def run_chunk(study: Study, seed: int, runs: Iterable[int]) -> list[Record]:
    """Return the line of each run; a LegcalError is a failure, any other error is raised."""
    lines: list[Record] = []
    for run in runs:
        try:
            lines.append({"run": run, "record": study.one_run(child_seed(seed, run))})
        except LegcalError as error:
            lines.append({"run": run, "failure": failure_of(error)})
    return lines


def failure_of(error: LegcalError) -> dict[str, str]:
    """Return a failure as a record."""
    return {"kind": type(error).__name__, "message": str(error)}


def _chunks(runs: Sequence[int], workers: int) -> Iterator[Sequence[int]]:
    size = min(max(len(runs) // (_CHUNKS * workers), 1), _LARGEST_CHUNK)
    return (runs[first : first + size] for first in range(0, len(runs), size))
