"""The one way to run work: results are the same in one process, several or a cluster, bit by bit.

Threads do not pay: the work is many short steps, and they would wait for each other.
"""

import copyreg
import mmap
import os
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import islice
from multiprocessing import connection, get_context, resource_tracker
from threading import Thread
from types import MappingProxyType
from typing import Any, Protocol, SupportsIndex, TypeGuard, TypeVar, cast
from uuid import uuid4
from weakref import WeakValueDictionary, finalize

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from legcal.cluster import Cluster, GivenExecutor, Submitter, connected
from legcal.errors import OutOfResources, UsageError
from legcal.signals import held_back_signals, leave_interrupts_to_parent, raise_if_stopped

S = TypeVar("S")
T = TypeVar("T")


def _reduced(motion: RigidTransform) -> tuple[Any, ...]:
    """Return how a motion is pickled: SciPy would make its matrix orthogonal once more.

    That changes last digits, and measurements by a pickled motion would be others.
    """
    return partial(RigidTransform, normalize=False), (motion.as_matrix(),)


def _read_only(mapping: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(mapping)


copyreg.pickle(RigidTransform, _reduced)
copyreg.pickle(MappingProxyType, lambda mapping: (_read_only, (dict(mapping),)))

Workers = int | str | Submitter
"""A number of processes; the address of a Dask scheduler; or a Dask client or another executor."""


def is_number(workers: object) -> TypeGuard[int]:
    """Say whether workers are a number of processes, or nothing that could be used."""
    return not isinstance(workers, str) and not hasattr(workers, "submit")


_CHUNKS = 4  # tasks for each worker: few enough to spare messages, enough to share the work
_AHEAD = 2  # tasks for each worker that are handed out where results come as they are finished
_AHEAD_IN_ORDER = 2 * _CHUNKS  # where they wait for those before them
_ONE_THREAD = (  # of these libraries, read when a process loads them
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)


class Run(Protocol):
    """How work is carried out for all rows; results come in the order that the pool was given."""

    def __call__(self, task: Callable[[S], T], rows: Iterable[S], /) -> Iterable[T]:
        """Return the results."""


def in_turn(task: Callable[[S], T], rows: Iterable[S], /) -> Iterable[T]:
    """Work on one row after the other, in this process."""
    return map(task, rows)


class Pool:
    """A :class:`Run`, and what is to be said of results that come from it."""

    def __init__(self, run: Run, backend: Cluster | GivenExecutor | None = None) -> None:
        self._run, self._backend = run, backend

    def __call__(self, task: Callable[[S], T], rows: Iterable[S], /) -> Iterable[T]:
        """Return the results."""
        return self._run(task, rows)

    @property
    def notes(self) -> tuple[str, ...]:
        """How workers differ from this process, where results depend on it."""
        return () if self._backend is None else self._backend.notes


@contextmanager
def worker_pool(
    workers: Workers, failure: str = "The images could not be worked on", *, in_order: bool = True
) -> Iterator[Pool]:
    """Give a way to work in that many processes, or on a cluster; one means in this process.

    Processes are started when they are first needed. On Linux they are copies of this one, with all
    that it has loaded, if it has no threads, which copies would lack; else they are started anew: a
    program that uses them must be safe to import (``if __name__ == "__main__":``). Libraries have
    one thread in each. When the block is left by an exception, they end at once, in the middle of
    their work.

    Parameters
    ----------
    workers : int, str or Submitter
        Number of processes, the address of a Dask scheduler, or a Dask client or executor.
    failure : str
        What could not be done if workers are lost: the message begins so.
    in_order : bool
        Whether results come in the order of the rows. Otherwise they come as they are finished.
        Rows are taken as workers get free: memory does not grow with their number, but for local
        processes and results in order, where all rows are taken at once.

    Raises
    ------
    OutOfResources
        If one of the processes is ended from outside, or a cluster lost.
    UsageError
        If workers cannot be used.
    """
    if not is_number(workers):
        with connected(cast("str | Submitter", workers), failure) as backend:

            def run_there(task: Callable[[S], T], rows: Iterable[S], /) -> Iterable[T]:
                return _results(backend, partial(_each, task), rows, in_order)

            yield Pool(run_there, backend)
        return
    if not isinstance(workers, SupportsIndex):
        raise UsageError(
            f"{failure}: found {type(workers).__name__} as workers, needed a number of processes, "
            "the address of a Dask scheduler, or an object with submit as executors have it; give "
            "one."
        )
    if workers <= 1:
        yield Pool(in_turn)
        return
    with ExitStack() as stack:
        started: list[_Processes] = []

        def run(task: Callable[[S], T], rows: Iterable[S], /) -> Iterable[T]:
            if not started:
                started.append(stack.enter_context(_processes(workers)))
            return _results(started[0], partial(_each, task), rows, in_order)

        try:
            yield Pool(run)
        except BrokenProcessPool as error:
            raise_if_stopped()  # the signal may have reached them first
            raise OutOfResources(
                f"{failure}: found that one of {workers} processes was ended from outside, needed "
                "all of them to the end; see that there is enough memory and start the same "
                "command again."
            ) from error
        except BaseException:
            for processes in started:
                processes.lifeline.close()  # nobody waits for work that is not wanted any more
            raise


class _Processes:
    """Processes of this machine."""

    patience = None
    most_rows = None

    def __init__(
        self, pool: ProcessPoolExecutor, slots: int, lifeline: connection.Connection
    ) -> None:
        self.slots, self.lifeline, self._pool = slots, lifeline, pool

    def submitter(
        self, work: Callable[[Sequence[S]], list[T]]
    ) -> Callable[[Sequence[S]], Future[list[T]]]:
        """Return what hands rows out."""

        def submit(rows: Sequence[S]) -> Future[list[T]]:
            with _starting():
                return self._pool.submit(work, rows)

        return submit

    def check(self) -> None:
        """Trust the pool, which says by itself that it is broken."""


@contextmanager
def _processes(workers: int) -> Iterator[_Processes]:
    """Give the processes, which end with their lifeline."""
    copies = _has_one_thread()
    if not copies:
        _start_tracker()
    context = get_context("fork" if copies else "spawn")
    held, lifeline = context.Pipe(duplex=False)
    arguments = (held, lifeline if copies else None)
    pool = ProcessPoolExecutor(
        workers, mp_context=context, initializer=_end_with, initargs=arguments
    )
    try:
        yield _Processes(pool, workers, lifeline)
    finally:
        try:
            pool.shutdown(cancel_futures=True)
        finally:
            lifeline.close()
            held.close()


def _has_one_thread() -> bool:
    """Say whether this process has one thread, those of libraries counted; no if unknown."""
    try:
        return sys.platform == "linux" and len(os.listdir("/proc/self/task")) == 1
    except OSError:
        return False


def _results(
    backend: Cluster | GivenExecutor | _Processes,
    work: Callable[[Sequence[S]], list[T]],
    rows: Iterable[S],
    in_order: bool,
) -> Iterator[T]:
    """Yield results; rows are handed out as those before them are done.

    What is not wanted any more is not cancelled here: a pool whose processes end would stand.
    """
    size, ahead = 1, _AHEAD
    if in_order:
        rows = list(rows)
        size = max(1, min(len(rows) // (_CHUNKS * backend.slots), backend.most_rows or len(rows)))
        ahead = _AHEAD_IN_ORDER
    rest, running = iter(rows), deque[Future[list[T]]]()
    submit = backend.submitter(work)
    while True:
        for _ in range(ahead * backend.slots - len(running)):
            if not (part := list(islice(rest, min(size, backend.most_rows or size)))):
                break
            running.append(submit(part))
        if not running:
            return
        waited = [running[0]] if in_order else list(running)
        while not (done := wait(waited, backend.patience, FIRST_COMPLETED).done):
            backend.check()
        for future in sorted(done, key=lambda future: future.exception() is not None):
            running.remove(future)
            yield from future.result()  # before an error of another one


def _each(task: Callable[[S], T], rows: Sequence[S]) -> list[T]:
    return [task(row) for row in rows]


class KeptArrays:
    """Arrays of up to two dimensions, by number, that a process and its copies keep for each other.

    What finds no room is not kept. A process that was started anew keeps nothing, nor does any on
    a system without memory files.
    """

    def __init__(self, n: int, most_bytes: int) -> None:
        self._name = uuid4().hex  # numbers of processes are the same on several machines
        _kept_arrays[self._name] = self
        self._file, first = -1, 8 * _ENTRY * (n + 1)
        self._most = first + most_bytes
        if sys.platform != "linux" or n == 0:
            return
        try:
            file = os.memfd_create("arrays")
            finalize(self, os.close, file)
            os.truncate(file, self._most)
            memory = mmap.mmap(file, self._most)  # it is taken as it is written
        except OSError:
            return
        self._file, self._bytes = file, np.frombuffer(memory, dtype=np.uint8)
        # Where each array begins, its type and shape; in the end where the next one will begin.
        self._entries = self._bytes[:first].view(np.int64).reshape(-1, _ENTRY)
        self._entries[n, 0] = first

    def __reduce__(self) -> tuple[Any, ...]:
        return _kept_here, (self._name,)

    def get(self, k: int) -> NDArray[Any] | None:
        """Return a copy of array k, None if it is not kept."""
        if self._file < 0:
            return None
        with self._locked():
            begin, kind, *shape = self._entries[k].tolist()
        if not kind:
            return None
        dtype = np.dtype(chr(kind))
        end = begin + shape[0] * shape[1] * dtype.itemsize
        return self._bytes[begin:end].view(dtype).reshape(shape).copy()

    def keep(self, k: int, values: NDArray[Any]) -> None:
        """Keep array k if there is room."""
        if self._file < 0:
            return
        with self._locked():
            begin = int(self._entries[-1, 0])
            end = begin + values.nbytes
            if self._entries[k, 1] == 0 and end <= self._most:
                self._bytes[begin:end] = np.ascontiguousarray(values).view(np.uint8).ravel()
                self._entries[k] = begin, ord(values.dtype.char), *values.shape
                self._entries[-1, 0] = -(-end // 8) * 8

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Keep other processes from looking up and keeping; one that is killed lets go."""
        os.lockf(self._file, os.F_LOCK, 0)
        try:
            yield
        finally:
            os.lockf(self._file, os.F_ULOCK, 0)


_ENTRY = 4  # numbers
_kept_arrays: WeakValueDictionary[str, KeptArrays] = WeakValueDictionary()


def _kept_here(name: str) -> KeptArrays:
    """Return the arrays of a name, if this process made them or is a copy of the one that did."""
    return _kept_arrays.get(name) or KeptArrays(0, 0)


# How processes start and end


def _start_tracker() -> None:
    """Start the process that removes semaphores of a killed program, without its warning.

    It lets Ctrl-C and SIGTERM through when it starts, so that it cannot start with the others.
    """
    if os.name != "posix":
        return
    quiet = "ignore:resource_tracker"
    with held_back_signals():  # it is not to end by SIGHUP
        sys.warnoptions.append(quiet)  # handed to the processes that are started
        try:
            resource_tracker.ensure_running()
        finally:
            sys.warnoptions.remove(quiet)


@contextmanager
def _starting() -> Iterator[None]:
    """Let processes start with signals held back and with one thread for each library."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    with held_back_signals():
        os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    os.environ.pop(name, None)
                else:
                    os.environ[name] = value


def _end_with(held: connection.Connection, lifeline: connection.Connection | None) -> None:
    """Leave the answer to Ctrl-C to the process that started this one, and end when it does.

    The other end of what is held closes when the pool is stopped, or its process killed: a pool's
    processes would then wait for work for ever. A copied process has a copy of that end.
    """
    leave_interrupts_to_parent()
    if lifeline is not None:
        lifeline.close()
    Thread(target=_wait_for_end, args=(held,), daemon=True).start()


def _wait_for_end(lifeline: connection.Connection) -> None:
    connection.wait([lifeline])
    os._exit(1)
