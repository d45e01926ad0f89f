"""One way to run work: in processes, by an executor that is handed in, on a Dask cluster."""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from itertools import count
from pathlib import Path
from shutil import copytree
from threading import Thread
from typing import Any

import pytest
from command_line import run as run_command
from hexapod_example import ROOT
from pool_work import OtherProcess, negative, row_zero_after_row_five
from simulated import files_of
from toy_studies import Draws

from legcal import workers
from legcal.errors import DatasetError, OutOfResources, UsageError
from legcal.progress import no_progress
from legcal.simulation.paper import run_study
from legcal.workers import Workers, worker_pool


@pytest.fixture(
    scope="module", params=["1", pytest.param("2", marks=pytest.mark.system), "threads"]
)
def several(request: pytest.FixtureRequest) -> Iterator[int | Executor]:
    if request.param != "threads":
        yield int(request.param)
        return
    with ThreadPoolExecutor(2) as executor:
        yield executor


def test_every_back_end_keeps_the_contract(several: Workers) -> None:
    taken = count()
    rows = (row for _, row in zip(taken, range(200), strict=False))
    with worker_pool(several, in_order=False) as run:
        first = next(iter(run(negative, rows)))
        assert first in range(-199, 1)
        assert next(taken) < 20  # rows are taken as workers get free
        assert sorted(run(negative, range(50))) == list(range(-49, 1))
        assert list(run(negative, [])) == []
    with worker_pool(several) as run:
        assert list(run(negative, range(99))) == [-row for row in range(99)]
        with pytest.raises(DatasetError, match="row 7"):
            list(run(partial(negative, refused=7), range(9)))


def test_an_executor_that_is_handed_in_gives_the_same_bits(tmp_path: Path) -> None:
    study, rows = Draws(seconds=0.002), range(6)
    with OtherProcess(2) as executor:
        found = run_study(study, 40, seed=3, workers=executor)
        with worker_pool(executor) as run:
            work = partial(row_zero_after_row_five, tmp_path / "done")
            (tmp_path / "done").touch()
            assert list(run(work, rows)) == list(rows)
    assert found == run_study(study, 40, seed=3)


def test_what_is_no_executor_is_refused() -> None:
    for given in (object(), 2.5):
        with pytest.raises(UsageError, match="needed a number of processes"), worker_pool(given):  # type: ignore[arg-type]
            pass


# On a cluster of this machine


