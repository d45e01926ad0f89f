"""One way to run work: in processes, by an executor that is handed in, on a Dask cluster."""

import json
import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from collections import OrderedDict
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from itertools import count
from pathlib import Path
from shutil import copytree
from threading import Thread
from typing import Any

import numpy as np
import pytest
from hexapod_example import ROOT
from numpy.typing import NDArray
from pool_work import negative, row_zero_after_row_five
from six_photographs import FOLDER
from toy_studies import Draws

from legcal import cluster, detect, load_dataset
from legcal.errors import DatasetError, OutOfResources, UsageError
from legcal.simulation.study import CHECKPOINT_NAME, run_study
from legcal.workers import Workers, worker_pool


@pytest.fixture(
    scope="module", params=["1", pytest.param("2", marks=pytest.mark.system), "threads"]
)
def workers(request: pytest.FixtureRequest) -> Iterator[int | Executor]:
    if request.param != "threads":
        yield int(request.param)
        return
    with ThreadPoolExecutor(2) as executor:
        yield executor


def test_every_back_end_keeps_the_contract(workers: Workers) -> None:
    taken = count()
    rows = (row for _, row in zip(taken, range(200), strict=False))
    with worker_pool(workers, in_order=False) as run:
        first = next(iter(run(negative, rows)))
        assert first in range(-199, 1)
        assert next(taken) < 20  # rows are taken as workers get free
        assert sorted(run(negative, range(50))) == list(range(-49, 1))
        assert list(run(negative, [])) == []
    with worker_pool(workers) as run:
        assert list(run(negative, range(99))) == [-row for row in range(99)]
        with pytest.raises(DatasetError, match="row 7"):
            list(run(partial(negative, refused=7), range(9)))
        assert run.notes == ()


def test_an_executor_that_is_handed_in_gives_the_same_bits(tmp_path: Path) -> None:
    study, rows = Draws(seconds=0.002), range(6)
    with ThreadPoolExecutor(2) as executor:
        found = run_study(study, 40, seed=3, workers=executor).document()
        with worker_pool(executor) as run:
            work = partial(row_zero_after_row_five, tmp_path / "done")
            (tmp_path / "done").touch()
            assert list(run(work, rows)) == list(rows)
    assert found == run_study(study, 40, seed=3).document()


class OtherProcess(ThreadPoolExecutor):
    """Calls that are pickled as for another process, which would take seconds to start."""

    def submit(self, function: Any, /, *arguments: Any, **named: Any) -> Any:
        there, *given = pickle.loads(pickle.dumps((function, *arguments)))
        return super().submit(there, *given, **named)


def test_an_executor_with_processes_of_its_own_reads_the_same_images() -> None:
    load = load_dataset(FOLDER).image_reader(range(6))
    with OtherProcess(2) as executor, worker_pool(executor) as run:
        assert all(map(np.array_equal, run(load, range(6)), map(load, range(6))))


def test_a_worker_makes_an_array_of_a_file_once_until_it_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = list[str]()

    def array(name: str) -> NDArray[np.float64]:
        def make() -> NDArray[np.float64]:
            made.append(name)
            content = cluster.file_of_task(Path(name)) or b""
            return np.array([len(content)] * 10, dtype=np.float64)

        return cluster.made_of_file(Path(name), 10, make)

    for name in "ab":
        (tmp_path / name).write_bytes(b"old")
    monkeypatch.setattr(cluster, "_MOST_KEPT", 100)
    monkeypatch.setattr(cluster, "_kept", OrderedDict())
    files = cluster._Files({"sent": b"with the task"}, str(tmp_path))
    monkeypatch.setattr(cluster._Files, "current", files)
    array("a")[:] = 0.0  # a copy
    files.read.clear()
    assert array("a")[0] == 3
    assert files.read == {"a": cluster.stamp_of(tmp_path / "a")}
    assert made == ["a"]
    (tmp_path / "a").write_bytes(b"newer")
    assert array("a")[0] == 5
    for name in ("b", "b", "a", "sent", "sent"):  # there is room for one
        array(name)
    assert "".join(made) == "aabasentsent"


