"""The Monte Carlo runner: reproducible for any number of workers, resumable after a stop.

Run i has child i of the study's seed, whatever the number of runs and of processes. ``runs.jsonl``
has the study with its settings and its seed in the first line and one run in every further line,
written as runs end; a run with an incomplete line, after a kill, is done again.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

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
_PROCESSES = 4  # maximum number of processes for each core; more only wait for each other

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


@dataclass(frozen=True, eq=False)
class StudyResult:
    """A finished study."""

    heading: StudyHeading
    summary: Summary  # result of the runs that did not fail

    def document(self) -> dict[str, Any]:
        """Return the document that ``legcal study --json`` prints."""
        return self.summary.document() | self.heading.document()


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
    about = {"study": study.name, "version": __version__, "seed": seed, "settings": study.settings}
    heading = _parsed(_encoded({_KEY: _VERSION, **about}))
    checkpoint, stage = _Checkpoint(output, heading), f"Study {study.name}"
    missing = [run for run in range(n_runs) if run not in checkpoint.lines]
    with shown_progress(progress) as report:
        done = n_runs - len(missing)
        report(stage, done, n_runs)
        if missing:
            if is_number(workers):
                workers = min(workers, len(missing), _PROCESSES * processors())
            with worker_pool(workers, "The study could not be finished", in_order=False) as run:
                for line in run(partial(_line_of_run, study, seed), missing):
                    checkpoint.add(line)
                    done += 1
                    report(stage, done, n_runs)
    in_order = [checkpoint.lines[run] for run in range(n_runs)]
    result = _result(study, seed, in_order)
    if output is not None:
        document = json.dumps(result.document(), indent=1, allow_nan=False).encode() + b"\n"
        with result_folder(output, _STUDY) as folder:
            for name, content in {**result.summary.files(), DOCUMENT_NAME: document}.items():
                (folder / name).write_bytes(content)
            if beside is not None:
                beside(result, folder)
    return result


def _result(study: Study, seed: int, lines: Sequence[Record]) -> StudyResult:
    """Combine the lines of runs."""
    failures = [line["failure"] for line in lines if "failure" in line]
    if len(failures) == len(lines):
        raise DidNotConverge(
            f"The study {study.name} found nothing: all of its {len(lines)} runs failed, needed "
            f"one that does not; the first one says: {failures[0]['message']}"
        )
    heading = StudyHeading(
        study=study.name,
        settings=study.settings,
        seed=seed,
        runs=len(lines),
        failures=dict(Counter(failure["kind"] for failure in failures)),
    )
    records = (line["record"] for line in lines if "record" in line)
    return StudyResult(heading, study.summary(records))


def _check_numbers(n_runs: int, seed: int, workers: Workers) -> None:
    """Refuse numbers out of range."""
    processes = workers if is_number(workers) else 1
    for name, number, least, most in (
        ("runs", n_runs, 1, _MOST_RUNS),
        ("seed", seed, 0, math.inf),
        ("workers", processes, 1, math.inf),
    ):
        if not least <= number <= most:
            needed = f"{least} or more" if number < least else f"{most} at most"
            raise UsageError(
                f"The study could not be run: found {name} = {number}, needed {needed}; give "
                "another number."
            )


# The checkpoint


class _Checkpoint:
    """The lines of completed runs, kept in the file of an output folder if there is one."""

    def __init__(self, output: Path | None, heading: Record) -> None:
        self.lines: dict[int, Record] = {}
        self._path = None if output is None else output / CHECKPOINT_NAME
        if output is not None and self._path is not None:
            _check_folder(output, self._path)
            with _writing(self._path):
                output.mkdir(parents=True, exist_ok=True)
                self._read(self._path, heading)

    def add(self, line: Record) -> None:
        """Add the line of a run; nothing once a signal was heard."""
        raise_if_stopped()
        if self._path is not None:
            with _writing(self._path), self._path.open("ab") as file:
                file.write(_encoded(line))
        self.lines[line["run"]] = line

    def _read(self, path: Path, heading: Record) -> None:
        """Read existing lines, and drop an incomplete line at the end; or begin the file."""
        content = path.read_bytes() if path.exists() else b""
        first, end, body = content.partition(b"\n")
        if not end and _encoded(heading).startswith(first):  # new, or killed while it was begun
            path.write_bytes(_encoded(heading))
            return
        _check_heading(path, _parsed(first), heading)
        *lines, unfinished = body.split(b"\n")
        if lines and not unfinished and not _parsed(lines[-1]):  # zeros, after a power cut
            unfinished = lines.pop()
        for number, line in enumerate(lines, 2):
            entry = _parsed(line)
            outcome = entry.get("record", entry.get("failure"))
            if type(entry.get("run")) is not int or entry["run"] < 0 or type(outcome) is not dict:
                raise UsageError(
                    f"{path}: the study could not be continued: found line {number} damaged, "
                    "needed a complete JSON object of a run on every line; remove that line, or "
                    "give another output folder."
                )
            self.lines.setdefault(entry["run"], entry)
        if unfinished:
            path.write_bytes(b"".join(line + b"\n" for line in (first, *lines)))


def _check_folder(output: Path, checkpoint: Path) -> None:
    """Refuse a folder with other content than a study."""
    check_path(output, _STUDY)
    is_begun = checkpoint.is_file() and (
        checkpoint.stat().st_size > 0 or list(output.iterdir()) == [checkpoint]
    )
    if output.is_dir() and holds_files(output) and not is_begun:
        raise UsageError(
            f"{output}: the study could not be written: found a folder with other files and no "
            f"{CHECKPOINT_NAME} of a study, needed a new or empty folder or that of the same "
            "study; give another output folder."
        )


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


def _check_heading(path: Path, heading: Record, expected: Record) -> None:
    """Refuse the runs of another study."""
    if heading == expected:
        return
    if _KEY not in heading:
        raise UsageError(
            f"{path}: the study could not be continued: found a file that is no checkpoint of "
            "legcal, needed one or none; give another output folder."
        )
    flat, needed = ({**h, **dict(h.get("settings") or {})} for h in (heading, expected))
    differences = "; ".join(
        f"{name} {flat.get(name)!r} instead of {needed[name]!r}"
        for name in needed
        if name != "settings" and flat.get(name) != needed[name]
    )
    raise UsageError(
        f"{path}: the study could not be continued: found the runs of another command "
        f"({differences}), needed those of the same; give another output folder, or this one the "
        "command that began it."
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


def _line_of_run(study: Study, seed: int, run: int) -> Record:
    """Return the line of a run, with child ``run`` of the study's seed.

    A LegcalError is a failure; any other error is raised.
    """
    try:
        return {"run": run, "record": study.one_run(np.random.SeedSequence(seed, spawn_key=(run,)))}
    except LegcalError as error:
        return {"run": run, "failure": failure_of(error)}


def failure_of(error: LegcalError) -> dict[str, str]:
    """Return a failure as a record."""
    return {"kind": type(error).__name__, "message": str(error)}