class LocalCluster:
    """A scheduler and workers as processes of their own, in a folder of their own."""

    def __init__(self, folder: Path) -> None:
        pytest.importorskip("distributed")
        self.folder, self.workers = folder, list[subprocess.Popen[bytes]]()
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
        port = self.address.rpartition(":")[2]
        words = ["scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard", "--no-show"]
        self.scheduler = self._started(words, "")
        end = time.monotonic() + 30.0
        while time.monotonic() < end:
            with suppress(OSError), socket.create_connection(("127.0.0.1", int(port))):
                break
            time.sleep(0.05)

    def add(self, n: int = 1, path: str = "") -> None:
        """Start workers; what they import is looked for in a path before all others."""
        from distributed import Client

        words = ["worker", self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
        words += ["--death-timeout", "10", "--local-directory", str(self.folder)]
        self.workers += [self._started(words, path) for _ in range(n)]
        with Client(self.address, set_as_default=False) as client:  # type: ignore[no-untyped-call]
            client.wait_for_workers(len(self.workers), timeout=60)

    def stop(self) -> None:
        for process in [*self.workers, self.scheduler]:
            process.kill()
            process.wait()

    def _started(self, words: list[str], path: str) -> subprocess.Popen[bytes]:
        places = os.pathsep.join([path] * bool(path) + [str(ROOT), str(ROOT / "tests")])
        return subprocess.Popen(
            [sys.executable, "-m", "dask", *words], cwd=self.folder,
            env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": places},
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip


@contextmanager
def local_cluster(folder: Path, n_workers: int) -> Iterator[LocalCluster]:
    folder.mkdir()
    with ExitStack() as stack:
        found = LocalCluster(folder)
        stack.callback(found.stop)
        if n_workers:
            found.add(n_workers)
        yield found


@pytest.mark.system
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_calibration_on_a_cluster_is_that_of_this_process_byte_for_byte(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copytree(ROOT / "examples" / "hexapod", tmp_path / "data")
    table = tmp_path / "data" / "measurements.csv"
    head, *rows = table.read_text("utf-8").splitlines()
    table.write_text("\n".join([head, *rows[::5]]) + "\n", "utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1790000000")
    words = ("calibrate", "data", "--fresh", "--no-report")
    code = run_command(*words, "-o", "here", "--workers", "1").code
    with local_cluster(tmp_path / "cluster", 2) as local:
        there = (*words, "--cluster", local.address, "-o", "there")
        assert run_command(*there).code == code
    assert files_of(Path("there")) == files_of(Path("here"))
    assert "result.json" in files_of(Path("there"))


@pytest.mark.system
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_study_outlives_a_worker_and_says_that_the_scheduler_stopped(tmp_path: Path) -> None:
    study = Draws(seconds=0.05)
    with local_cluster(tmp_path / "cluster", 2) as local:

        def ended_at(n_runs: int, process: Any) -> Callable[[str, int, int], None]:
            return lambda stage, done, total: process.kill() if done == n_runs else None

        reports = ended_at(40, local.workers[0])
        found = run_study(study, 100, workers=local.address, progress=reports)
        assert found == run_study(Draws(), 100)
        reports, out = ended_at(20, local.scheduler), tmp_path / "out"
        with pytest.raises(OutOfResources, match="does not answer any more") as told:
            run_study(study, 400, workers=local.address, output=out, progress=reports)
        assert len(told.value.problems) == 1
        assert not out.exists()


@pytest.mark.system
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_worker_with_another_legcal_or_none_is_refused(tmp_path: Path) -> None:
    for name, version in (("other", '__version__ = "0.0.1"'), ("without", None)):
        copytree(ROOT / "legcal", tmp_path / name / "legcal")
        if version is None:
            (tmp_path / name / "legcal" / "workers.py").unlink()
        else:
            (tmp_path / name / "legcal" / "version.py").write_text(version)
    with local_cluster(tmp_path / "cluster", 1) as local:
        local.add(path=str(tmp_path / "other"))
        with pytest.raises(UsageError, match=r"found legcal 0\.0\.1 at the worker .*, needed"):
            run_study(Draws(), 3, workers=local.address)
    with local_cluster(tmp_path / "second", 0) as local:
        local.add(path=str(tmp_path / "without"))
        with pytest.raises(UsageError, match=r"No module named 'legcal.*install it where"):
            run_study(Draws(), 3, workers=local.address)


def _answer(page: socket.socket) -> None:
    """Answer one connection, if it comes, as a web server does that is asked something else."""
    page.settimeout(10.0)
    with suppress(TimeoutError), page.accept()[0] as connection:
        connection.recv(4096)
        connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\n\r\n")


@pytest.mark.system
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_no_answer_and_no_worker_are_said_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(workers, "CONNECTING", 1.0)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        begin = time.monotonic()
        with pytest.raises(OutOfResources, match=f"no Dask scheduler at {address}"):
            run_study(Draws(), 3, workers=address)
        assert time.monotonic() - begin < 10.0
    for scheme in ("tcp", "ws"):  # a page, such as that of the scheduler
        with socket.create_server(("127.0.0.1", 0)) as page:
            answering = Thread(target=_answer, args=(page,))
            answering.start()
            with pytest.raises(OutOfResources, match="not that of its page"):
                run_study(Draws(), 3, workers=f"{scheme}://127.0.0.1:{page.getsockname()[1]}")
            answering.join()
    for address in ("tcp://127.0.0.1:1", "tls://127.0.0.1:1"):  # nobody; without certificates
        with pytest.raises(OutOfResources, match=f"no Dask scheduler at {address}"):
            run_study(Draws(), 3, workers=address)
    for address in ("host", "tcp://host", "http://host:8787"):
        with pytest.raises(UsageError, match="like tcp://host:8786"):
            run_study(Draws(), 3, workers=address)
    # Clients that failed before do not keep another one from its scheduler.
    monkeypatch.setattr(workers, "CONNECTING", 5.0)
    monkeypatch.setattr(workers, "ALONE", 1.0)
    with local_cluster(tmp_path / "cluster", 0) as local:

        def kill(stage: str, done: int, total: int) -> None:
            local.workers[0].kill()

        for reports in (no_progress, kill):  # none from the beginning; none any more
            with pytest.raises(OutOfResources, match=r"found no worker at the scheduler .* start"):
                run_study(Draws(seconds=0.05), 400, workers=local.address, progress=reports)
            if not local.workers:
                local.add()
