"""The one way to run work: in this process, in several, on a Dask cluster or by an executor.

All of them are executors as those of ``concurrent.futures``, and results are the same bit by bit.
Threads do not pay: the work is many short steps, and they would wait for each other.
"""

from __future__ import annotations

import copyreg
import logging
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
from threading import RLock, Thread
from types import MappingProxyType
from typing import Any, Protocol, SupportsIndex, TypeGuard, TypeVar, cast

from scipy.spatial.transform import RigidTransform

from legcal.errors import OutOfResources, UsageError
from legcal.processors import processors
from legcal.signals import held_back_signals, leave_interrupts_to_parent
from legcal.version import __version__

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


class Submitter(Protocol):
    """A Dask client, or an executor as those of ``concurrent.futures``."""

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> Any:
        """Return the future of a call."""


_Submit = Callable[..., Any]
Workers = int | str | Submitter
"""A number of processes; the address of a Dask scheduler; or a Dask client or another executor."""


def is_number(workers: object) -> TypeGuard[int]:
    """Say whether workers are a number of processes, or nothing that could be used."""
    return not isinstance(workers, str) and not hasattr(workers, "submit")


class Run(Protocol):
    """How work is carried out for all rows; results come in the order that the pool was given."""

    def __call__(self, task: Callable[[S], T], rows: Iterable[S], /) -> Iterable[T]:
        """Return the results."""


def in_turn(task: Callable[[S], T], rows: Iterable[S], /) -> Iterable[T]:
    """Work on one row after the other, in this process."""
    return map(task, rows)


