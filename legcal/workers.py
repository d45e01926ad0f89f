"""Work on images one after the other, or in several processes.

Threads do not pay: the work is many short steps, and they would wait for each other.
"""

import os
import signal
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from threading import Thread
from typing import Protocol, TypeVar

from legcal.errors import OutOfResources

T = TypeVar("T")

_CHUNKS = 4  # tasks for each process: few enough to spare messages, enough to share the work


class Run(Protocol):
    """How work is carried out for all rows; results come in the order of the rows."""

    def __call__(self, task: Callable[[int], T], rows: Sequence[int], /) -> Iterable[T]:
        """Return the results."""


def in_turn(task: Callable[[int], T], rows: Sequence[int], /) -> Iterable[T]:
    """Work on one row after the other, in this process."""
    return map(task, rows)


@contextmanager
def worker_pool(workers: int) -> Iterator[Run]:
    """Give a way to work in that many processes; one means in this process.

    Processes are started when they are first needed, anew and not as copies: a program that
    uses them must be safe to import (``if __name__ == "__main__":``).

    Parameters
    ----------
    workers : int
        Number of processes.

    Raises
    ------
    OutOfResources
        If one of the processes is ended from outside.
    """
    if workers <= 1:
        yield in_turn
        return
    pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_follow_parent)

    def run(task: Callable[[int], T], rows: Sequence[int], /) -> Iterable[T]:
        chunk = max(1, len(rows) // (_CHUNKS * workers))
        return pool.map(task, rows, chunksize=chunk)

    try:
        yield run
    except BrokenProcessPool as error:
        raise OutOfResources(
            f"The images could not be worked on: found that one of {workers} processes was ended "
            "from outside, needed all of them to the end; see that there is enough memory and try "
            "again."
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def _follow_parent() -> None:
    """Leave the answer to Ctrl-C to the process that started this one, and end when it does.

    A pool's processes wait for work for ever when their parent is killed.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
