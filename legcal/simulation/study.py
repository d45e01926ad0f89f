"""The one Monte Carlo runner: all cores, resumable, the same results however it is run.

Run i has child i of the study's seed, whatever the number of runs and of processes. Every run
goes to the checkpoint as it comes; the summary reads them back in the order of their numbers, one
at a time, so that neither the order nor memory depends on how they were computed.
"""

from __future__ import annotations

import json
import tempfile
from collections import Counter
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from legcal.brief import brief
from legcal.errors import DidNotConverge, LegcalError, OutOfResources, UsageError
from legcal.files import TEMPORARY_SUFFIX, write_atomically
from legcal.processors import processors
from legcal.progress import Progress, shown_progress
from legcal.simulation.checkpoint import (
    CHECKPOINT_NAME,
    Checkpoint,
    header,
    is_begun,
    open_checkpoint,
)
from legcal.workers import worker_pool

DOCUMENT_NAME = "study.json"
MOST_RUNS = 1_000_000
_LARGEST_CHUNK = 10  # runs between two lines of the checkpoint reaching the disk
_PROCESSES = 4  # for each core; more only wait for each other
_CHUNKS = 16  # for each process: the work is shared evenly to the end

Record = dict[str, Any]
"""What one run found, as a JSON document: numbers, texts, lists, null; never NaN."""


class Summary(Protocol):
    """What all runs of a study found together."""

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

    def is_record(self, found: Any) -> bool:
        """Return whether what a checkpoint has of a run is what :meth:`one_run` returns."""

    def summary(self, records: Iterable[Record]) -> Summary:
        """Summarise the records of all runs that did not fail, read once and in order."""


@brief
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
    progress: Progress = False,
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
        Number of processes; more than a few for each core are not started. With more than one,
        the program must be safe to import (``if __name__ == "__main__":``).
    output : Path, optional
        Folder for the checkpoint, the document and the figures. One that holds a checkpoint of
        the same study is continued; more runs than before are added to those that are there.
    progress : bool or callable
        True shows a bar on stderr; a function is called as ``progress(stage, done, total)``.

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
    with shown_progress(progress) as report, _folder(output) as folder:
        path = folder / CHECKPOINT_NAME
        first = header(study.name, study.settings, seed)
        kept = output is not None
        with open_checkpoint(path, first, study.is_record, kept=kept) as checkpoint:
            missing = [run for run in range(n_runs) if run not in checkpoint.offsets]
            done = n_runs - len(missing)
            report(stage, done, n_runs)
            with closing(lines_of_runs(study, seed, missing, workers)) as chunks:
                for lines in chunks:
                    checkpoint.append(lines)
                    done += len(lines)
                    report(stage, done, n_runs)
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


# Runs in processes


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
    failure = "The study could not be finished"
    with worker_pool(workers, failure, in_order=False) as run:
        yield from run(partial(run_chunk, study, seed), _chunks(runs, workers))


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
    """Return a failure as a record."""
    return {"kind": type(error).__name__, "message": str(error)}


def _chunks(runs: Sequence[int], workers: int) -> Iterator[Sequence[int]]:
    size = min(max(len(runs) // (_CHUNKS * workers), 1), _LARGEST_CHUNK)
    return (runs[first : first + size] for first in range(0, len(runs), size))
