"""Work on a Dask cluster, or by another executor that a program hands in.

A task goes to the cluster once, its rows as workers get free, and results come back at once: a
worker that dies loses no more than it was working on, which another one does again. Files are read
where they lie. A worker that does not have one, or has another one there (size, time of change),
says so, and the row is sent again with the file. One row after the other is worked on in a process,
whatever its number of threads: libraries and caches are not made for more.
"""

from __future__ import annotations

import ctypes
import hashlib
import logging
import os
import pickle
import platform
import re
import time
import warnings
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import CancelledError, Future
from contextlib import closing, contextmanager, suppress
from functools import cache, partial
from importlib import metadata
from pathlib import Path
from threading import Event, RLock, Thread
from typing import Any, Protocol

from numpy.typing import NDArray

from legcal.errors import LegcalError, OutOfResources, UsageError
from legcal.processors import processors
from legcal.signals import held_back_signals
from legcal.version import __version__

CONNECTING = 10.0  # [s] in which a scheduler must answer and have a worker
_CHECKING = 1.0  # [s] between two looks at the workers
_NO_WORKER = 60.0  # [s] without any worker until work is given up: they may be started again
_ADDRESS = re.compile(r"((tcp|tls|ws|wss|ucx)://)?[^/]+:\d+/?|inproc://.+")
_NAMED = 5  # workers in a message
_MOST_KEPT = 128 * 2**20  # of arrays that a worker has made of files [bytes]
_WHEELS = ("numpy", "scipy", "opencv-python-headless", "casadi", "pin", "distributed")

Stamp = tuple[int, int]
Work = Callable[[Sequence[Any]], list[Any]]
"""Returns the results of some rows."""


class Submitter(Protocol):
    """A Dask client, or an executor as those of ``concurrent.futures``."""

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> Any:
        """Return the future of a call."""


class ClusterWarning(UserWarning):
    """Results may differ in their last digits from those of other workers."""


@contextmanager
def connected(given: str | Submitter, failure: str) -> Iterator[Cluster | GivenExecutor]:
    """Give the workers behind the address of a Dask scheduler, a Dask client or an executor.

    Raises
    ------
    UsageError
        If nothing can be used so, or if a worker has no legcal or another one.
    OutOfResources
        If the scheduler does not answer, or has no worker, within 10 s.
    """
    if not isinstance(given, str):
        if not (hasattr(given, "get_executor") and hasattr(given, "nthreads")):
            yield GivenExecutor(given)
            return
        with closing(Cluster(given, failure)) as cluster:
            yield cluster
        return
    client = _client(given, failure)
    try:
        with closing(Cluster(client, failure)) as cluster:
            yield cluster
    finally:
        with held_back_signals():
            client.close(timeout=2)


