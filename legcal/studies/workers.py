"""Runs of a study in this process or in several, in chunks, as they come."""

from __future__ import annotations

import os
import signal
import sys
import time
import warnings
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from threading import Thread
from typing import Any

import numpy as np
from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky.process_executor import BrokenProcessPool

from legcal.errors import LegcalError, OutOfResources
from legcal.processors import processors
from legcal.studies.study import Study

_LARGEST_CHUNK = 10  # runs between two lines of the checkpoint reaching the disk
_PROCESSES = 4  # for each core; more only wait for each other
_CHUNKS = 16  # for each process: the work is shared evenly to the end


def child_seed(seed: int, run: int) -> np.random.SeedSequence:
    """Return the seed of a run: child ``run`` of the study's seed, however many there are."""
    return np.random.SeedSequence(seed, spawn_key=(run,))


def lines_of_runs(
    study: Study, seed: int, runs: Sequence[int], workers: int
) -> Generator[list[dict[str, Any]]]:
    """Return the lines of runs, chunk by chunk, in the order in which they are finished.

    Chunks are handed out as processes get free, so that memory does not grow with their number.

    Parameters
    ----------
    study : Study
        What a run does.
    seed : int
        Seed of the study.
    runs : sequence of int
        Numbers of the runs.
    workers : int
        Number of processes, as many as there are runs and a few for each core at most; one means
        this one.

    Yields
    ------
    list of dict
        ``{"run": number, "record": ...}`` or ``{"run": number, "failure": {"kind": ...,
        "message": ...}}``.

    Raises
    ------
    OutOfResources
        If a process is ended from outside.
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
