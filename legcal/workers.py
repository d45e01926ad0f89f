"""Work on images one after the other or in several processes: the results are the same, bit by bit.

Threads do not pay: the work is many short steps, and they would wait for each other.
"""

import copyreg
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from threading import Thread
from typing import Any, Protocol, TypeVar

from scipy.spatial.transform import RigidTransform

from legcal.errors import OutOfResources
from legcal.signals import held_back_signals, leave_interrupts_to_parent, raise_if_stopped

T = TypeVar("T")


def _reduced(motion: RigidTransform) -> tuple[Any, ...]:
    """Return how a motion is pickled: SciPy would make its matrix orthogonal once more.

    That changes last digits, and measurements by a pickled motion would be others.
    """
    return partial(RigidTransform, normalize=False), (motion.as_matrix(),)


copyreg.pickle(RigidTransform, _reduced)

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
    uses them must be safe to import (``if __name__ == "__main__":``). When the block is left by
    an exception, they end at once, in the middle of their work.

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
    context = get_context("spawn")
    held, lifeline = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_end_with, initargs=(held,))

    def run(task: Callable[[int], T], rows: Sequence[int], /) -> Iterable[T]:
        chunk = max(1, len(rows) // (_CHUNKS * workers))
        with held_back_signals():  # processes are started in it
            return pool.map(task, rows, chunksize=chunk)

    try:
        yield run
    except BrokenProcessPool as error:
        raise_if_stopped()  # the signal may have reached them first
        raise OutOfResources(
            f"The images could not be worked on: found that one of {workers} processes was ended "
            "from outside, needed all of them to the end; see that there is enough memory and try "
            "again."
        ) from error
    except BaseException:
        lifeline.close()  # nobody waits for work that is not wanted any more
        raise
    finally:
        try:
            pool.shutdown(cancel_futures=True)
        finally:
            lifeline.close()
            held.close()


def _end_with(lifeline: Connection) -> None:
    """Leave the answer to Ctrl-C to the process that started this one, and end when it says so.

    The other end of the lifeline closes when the pool is stopped, or its process killed: a pool's
    processes would then wait for work for ever.
    """
    leave_interrupts_to_parent()
    Thread(target=_wait_for_end, args=(lifeline,), daemon=True).start()


def _wait_for_end(lifeline: Connection) -> None:
    wait([lifeline])
    os._exit(1)