def _client(address: str, failure: str) -> Any:
    """Return a client of the scheduler at an address."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
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
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what it says is said here
    found, failed, too_late = list[Any](), list[Exception](), Event()

    def connect() -> None:
        try:
            found.append(Client(address, timeout=CONNECTING, set_as_default=False))  # type: ignore[no-untyped-call]
        except OSError:
            pass
        except (
            ValueError, TypeError, LookupError, RuntimeError, MemoryError, WebSocketError,
        ) as error:  # fmt: skip
            failed.append(error)
        if too_late.is_set():
            for client in found:
                client.close(timeout=2)

    # By a thread: the library waits for ever for a port that takes connections and does not answer.
    thread = Thread(target=connect, daemon=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of other versions of Dask, which are named later
        with held_back_signals():
            thread.start()
        thread.join(CONNECTING + 0.5)
    if not found:
        too_late.set()
        scheme = address.partition("://")[0] if "://" in address else "tcp"
        if failed and scheme != "tcp" and isinstance(failed[0], ValueError | TypeError):
            raise UsageError(
                f"{failure}: found that Dask cannot use {address} here ('{failed[0]}'), needed an "
                f"address that it can; set Dask up for {scheme}, or use tcp://host:8786."
            )
        if failed:
            raise OutOfResources(
                f"{failure}: found that {address} answers, but not as a Dask scheduler does, "
                "needed one; see that the port is its own (8786 unless it was started with "
                "another one), not that of its page (8787)."
            )
        raise OutOfResources(
            f"{failure}: found no Dask scheduler that answers at {address} within "
            f"{CONNECTING:.0f} s, needed one; see that it runs (dask scheduler) and that the "
            "address is right."
        )
    return found[0]


class GivenExecutor:
    """An executor that a program hands in, with futures as those of ``concurrent.futures``."""

    notes: tuple[str, ...] = ()
    patience = None
    most_rows = None

    def __init__(self, executor: Submitter) -> None:
        self._executor = executor
        self.slots: int = getattr(executor, "_max_workers", None) or processors()

    def submitter(self, work: Work) -> Callable[[Sequence[Any]], Future[list[Any]]]:
        """Return what hands rows out."""
        return lambda rows: self._executor.submit(_alone, work, rows)

    def check(self) -> None:
        """Trust the executor."""


class Cluster:
    """The workers of a Dask scheduler; notes say what differs between them and this process."""

    patience = _CHECKING
    most_rows = 25  # of a task: what a worker that dies loses

    def __init__(self, client: Any, failure: str) -> None:
        self._client = client
        self._executor = client.get_executor(pure=False)
        self._address = client.scheduler.address
        self._failure = failure
        self._files_of: dict[int, set[str]] = {}  # that rows asked for before
        self._named: dict[str, str] = {}
        self._here = environment()
        self._seen = time.monotonic()
        warnings.filterwarnings("ignore", "Sending large graph")
        self._wait_for_a_worker()
        found = client.run(environment, on_error="return")
        for worker, own in sorted(found.items()):
            self._compare(worker, own if isinstance(own, dict) else {"legcal": _in_words(own)})
        self._refuse_other_legcal()
        self._warned = 0
        self.check()

    def _wait_for_a_worker(self) -> None:
        begin = time.monotonic()
        while not (nthreads := self._client.nthreads()):
            if time.monotonic() - begin > CONNECTING:
                raise OutOfResources(
                    f"{self._failure}: found no worker at the scheduler {self._address}, needed "
                    f"one; start some (dask worker {self._address} --nthreads 1 --death-timeout "
                    "60) and the same command again."
                )
            time.sleep(0.2)
        self.slots = len(nthreads)

    @property
    def notes(self) -> tuple[str, ...]:
        """What differs between workers, as a note on results."""
        if not self._named:
            return ()
        lines = [f"{worker} ({what})" for worker, what in list(self._named.items())]
        more = f" and {len(lines) - _NAMED} more" if len(lines) > _NAMED else ""
        return (
            f"Some workers of the cluster differ from this process: {'; '.join(lines[:_NAMED])}"
            f"{more}; results are not those of equal workers bit by bit: they agree to about 1e-6 "
            "sigma where only CPU features differ, and it is not known how far for other versions.",
        )

    def submitter(self, work: Work) -> Callable[[Sequence[Any]], Future[list[Any]]]:
        """Return what hands rows out; the task itself goes to the cluster once."""
        import cloudpickle

        held = self._client.submit(_held, cloudpickle.dumps(work), pure=False)
        return lambda rows: _Part(self, held, rows).outer

    def close(self) -> None:
        """Leave what is not done undone."""
        self._executor.shutdown(wait=False)

    def check(self) -> None:
        """See that there are workers, and name those that differ."""
        if len(self._named) > self._warned:
            self._refuse_other_legcal()
            self._warned = len(self._named)
            warnings.warn(self.notes[0], ClusterWarning, stacklevel=2)
        if self._client.status != "running":
            raise self._lost()
        try:
            nthreads = self._client.nthreads()
        except (OSError, CancelledError) as error:
            raise self._lost() from error
        now = time.monotonic()
        if nthreads:
            self._seen = now
            self.slots = len(nthreads)
        elif now - self._seen > _NO_WORKER:
            raise OutOfResources(
                f"{self._failure}: found that the scheduler {self._address} has had no worker for "
                f"{_NO_WORKER:.0f} s, needed one; start some and the same command again."
            )

    def _compare(self, worker: str, found: dict[str, str]) -> None:
        """Remember what differs between a worker and this process."""
        here = self._here
        if worker in self._named or found == here:
            return
        self._named[worker] = ", ".join(
            f"{name} {found[name]} instead of {here[name]}"
            for name in here
            if name in found and found[name] != here[name]
        )

    def _refuse_other_legcal(self) -> None:
        others = {w: what for w, what in list(self._named.items()) if what.startswith("legcal ")}
        if others:
            worker, what = next(iter(others.items()))
            raise UsageError(
                f"{self._failure}: found {what.partition(', ')[0]} at the worker {worker}"
                f"{f' and {len(others) - 1} more' if len(others) > 1 else ''}, needed the same "
                "legcal everywhere; install it where the workers run."
            )

    def _lost(self) -> OutOfResources:
        return OutOfResources(
            f"{self._failure}: found that the scheduler {self._address} does not answer any more, "
            "needed it to the end; start it and the same command again."
        )

    def _reason(self, error: BaseException) -> BaseException:
        """Return the error of a task as it is raised here."""
        if isinstance(error, CancelledError):
            return self._lost()
        if type(error).__name__ == "KilledWorker":
            return OutOfResources(
                f"{self._failure}: found that several workers of {self._address} were ended from "
                "outside at the same piece of work, needed one that finishes it; see that they "
                "have enough memory and start the same command again."
            )
        if isinstance(error, ImportError | AttributeError):
            return UsageError(
                f"{self._failure}: found a worker of {self._address} that says {_in_words(error)}, "
                "needed the same installation everywhere; install it where the workers run."
            )
        return error


class _Part:
    """Some rows on a cluster, and the future of their results."""

    def __init__(self, cluster: Cluster, held: Any, rows: Sequence[Any]) -> None:
        self.outer: Future[list[Any]] = Future()
        self.outer.set_running_or_notify_cancel()
        self._cluster, self._held, self._rows = cluster, held, rows
        self._results: list[Any] = [None] * len(rows)
        self._again: deque[tuple[int, dict[str, bytes | None]]] = deque()
        known = set[str]()
        if len(rows) == 1 and isinstance(rows[0], int):
            known = cluster._files_of.get(rows[0], known)
        self._send(range(len(rows)), {path: _content(path) for path in known})

    def _send(self, places: Sequence[int], files: dict[str, bytes | None]) -> None:
        rows = pickle.dumps([self._rows[k] for k in places])
        future = self._cluster._executor.submit(_work, self._held, rows, files, os.getcwd())
        future.add_done_callback(partial(self._receive, places, files))

    def _receive(
        self, places: Sequence[int], files: dict[str, bytes | None], future: Future[Any]
    ) -> None:
        """Take results, and ask once more for rows whose files the worker did not have."""
        try:
            worker, own, content = future.result()
            self._cluster._compare(worker, own)
            for k, (value, error, read) in zip(places, pickle.loads(content), strict=True):
                lacking = {path for path, stamp in read.items() if stamp != stamp_of(path)}
                if not lacking and error is not None:
                    raise error
                if not lacking:
                    self._results[k] = value
                    continue
                self._cluster.most_rows = 1
                row = self._rows[k]
                if isinstance(row, int):
                    self._cluster._files_of.setdefault(row, set()).update(lacking)
                self._again.append((k, {**files, **dict.fromkeys(lacking)}))
            if self._again:  # one at a time: memory stays flat
                k, wanted = self._again.popleft()
                self._send([k], {path: files.get(path) or _content(path) for path in wanted})
            else:
                self.outer.set_result(self._results)
        except BaseException as error:
            self.outer.set_exception(self._cluster._reason(error))


def _content(path: str) -> bytes | None:
    try:
        return Path(path).read_bytes()
    except OSError:  # it is not here either: the worker says what is wrong with it
        return None


def stamp_of(path: str | Path) -> Stamp | None:
    """Return size and time of change [ns] of a file, None if it is not there."""
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_size, found.st_mtime_ns


def _in_words(error: object) -> str:
    return f"{type(error).__name__}: {error}"


# On workers

_lock = RLock()  # held while rows are worked on


class _Files:
    """The files of a row: what came with it, what was read here, what is not here."""

    current: _Files | None = None

    def __init__(self, sent: dict[str, bytes | None], folder: str) -> None:
        self.sent, self.folder = sent, folder
        self.read: dict[str, Stamp | None] = {}


class _FileNeeded(Exception):
    """A file is not here."""


def file_of_task(path: Path) -> bytes | None:
    """Return the content of a file of the process that a worker works for; None in all others."""
    files = _Files.current
    if files is None:
        return None
    name = str(path)
    if name in files.sent:
        return files.sent[name]
    here = os.path.join(files.folder, name)
    files.read[name] = stamp_of(here)
    content = _content(here)
    if content is None:
        files.read[name] = None
        raise _FileNeeded(name)
    return content


_kept = OrderedDict[tuple[str, Stamp, Hashable], NDArray[Any]]()  # by file; last used last


def made_of_file(path: Path, kind: Hashable, make: Callable[[], NDArray[Any]]) -> NDArray[Any]:
    """Return the array that is made of a file; on a worker once, until the file changes there.

    What was used last is kept. Other processes, and a worker that a file was sent to, make it anew.
    """
    files, name = _Files.current, str(path)
    if files is None or name in files.sent:
        return make()
    here = os.path.join(files.folder, name)
    stamp = stamp_of(here)
    if stamp is None:
        return make()
    key = (here, stamp, kind)
    if (values := _kept.get(key)) is not None:
        _kept.move_to_end(key)
        files.read[name] = stamp
        return values.copy()
    values = make()
    if files.read.get(name) == stamp:
        _kept[key] = values.copy()
        while sum(one.nbytes for one in _kept.values()) > _MOST_KEPT:
            _kept.popitem(last=False)
    return values


def _held(content: bytes) -> bytes:
    """Be a result that workers hand on to each other, and that is made again where it is lost."""
    return content


def _alone(work: Work, rows: Sequence[Any]) -> list[Any]:
    with _lock:
        return work(rows)


def _work(
    content: bytes, rows: bytes, files: dict[str, bytes | None], folder: str
) -> tuple[str, dict[str, str], bytes]:
    """Work on rows and say who did it; each gives a result or an error, and the files it read."""
    from distributed import get_worker

    _keep_freed_memory()
    found: list[tuple[Any, LegcalError | None, dict[str, Stamp | None]]] = []
    with _lock:
        work: Work = pickle.loads(content)  # anew, as what is drawn changes generators in it
        for row in pickle.loads(rows):
            own = _Files.current = _Files(files, folder)
            try:
                found.append((work([row])[0], None, own.read))
            except _FileNeeded:
                found.append((None, None, own.read))
            except LegcalError as error:  # for another file, perhaps
                found.append((None, error, own.read))
            finally:
                _Files.current = None
    return str(get_worker().address), environment(), pickle.dumps(found)


@cache
def _keep_freed_memory() -> None:
    """Have the C library keep what arrays leave free; Dask lets it give back all above 64 kB.

    What is given back is mapped page by page when the next array takes it: images took 1.4 times as
    long. Other C libraries than that of GNU are left as they are.
    """
    with suppress(AttributeError, OSError, TypeError):
        set_option = ctypes.CDLL(None).mallopt
        for option, most in ((_TRIM_THRESHOLD, 2**26), (_MMAP_THRESHOLD, 2**25)):
            set_option(option, most)


_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # as <malloc.h> numbers them


@cache
def environment() -> dict[str, str]:
    """Return what results may depend on beside their input, in words."""
    import cv2
    import numpy as np

    found = {"legcal": f"{__version__} ({_source()})", "Python": platform.python_version()}
    for name in _WHEELS:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "missing"
    simd = np.show_config(mode="dicts")["SIMD Extensions"]
    features = [*simd.get("baseline", ()), *simd.get("found", ())]
    found["CPU features"] = " ".join([platform.machine(), *features, cv2.getCPUFeaturesLine()])
    found["system"] = f"{platform.system()} {'-'.join(platform.libc_ver())}"
    return found


def _source() -> str:
    """Return a digest of the code: versions in development have the same number."""
    digest = hashlib.sha256()
    folder = Path(__file__).parent
    for path in sorted(folder.rglob("*.py")):
        digest.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:8]