@contextmanager
def worker_pool(
    workers: Workers, failure: str = "The images could not be worked on", *, in_order: bool = True
) -> Iterator[Run]:
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
        Whether results come in the order of the rows, which are all taken at once. Otherwise they
        come as they are finished, and rows are taken as workers get free: memory does not grow with
        their number.

    Raises
    ------
    OutOfResources
        If one of the processes is ended from outside, or a cluster does not answer or is lost.
    UsageError
        If workers cannot be used.
    """
    if isinstance(workers, SupportsIndex) and workers <= 1:
        yield in_turn
        return
    with _told_if_ended(failure), ExitStack() as stack:
        submit: _Submit
        if isinstance(workers, SupportsIndex):
            started = cache(lambda: stack.enter_context(_processes(workers)))
            submit, slots = lambda *call: started().submit(*call), int(workers)
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
        yield partial(_results, submit, slots, in_order)


# Handing out


_TASKS = 4  # for each worker: few enough to spare messages, enough to share the work
_AHEAD = 2  # tasks for each worker that are handed out where results come as they are finished
_lock = RLock()  # held while rows are worked on


def _results(
    submit: _Submit,
    slots: int,
    in_order: bool,
    task: Callable[[S], T],
    rows: Iterable[S],
) -> Iterator[T]:
    """Yield results; what is not wanted any more is cancelled with the executor."""
    if in_order:
        rows = list(rows)
        size = max(1, len(rows) // (_TASKS * slots))
        parts = (rows[k : k + size] for k in range(0, len(rows), size))
        futures = deque(submit(_each, task, part) for part in parts)
        while futures:
            yield from futures.popleft().result()
        return
    rest, running = iter(rows), set[Future[list[T]]]()
    while True:
        free = _AHEAD * slots - len(running)
        running |= {submit(_each, task, [row]) for row in islice(rest, free)}
        if not running:
            return
        done, running = wait(running, return_when=FIRST_COMPLETED)
        for future in sorted(done, key=lambda future: future.exception() is not None):
            yield from future.result()  # before an error of another one


def _each(task: Callable[[S], T], rows: Sequence[S]) -> list[T]:
    """Work on one row after the other, whatever the number of threads of a worker.

    Libraries and caches are not made for more.
    """
    with _lock:
        return [task(row) for row in rows]


# Processes


_ONE_THREAD = (  # of these libraries, read when a process loads them
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)


class _Processes(ProcessPoolExecutor):
    """Processes of this machine."""

    def submit(self, function: Any, /, *arguments: Any, **named: Any) -> Any:
        """Submit a call; processes that are started for it have one thread for each library."""
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
    """Say whether this process has one thread, those of libraries counted; no if unknown."""
    try:
        return sys.platform == "linux" and len(os.listdir("/proc/self/task")) == 1
    except OSError:
        return False


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


@contextmanager
def _told_if_ended(failure: str) -> Iterator[None]:
    """Say in one sentence that a process was ended."""
    try:
        yield
    except BrokenProcessPool as error:
        raise OutOfResources(
            f"{failure}: found that one of the processes was ended from outside, needed all of "
            "them to the end; see that there is enough memory and start the same command again."
        ) from error


# Clusters


CONNECTING = 10.0  # [s] in which a scheduler must answer and have a worker
_ADDRESS = re.compile(r"((tcp|tls|ws|wss|ucx)://)?[^/]+:\d+/?")


def _client(address: str, failure: str) -> Any:
    """Return a client of the scheduler at an address."""
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
    for name in ("distributed", "distributed.client"):  # what they say is said here
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

    # By a thread: the library waits for ever for a port that takes connections and does not answer.
    thread = Thread(target=connect, daemon=True)
    thread.start()
    thread.join(CONNECTING + 0.5)
    if clients and clients[0].status == "running":
        return clients[0]
    said = failures[0] if failures else "no answer"
    for client in clients:
        _close(client)
    raise OutOfResources(
        f"{failure}: found no Dask scheduler at {address} ({said}), needed one; see that it runs "
        "(dask scheduler), and that the address is its own, with the port 8786 unless it was "
        "started with another one, not that of its page (8787)."
    )


def _close(client: Any) -> None:
    """Close a client, whatever its scheduler does.

    One that is left to be collected closes in the thread where that happens: it would block the
    loop of another client.
    """
    with suppress(OSError):
        client.close(timeout=2)


@contextmanager
def _cluster(client: Any, failure: str) -> Iterator[tuple[_Submit, int]]:
    """Give what submits calls to the workers of a client, and their number.

    Dask has another worker do what a worker that dies was working on.
    """
    from distributed import TimeoutError as NoWorker
    from distributed.comm.core import CommClosedError
    from distributed.scheduler import KilledWorker

    address = client.scheduler.address
    try:
        client.wait_for_workers(1, timeout=CONNECTING)
        _compare_versions(client.run(_version, on_error="return"), failure)
        executor = client.get_executor(pure=False)

        def submit(*call: Any) -> Future[Any]:
            return cast("Future[Any]", executor.submit(_called, pickle.dumps(call)))

        try:
            yield submit, len(client.nthreads())
        finally:
            executor.shutdown(wait=False)
    except NoWorker as error:
        raise OutOfResources(
            f"{failure}: found no worker at the scheduler {address}, needed one; start some (dask "
            f"worker {address} --nthreads 1) and the same command again."
        ) from error
    except KilledWorker as error:
        raise OutOfResources(
            f"{failure}: found that several workers of {address} were ended from outside at the "
            "same piece of work, needed one that finishes it; see that they have enough memory "
            "and start the same command again."
        ) from error
    except (CancelledError, CommClosedError) as error:
        raise OutOfResources(
            f"{failure}: found that the scheduler {address} does not answer any more, needed it to "
            "the end; start it and the same command again."
        ) from error


def _called(call: bytes) -> Any:
    """Call a function; its pickle keeps schedulers, which unpickle tasks, from importing it."""
    function, *arguments = pickle.loads(call)
    return function(*arguments)


def _version() -> str:
    return __version__


def _compare_versions(found: dict[str, object], failure: str) -> None:
    """Refuse workers without legcal, or with another version of it."""
    for worker, version in found.items():
        if version != __version__:
            raise UsageError(
                f"{failure}: found legcal {version} at the worker {worker}, needed {__version__} "
                "as here; install it where the workers run."
            )
