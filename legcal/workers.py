"""Running work in this process, in several, on a Dask cluster or by an executor.

All of them have the interface of ``concurrent.futures`` executors, and equal results to the last
bit. Threads are no use: the work is many short steps, and they would wait for each other.
"""

from __future__ import annotations

import copyreg
import logging
import math
import os
import pickle
import re
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, suppress
from functools import cache, partial
from itertools import islice
from multiprocessing import connection, get_context
from threading import Event, RLock, Thread
from time import monotonic
from types import MappingProxyType
from typing import Any, Protocol, SupportsIndex, TypeGuard, TypeVar, cast

from scipy.spatial.transform import RigidTransform

from legcal.errors import LegcalError, OutOfResources, UsageError
from legcal.signals import held_back_signals, leave_interrupts_to_parent
from legcal.version import __version__

S = TypeVar("S")
T = TypeVar("T")


def _reduced(motion: RigidTransform) -> tuple[Any, ...]:
    """Return the pickled form of a motion, since SciPy would orthogonalise its matrix again.

    That changes the last digits, and with them results from a pickled motion.
    """
    return partial(RigidTransform, normalize=False), (motion.as_matrix(),)


def _read_only(mapping: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(mapping)


copyreg.pickle(RigidTransform, _reduced)
copyreg.pickle(MappingProxyType, lambda mapping: (_read_only, (dict(mapping),)))


class Submitter(Protocol):
    """A Dask client, or an executor of ``concurrent.futures``."""

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> Any:
        """Return the future of a call."""


_Submit = Callable[..., Any]
Workers = int | str | Submitter
"""A number of processes; the address of a Dask scheduler; or a Dask client or another executor."""


def processors() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def is_number(workers: object) -> TypeGuard[int]:
    """Return whether workers are a number of processes, valid or not."""
    return not isinstance(workers, str) and not hasattr(workers, "submit")


class Run(Protocol):
    """A function that runs a task for all rows, with results in the order chosen for the pool."""

    def __call__(self, task: Callable[[S], T], rows: Iterable[S], /) -> Iterable[T]:
        """Return the results."""


def in_turn(task: Callable[[S], T], rows: Iterable[S], /) -> Iterable[T]:
    """Work on one row after the other, in this process."""
    return map(task, rows)


@contextmanager
def worker_pool(
    workers: Workers, failure: str = "The images could not be worked on", *, in_order: bool = True
) -> Iterator[Run]:
    """Give a function that runs tasks in processes or on a cluster; 1 means in this process.

    Where results come in order this process is one of the workers, which spares starting another
    one and copying its memory. Others are started when they are first needed. On Linux they are
    forked, with all loaded modules, unless this process has threads, which forks would lack; else
    they are spawned: a program that uses them must be safe to import (``if __name__ ==
    "__main__":``). Libraries have one thread in each. When the block is left by an exception,
    processes end at once, in the middle of their work.

    Results come in the order of the rows, which are all taken at once, or, unless *in_order*, as
    they are finished, and rows are taken as workers become free: memory does not grow with their
    number. A message about workers that are lost begins with *failure*.
    """
    if isinstance(workers, SupportsIndex) and workers <= 1:
        yield in_turn
        return
    with _told_if_ended(failure), ExitStack() as stack:
        submit: _Submit
        most = math.inf  # an executor or a cluster is handed all that there is
        if isinstance(workers, SupportsIndex):
            n = int(workers) - 1 if in_order else int(workers)
            started = cache(lambda: stack.enter_context(_processes(n)))
            submit, slots, most = lambda *call: started().submit(*call), int(workers), _AHEAD * n
        elif isinstance(workers, str):
            client = _client(workers, failure)
            stack.callback(_close, client)
            submit, slots = stack.enter_context(_cluster(client, failure))
        elif hasattr(workers, "get_executor"):
            submit, slots = stack.enter_context(_cluster(workers, failure))
        elif hasattr(workers, "submit"):
            submit, slots = workers.submit, getattr(workers, "_max_workers", None) or processors()
        else:
            raise UsageError(
                f"{failure}: found {type(workers).__name__} as workers, needed a number of "
                "processes, the address of a Dask scheduler, or an object with submit as executors "
                "have it; give one."
            )
        if in_order:
            yield partial(_in_order, submit, slots, most)
        else:
            yield partial(_as_finished, submit, slots)


# Handing out


_TASKS = 4  # for each worker: few enough to spare messages, enough to share the work
_AHEAD = 2  # tasks handed out ahead for each process
_lock = RLock()  # held while rows are worked on


def _in_order(
    submit: _Submit, slots: int, most: float, task: Callable[[S], T], rows: Iterable[S]
) -> Iterator[T]:
    """Yield results in order; tasks that are no longer needed are cancelled with the executor.

    When ``most`` tasks are handed out and the next result is not there, one is done here.
    """
    rows = list(rows)
    size = max(1, len(rows) // (_TASKS * slots))
    parts = deque(rows[k : k + size] for k in range(0, len(rows), size))
    futures = deque[Future[list[T]]]()
    while parts or futures:
        while parts and sum(not future.done() for future in futures) < most:
            futures.append(submit(_each, task, parts.popleft()))
        if not parts or futures[0].done():
            yield from futures.popleft().result()
            continue
        here = Future[list[T]]()
        futures.append(here)
        try:
            here.set_result(_each(task, parts.popleft()))
        except LegcalError as error:  # in its turn: rows before may be refused, too
            here.set_exception(error)


def _as_finished(
    submit: _Submit, slots: int, task: Callable[[S], T], rows: Iterable[S]
) -> Iterator[T]:
    """Yield results as they are finished; what is handed out may be cancelled with the executor."""
    remaining, running = iter(rows), set[Future[list[T]]]()
    while True:
        free = _AHEAD * slots - len(running)
        running |= {submit(_each, task, [row]) for row in islice(remaining, free)}
        if not running:
            return
        done, running = wait(running, return_when=FIRST_COMPLETED)
        for future in sorted(done, key=lambda future: future.exception() is not None):
            yield from future.result()  # before an error of another task


def _each(task: Callable[[S], T], rows: Sequence[S]) -> list[T]:
    """Work on one row after the other, whatever the number of threads of a worker.

    Libraries and caches are not thread-safe.
    """
    with _lock:
        return [task(row) for row in rows]


# Processes


_ONE_THREAD = (  # variables for the number of threads, read when a process loads a library
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)


class _Processes(ProcessPoolExecutor):
    def submit(self, function: Any, /, *arguments: Any, **named: Any) -> Any:
        """Submit a call; new processes for it have one thread for each library."""
        before = {name: os.environ.get(name) for name in _ONE_THREAD}
        with held_back_signals():
            os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
            try:
                return super().submit(function, *arguments, **named)
            finally:
                for name, value in before.items():
                    if value is None:
                        del os.environ[name]
                    else:
                        os.environ[name] = value


@contextmanager
def _processes(n: int) -> Iterator[_Processes]:
    """Give processes that end with the block, or with this process."""
    copies = _has_one_thread()
    context = get_context("fork" if copies else "spawn")
    held, lifeline = context.Pipe(duplex=False)
    pool = _Processes(n, context, _end_with, (held, lifeline if copies else None))
    try:
        yield pool
    except BaseException:
        lifeline.close()  # nobody waits for work that is not wanted any more
        raise
    finally:
        try:
            pool.shutdown(cancel_futures=True)
        finally:
            lifeline.close()
            held.close()


def _has_one_thread() -> bool:
    """Return whether this process has one thread, including libraries; False if unknown."""
    try:
        return sys.platform == "linux" and len(os.listdir("/proc/self/task")) == 1
    except OSError:
        return False


def _end_with(held: connection.Connection, lifeline: connection.Connection | None) -> None:
    """Leave the handling of Ctrl-C to the parent process, and end when it does.

    The other end of the held connection closes when the pool is stopped, or its process killed: a
    pool's processes would then wait for work for ever. A forked process has a copy of that end.
    """
    leave_interrupts_to_parent()
    if lifeline is not None:
        lifeline.close()
    Thread(target=_wait_for_end, args=(held,), daemon=True).start()


def _wait_for_end(lifeline: connection.Connection) -> None:
    connection.wait([lifeline])
    os._exit(1)


@contextmanager
def _told_if_ended(failure: str) -> Iterator[None]:
    """Refuse in one sentence if a process was ended."""
    try:
        yield
    except BrokenProcessPool as error:
        raise OutOfResources(
            f"{failure}: found that one of the processes was ended from outside, needed all of "
            "them to the end; see that there is enough memory and start the same command again."
        ) from error


# Clusters


CONNECTING = 10.0  # [s] maximum time until a scheduler answers and has a worker
ALONE = 60.0  # [s] without any worker, after which work is given up
_ADDRESS = re.compile(r"((tcp|tls|ws|wss|ucx)://)?[^/]+:\d+/?")


def _client(address: str, failure: str) -> Any:
    try:
        from distributed import Client
        from tornado.websocket import WebSocketError
    except ImportError as error:
        raise UsageError(
            f"{failure}: found no package distributed, needed it for the cluster {address}; "
            "install it (pip install 'legcal[cluster]')."
        ) from error
    if not _ADDRESS.fullmatch(address):
        raise UsageError(
            f"{failure}: found '{address}', needed the address of a Dask scheduler; write it like "
            "tcp://host:8786."
        )
    for name in ("distributed", "distributed.client"):  # our messages replace theirs
        logging.getLogger(name).setLevel(logging.CRITICAL)
    clients: list[Client] = []
    failures: list[str] = []

    class Connecting(Client):
        """A client that can be closed before its constructor returns."""

        def start(self, **settings: Any) -> None:
            """Connect to the scheduler."""
            clients.append(self)
            super().start(**settings)  # type: ignore[no-untyped-call]

    def connect() -> None:
        try:
            Connecting(address, timeout=CONNECTING, set_as_default=False)  # type: ignore[no-untyped-call]
        except (
            OSError, ValueError, TypeError, LookupError, RuntimeError, MemoryError, WebSocketError,
            UnboundLocalError,  # in the library, where the client is closed meanwhile
        ) as error:  # fmt: skip
            failures.append(f"'{error}'")

    # In a thread: the library waits for ever for a port that accepts connections without answering.
    thread = Thread(target=connect, daemon=True)
    thread.start()
    thread.join(CONNECTING + 0.5)
    if clients and clients[0].status == "running":
        return clients[0]
    cause = failures[0] if failures else "no answer"
    for client in clients:
        _close(client)
    raise OutOfResources(
        f"{failure}: found no Dask scheduler at {address} ({cause}), needed one; see that it runs "
        "(dask scheduler), and that the address is its own, with the port 8786 unless it was "
        "started with another one, not that of its page (8787)."
    )


def _close(client: Any) -> None:
    """Close a client, whatever its scheduler does.

    Otherwise garbage collection would close it in any thread, and could block the loop of another
    client.
    """
    with suppress(OSError):
        client.close(timeout=2)


@contextmanager
def _cluster(client: Any, failure: str) -> Iterator[tuple[_Submit, int]]:
    """Give a function that submits calls to the workers of a client, and their number.

    Dask repeats the work of a dead worker on another one. Where none is left, it would wait for
    ever: work that has had no worker for ``ALONE`` seconds is cancelled.
    """
    from distributed import TimeoutError as NoWorker
    from distributed.comm.core import CommClosedError
    from distributed.scheduler import KilledWorker

    address, ended, lost = client.scheduler.address, Event(), Event()

    def watch(executor: Any) -> None:
        seen = monotonic()
        while not ended.wait(ALONE / 6.0):
            with suppress(OSError, RuntimeError):  # from a scheduler that is gone
                seen = monotonic() if client.nthreads() else seen
            if monotonic() - seen > ALONE:
                lost.set()
                executor.shutdown(wait=False)
                return

    try:
        client.wait_for_workers(1, timeout=CONNECTING)
        _compare_versions(client.run(_version, on_error="return"), failure)
        executor = client.get_executor(pure=False)

        def submit(*call: Any) -> Future[Any]:
            if lost.is_set():
                raise CancelledError
            return cast("Future[Any]", executor.submit(_called, pickle.dumps(call)))

        Thread(target=watch, args=(executor,), daemon=True).start()
        try:
            yield submit, len(client.nthreads())
        finally:
            ended.set()
            executor.shutdown(wait=False)
    except KilledWorker as error:
        raise OutOfResources(
            f"{failure}: found that several workers of {address} were ended from outside at the "
            "same piece of work, needed one that finishes it; see that they have enough memory "
            "and start the same command again."
        ) from error
    except (NoWorker, CancelledError, CommClosedError) as error:
        if isinstance(error, NoWorker) or lost.is_set():
            raise OutOfResources(
                f"{failure}: found no worker at the scheduler {address}, needed one; start some "
                f"(dask worker {address} --nthreads 1) and the same command again."
            ) from error
        raise OutOfResources(
            f"{failure}: found that the scheduler {address} does not answer any more, needed it to "
            "the end; start it and the same command again."
        ) from error


def _called(call: bytes) -> Any:
    """Call a pickled function: schedulers, which unpickle tasks, need not import it."""
    function, *arguments = pickle.loads(call)
    return function(*arguments)


def _version() -> str:
    return __version__


def _compare_versions(version_of_worker: dict[str, object], failure: str) -> None:
    """Refuse workers without legcal, or with another version of it."""
    for worker, version in version_of_worker.items():
        if version != __version__:
            raise UsageError(
                f"{failure}: found legcal {version} at the worker {worker}, needed {__version__} "
                "as here; install it where the workers run."
            )