def test_what_is_no_executor_is_refused() -> None:
    for workers in (object(), 2.5):
        with pytest.raises(UsageError, match="needed a number of processes"), worker_pool(workers):  # type: ignore[arg-type]
            pass


# On a cluster of this machine


class LocalCluster:
    """A scheduler and workers as processes of their own, over TCP."""

    def __init__(self, folder: Path) -> None:
        pytest.importorskip("distributed")
        self.folder, self.workers = folder, list[subprocess.Popen[bytes]]()
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
        port = self.address.rpartition(":")[2]
        words = ["scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard", "--no-show"]
        self.scheduler = self._started(words, {})
        end = time.monotonic() + 30.0
        while time.monotonic() < end:
            with suppress(OSError), socket.create_connection(("127.0.0.1", int(port))):
                break
            time.sleep(0.05)

    def add(self, n: int = 1, path: str = "") -> None:
        """Start workers; what they import is looked for in a path before all others."""
        words = ["worker", self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
        words += ["--death-timeout", "10", "--local-directory", str(self.folder)]
        own = [path] * bool(path) + [str(ROOT), str(ROOT / "tests")]
        path = os.pathsep.join(own)
        self.workers += [self._started(words, {"PYTHONPATH": path}) for _ in range(n)]

    def wait_for(self, n: int) -> None:
        from distributed import Client

        with Client(self.address, set_as_default=False) as client:  # type: ignore[no-untyped-call]
            client.wait_for_workers(n, timeout=30)

    def stop(self) -> None:
        for process in [*self.workers, self.scheduler]:
            process.kill()
            process.wait()

    def _started(self, words: list[str], more: dict[str, str]) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", "dask", *words], cwd=self.folder,
            env={**os.environ, "OMP_NUM_THREADS": "1", **more},
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip


@contextmanager
def local_cluster(folder: Path, n_workers: int) -> Iterator[LocalCluster]:
    folder.mkdir()
    with ExitStack() as stack:
        found = LocalCluster(folder)
        stack.callback(found.stop)
        found.add(n_workers)
        if n_workers:
            found.wait_for(n_workers)
        yield found


def _n_lines(folder: Path) -> int:
    path = folder / CHECKPOINT_NAME
    return path.read_bytes().count(b"\n") if path.exists() else 0


def _after(n_lines: int, folder: Path, *actions: Any) -> Thread:
    """Do something in a thread when a study has so many lines."""

    def watch() -> None:
        end = time.monotonic() + 60.0
        while _n_lines(folder) < n_lines and time.monotonic() < end:
            time.sleep(0.02)
        for action in actions:
            action()

    thread = Thread(target=watch)
    thread.start()
    return thread


@pytest.mark.system
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_study_outlives_workers_that_are_killed_and_keeps_its_runs_when_the_scheduler_stops(
    tmp_path: Path,
) -> None:
    study, out = Draws(seconds=0.05), tmp_path / "out"
    with local_cluster(tmp_path / "cluster", 3) as local:
        acting = _after(40, out, local.workers[0].kill, local.add)
        found = run_study(study, 100, workers=local.address, output=out)
        acting.join()
        assert found.document() == run_study(Draws(), 100).document()
        assert _n_lines(out) == 101
        stopping = _after(120, out, partial(local.scheduler.send_signal, signal.SIGKILL))
        with pytest.raises(OutOfResources, match="does not answer any more") as told:
            run_study(study, 400, workers=local.address, output=out)
        stopping.join()
        assert len(told.value.problems) == 1
    assert 120 <= _n_lines(out) < 401
    whole = run_study(Draws(), 400)
    assert run_study(Draws(), 400, output=out).document() == whole.document()


@pytest.mark.system
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_images_are_read_where_they_lie_or_sent_and_what_is_found_is_the_same_bit_by_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = tmp_path / "own" / "data"
    data.parent.mkdir()
    copytree(FOLDER, data)
    here = detect(data).outlines
    with local_cluster(tmp_path / "cluster", 2) as local:
        load = load_dataset(data).image_reader(range(6))
        with worker_pool(local.address) as run:
            assert all(map(np.array_equal, run(load, range(6)), map(load, range(6))))
            assert run.notes == ()
            path, other = (Path(str(load.paths[k])) for k in (0, 1))
            before = path.read_bytes()
            path.write_bytes(other.read_bytes())
            for found in run(load, [0] * 4):  # workers have kept what was there
                assert np.array_equal(found, load(1))
            path.write_bytes(before)
        # A path that is another folder in every process: workers lack some files, others differ.
        images = sorted(path.relative_to(data) for path in data.rglob("*.jpg"))
        for k, image in enumerate(images[::2]):
            (local.folder / "data" / image).parent.mkdir(parents=True, exist_ok=True)
            (local.folder / "data" / image).write_bytes(b"no image at all" * (k + 1))
        monkeypatch.chdir(data.parent)
        sent = detect(Path("/proc/self/cwd/data"), workers=local.address).outlines
    assert len(images) == 6
    for name in ("row", "leg", "h", "ends", "covariance"):
        assert getattr(sent, name).tobytes() == getattr(here, name).tobytes()


@pytest.mark.system
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_workers_that_differ_are_named_and_those_without_this_legcal_refused(
    tmp_path: Path,
) -> None:
    other = tmp_path / "other" / "casadi-3.1.0.dist-info"
    other.mkdir(parents=True)
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: casadi\nVersion: 3.1.0\n")
    without = tmp_path / "without" / "legcal"
    without.mkdir(parents=True)
    (without / "__init__.py").write_text("")
    with local_cluster(tmp_path / "cluster", 1) as local:
        local.add(path=str(other.parent))
        local.wait_for(2)
        with pytest.warns(cluster.ClusterWarning, match=r"casadi 3\.1\.0 instead of"):
            found = run_study(Draws(), 30, workers=local.address)
        assert "it is not known how far for other versions" in found.document()["notes"][0]
        local.add(path=str(without.parent))
        local.wait_for(3)
        with pytest.raises(UsageError, match=r"No module named 'legcal.*needed the same legcal"):
            run_study(Draws(), 3, workers=local.address)


def _answer(page: socket.socket) -> None:
    """Answer one connection as a web server does that is asked something else."""
    with page.accept()[0] as connection:
        connection.recv(4096)
        connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\n\r\n")


@pytest.mark.system
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_no_answer_and_no_worker_are_said_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(cluster, "CONNECTING", 1.0)
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        begin = time.monotonic()
        with pytest.raises(OutOfResources, match=f"no Dask scheduler that answers at {address}"):
            run_study(Draws(), 3, workers=address)
        assert time.monotonic() - begin < 10.0
    for address in ("host", "tcp://host", "http://host:8787"):
        with pytest.raises(UsageError, match="like tcp://host:8786"):
            run_study(Draws(), 3, workers=address)
    for address in ("tls://127.0.0.1:1", "inproc://here"):  # certificates, another process
        with pytest.raises(UsageError, match="Dask cannot use"):
            run_study(Draws(), 3, workers=address)
    monkeypatch.setattr(cluster, "CONNECTING", 2.0)
    with (
        local_cluster(tmp_path / "cluster", 0) as local,
        pytest.raises(OutOfResources, match="found no worker at the scheduler"),
    ):
        run_study(Draws(), 3, workers=local.address, output=tmp_path / "out")
    assert json.loads((tmp_path / "out" / CHECKPOINT_NAME).read_text())["seed"] == 0
    assert np.isfinite(run_study(Draws(), 3, output=tmp_path / "out").document()["total"])
    for scheme in ("tcp", "ws"):  # a page, such as that of the scheduler
        with socket.create_server(("127.0.0.1", 0)) as page:
            answering = Thread(target=_answer, args=(page,))
            answering.start()
            with pytest.raises(OutOfResources, match="not as a Dask scheduler does"):
                run_study(Draws(), 3, workers=f"{scheme}://127.0.0.1:{page.getsockname()[1]}")
            answering.join()
