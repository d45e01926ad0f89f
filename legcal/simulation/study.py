"""The one Monte Carlo runner: all cores, resumable, the same results however it is run.

Run i has child i of the study's seed, whatever the number of runs and of processes. Every run
goes to the checkpoint as it comes; the summary reads them back in the order of their numbers, one
at a time, so that neither the order nor memory depends on how they were computed.
"""

from __future__ import annotations

import json
import tempfile
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from legcal.brief import brief
from legcal.errors import DidNotConverge, LegcalError, OutOfResources, UsageError
from legcal.files.folder import TEMPORARY_SUFFIX, OutputKind, check_path, result_folder
from legcal.files.schema import SparseDocument
from legcal.processors import processors
from legcal.progress import Progress, shown_progress
from legcal.simulation.checkpoint import (
    CHECKPOINT_NAME,
    MOST_RUNS,
    Checkpoint,
    header,
    is_begun,
    open_checkpoint,
)
from legcal.workers import Workers, is_number, worker_pool

DOCUMENT_NAME = "study.json"
_STUDY = OutputKind("result of the study", "", "")  # beside the checkpoint and other files
_LARGEST_CHUNK = 10  # runs between two lines of the checkpoint reaching the disk
_PROCESSES = 4  # for each core; more only wait for each other
_MANY = 64  # workers that a cluster may have
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


class StudyHeading(SparseDocument):
    """What the document of every study has beside what was found."""

    study: str
    settings: dict[str, Any]
    seed: int
    runs: int
    failures: dict[str, int]  # runs that failed as a whole, by kind of error
    part: list[int] | None = None  # which part of how many; left out where the runs are all


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
    part: tuple[int, int] | None = None  # which part of how many the runs are

    def document(self) -> dict[str, Any]:
        """Return the document that ``legcal study --json`` prints."""
        heading = StudyHeading(
            study=self.study,
            settings=self.settings,
            seed=self.seed,
            runs=self.n_runs,
            failures=self.failures,
            part=list(self.part) if self.part else None,
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
    part: tuple[int, int] | None = None,
    merge: Sequence[Path] = (),
    beside: Callable[[StudyResult, Path], None] | None = None,
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
    workers : int, str or executor
        Number of processes, of which no more than a few for each core are started, or a cluster, as
        :func:`legcal.calibrate` takes them.
    output : Path, optional
        Folder for the checkpoint, the document and the figures. One that holds a checkpoint of
        the same study is continued; more runs than before are added to those that are there.
    progress : bool or callable
        True shows a bar on stderr; a function is called as ``progress(stage, done, total)``.
    part : (k, n), optional
        Only every n-th run, from run k - 1 on: n such parts make the study.
    merge : sequence of Path
        Folders of parts of the study, whose runs are taken over.
    beside : callable, optional
        Called as ``beside(result, folder)`` with the figures in the folder: what it writes there
        appears in the output with them.

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
    runs = _runs_of_part(n_runs, part)
    stage = f"Study {study.name}"
    with shown_progress(progress) as report, _folder(output) as folder:
        path = folder / CHECKPOINT_NAME
        first = header(study.name, study.settings, seed)
        kept = output is not None
        with open_checkpoint(path, first, study.is_record, kept=kept) as checkpoint:
            for other in merge:
                checkpoint.merge(other / CHECKPOINT_NAME, runs, study.is_record)
            missing = array("q", (run for run in runs if run not in checkpoint.offsets))
            done = len(runs) - len(missing)
            report(stage, done, len(runs))
            if missing:
                slots = _MANY
                if is_number(workers):
                    workers = slots = min(workers, len(missing), _PROCESSES * processors())
                with worker_pool(workers, "The study could not be finished", in_order=False) as run:
                    chunks = _chunks(missing, slots)
                    for lines in run(partial(run_chunk, study, seed), chunks):
                        checkpoint.append(lines)
                        done += len(lines)
                        report(stage, done, len(runs))
            result = replace(_result(study, seed, runs, checkpoint), part=part)
        if output is not None:
            _write(result, folder, beside)
    return result


def _runs_of_part(n_runs: int, part: tuple[int, int] | None) -> range:
    """Return the numbers of the runs; refuse a part that the study does not have."""
    if part is None:
        return range(n_runs)
    k, n = part
    if not 1 <= k <= n <= n_runs:
        raise UsageError(
            f"The study could not be run: found part {k}/{n}, needed K/N with K from 1 to N and N "
            f"no more than the {n_runs} runs; correct it."
        )
    return range(k - 1, n_runs, n)


def _result(study: Study, seed: int, runs: range, checkpoint: Checkpoint) -> StudyResult:
    """Return what runs found, read one after the other."""
    failures: Counter[str] = Counter()
    messages: list[str] = []

    def records() -> Iterator[Record]:
        for line in checkpoint.lines(runs):
            if "record" in line:
                yield line["record"]
            else:
                failures[line["failure"]["kind"]] += 1
                if not messages:
                    messages.append(line["failure"]["message"])

    summary = study.summary(records())
    if failures.total() == len(runs):
        raise DidNotConverge(
            f"The study {study.name} found nothing: all of its {len(runs)} runs failed, needed one "
            f"that does not; the first one says: {messages[0]}"
        )
    return StudyResult(study.name, study.settings, seed, len(runs), dict(failures), summary)


def _write(
    result: StudyResult, folder: Path, beside: Callable[[StudyResult, Path], None] | None
) -> None:
    """Write the document and the figures, all of them or nothing."""
    document = json.dumps(result.document(), indent=1, allow_nan=False).encode() + b"\n"
    try:
        with result_folder(folder, _STUDY) as new:
            for name, content in {**result.summary.files(), DOCUMENT_NAME: document}.items():
                (new / name).write_bytes(content)
            if beside is not None:
                beside(result, new)
    except OutOfResources as error:
        found = getattr(error.__cause__, "strerror", None) or str(error.__cause__)
        raise OutOfResources(
            f"{folder}: the result of the study could not be written: found '{found}', "
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
        check_path(output, _STUDY)
        _check_folder(output)
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(
            f"{output}: the study could not be written: found '{error.strerror}', needed a folder "
            "that can be created and read; give another output folder."
        ) from error
    yield output


def _check_folder(output: Path) -> None:
    """Refuse a folder that holds something else than a study."""
    checkpoint = output / CHECKPOINT_NAME
    if not output.is_dir() or is_begun(checkpoint):
        return
    others = [path for path in output.iterdir() if not path.name.endswith(TEMPORARY_SUFFIX)]
    if any(path != checkpoint or path.is_dir() for path in others):
        raise UsageError(
            f"{output}: the study could not be written: found a folder with other files and no "
            f"{CHECKPOINT_NAME} of a study, needed a new or empty folder or that of the same "
            "study; give another output folder."
        )


def _check_numbers(n_runs: int, seed: int, workers: Workers) -> None:
    """Refuse numbers that make no sense."""
    if n_runs > MOST_RUNS:
        raise UsageError(
            f"The study could not be run: found runs = {n_runs}, needed {MOST_RUNS} at most; give "
            "another number."
        )
    processes = workers if is_number(workers) else 1
    for name, found, least in (("runs", n_runs, 1), ("seed", seed, 0), ("workers", processes, 1)):
        if found < least:
            raise UsageError(
                f"The study could not be run: found {name} = {found}, needed {least} or more; "
                "give another number."
            )


# Runs in processes


def child_seed(seed: int, run: int) -> np.random.SeedSequence:
    """Return the seed of a run: child ``run`` of the study's seed, however many there are."""
    return np.random.SeedSequence(seed, spawn_key=(run,))


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
