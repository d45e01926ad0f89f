"""The Monte Carlo runner: many independent runs of one experiment, the same for any workers.

Run i has child i of the study's seed, whatever the number of runs and of processes.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from legcal.errors import DidNotConverge, LegcalError, UsageError
from legcal.files.folder import OutputKind, check_destination, result_folder
from legcal.files.schema import SparseDocument
from legcal.progress import Progress, shown_progress
from legcal.workers import Workers, is_number, processors, worker_pool

DOCUMENT_NAME = "study.json"
_STUDY = OutputKind("result of the study", DOCUMENT_NAME, "study")
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
    """Run a study.

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
        Folder for the document and the figures.
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
        If a number is out of range, or the folder has other content than a study.
    DidNotConverge
        If every run failed.
    OutOfResources
        If a file cannot be written or a process is ended from outside.
    """
    _check_numbers(n_runs, seed, workers)
    if output is not None:
        check_destination(output, _STUDY)
    stage, outcomes = f"Study {study.name}", dict[int, Record | LegcalError]()
    with shown_progress(progress) as report:
        report(stage, 0, n_runs)
        if is_number(workers):
            workers = min(workers, n_runs, _PROCESSES * processors())
        with worker_pool(workers, "The study could not be finished", in_order=False) as run:
            for number, outcome in run(partial(_outcome, study, seed), range(n_runs)):
                outcomes[number] = outcome
                report(stage, len(outcomes), n_runs)
    result = _result(study, seed, [outcomes[number] for number in range(n_runs)])
    if output is not None:
        document = json.dumps(result.document(), indent=1, allow_nan=False).encode() + b"\n"
        with result_folder(output, _STUDY) as folder:
            for name, content in {**result.summary.files(), DOCUMENT_NAME: document}.items():
                (folder / name).write_bytes(content)
            if beside is not None:
                beside(result, folder)
    return result


def _outcome(study: Study, seed: int, number: int) -> tuple[int, Record | LegcalError]:
    """Return the number of a run, and its record or its failure."""
    try:
        return number, study.one_run(np.random.SeedSequence(seed, spawn_key=(number,)))
    except LegcalError as error:
        return number, error


def _result(study: Study, seed: int, outcomes: list[Record | LegcalError]) -> StudyResult:
    """Combine runs."""
    failures = [outcome for outcome in outcomes if isinstance(outcome, LegcalError)]
    if len(failures) == len(outcomes):
        raise DidNotConverge(
            f"The study {study.name} found nothing: all of its {len(outcomes)} runs failed, needed "
            f"one that does not; the first one says: {failures[0]}"
        )
    heading = StudyHeading(
        study=study.name,
        settings=study.settings,
        seed=seed,
        runs=len(outcomes),
        failures=dict(Counter(type(failure).__name__ for failure in failures)),
    )
    records = (outcome for outcome in outcomes if not isinstance(outcome, LegcalError))
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


def failure_of(error: LegcalError) -> dict[str, str]:
    """Return a failure as a record."""
    return {"kind": type(error).__name__, "message": str(error)}
