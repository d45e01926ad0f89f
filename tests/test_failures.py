"""Failures from outside: signals, lost processes, full disks, values and names beyond reason."""

import errno
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest
from dataset_folder import folder
from pool_work import asleep_elsewhere, process_of, refused, row_zero_after_row_five

from legcal.errors import DatasetError, OutOfResources
from legcal.files.folder import result_folder, write_atomically
from legcal.signals import raise_if_stopped, stopped_by_signals
from legcal.workers import Run, worker_pool

__all__ = ["folder"]


POOL = """
import multiprocessing, os, time
from legcal.workers import worker_pool

if __name__ == "__main__":
    with worker_pool(3) as run:
        list(run(abs, range(8)))
        print(*[child.pid for child in multiprocessing.active_children()], flush=True)
        time.sleep(60.0)
"""


@pytest.mark.usefixtures("answered_signals")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_the_first_signal_interrupts_and_the_second_ends_the_process(name: str) -> None:
    number, ended = signal.Signals[name], []

    @stopped_by_signals()
    def work() -> None:
        try:
            signal.raise_signal(number)
        finally:
            assert signal.getsignal(number) is signal.SIG_DFL
            with pytest.raises(KeyboardInterrupt):
                raise_if_stopped()
            ended.append(True)

    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt):
        work()
    assert ended
    assert signal.getsignal(number) is before
    raise_if_stopped()


@pytest.mark.usefixtures("answered_signals")
def test_nothing_is_written_once_a_signal_was_heard(tmp_path: Path) -> None:
    def write_file() -> None:
        write_atomically(tmp_path / "file", b"new")

    def write_folder() -> None:
        with result_folder(tmp_path / "out") as new:
            (new / "result.json").write_text("{}")

    @stopped_by_signals()
    def work() -> None:
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        for write in (write_file, write_folder):
            with pytest.raises(KeyboardInterrupt):
                write()

    work()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("answered_signals")
@pytest.mark.parametrize("name", ["SIGINT", "SIGHUP"])
def test_a_signal_that_was_ignored_stays_so(name: str) -> None:
    number = signal.Signals[name]
    signal.signal(number, signal.SIG_IGN)
    with stopped_by_signals():
        signal.raise_signal(number)
    assert signal.getsignal(number) is signal.SIG_IGN


@pytest.mark.system
def test_processes_end_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    script = tmp_path / "pool.py"
    script.write_text(POOL)
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        workers = [int(pid) for pid in parent.stdout.readline().split()]
        parent.kill()
    assert len(workers) == 2
    deadline = time.monotonic() + 10.0
    while any(_runs(pid) for pid in workers) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(_runs(pid) for pid in workers)


def _runs(pid: int) -> bool:
    """Say whether a process is there and is no corpse that waits to be collected."""
    listed = subprocess.run(
        ["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True, check=False
    ).stdout.strip()
    return listed != "" and not listed.startswith("Z")


@pytest.fixture(scope="module")
def two_processes() -> Iterator[Run]:
    """A pool that was started where libraries may have three threads."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OMP_NUM_THREADS", "3")
        patch.delenv("OPENCV_FOR_THREADS_NUM", raising=False)
        with worker_pool(2) as run:
            list(run(abs, range(2)))
            assert (os.getenv("OMP_NUM_THREADS"), os.getenv("OPENCV_FOR_THREADS_NUM")) == (
                "3",
                None,
            )
            yield run


def test_libraries_have_one_thread_in_each_process_and_as_many_as_before_in_this_one(
    two_processes: Run,
) -> None:
    found = list(two_processes(os.getenv, ["OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"]))
    assert found == ["1", "1"]  # of the other process, which the first tasks go to
    assert (os.getenv("OMP_NUM_THREADS"), os.getenv("OPENCV_FOR_THREADS_NUM")) == ("3", None)


def test_results_come_as_they_are_finished_and_a_process_that_is_ended_is_said(
    two_processes: Run, tmp_path: Path
) -> None:
    taken = []

    def rows() -> Iterator[int]:
        for row in range(40):
            taken.append(row)
            yield row

    work = partial(row_zero_after_row_five, tmp_path / "done")
    ended = pytest.raises(OutOfResources, match="ended from outside")
    with ended, worker_pool(2, in_order=False) as run:
        found = iter(run(work, rows()))
        first = next(found)
        assert len(taken) == 4
        rest = list(found)
        list(run(os._exit, [1, 1]))
    assert first != 0
    assert sorted([first, *rest]) == taken == list(range(40))
    (tmp_path / "done").unlink()
    assert list(two_processes(work, range(6))) == list(range(6))


def test_this_process_works_too_and_the_first_refusal_is_that_of_the_first_row(
    two_processes: Run,
) -> None:
    numbers = set(two_processes(process_of, range(40)))
    assert os.getpid() in numbers
    assert len(numbers) == 2
    with pytest.raises(DatasetError, match="row 0 "):
        list(two_processes(partial(refused, os.getpid()), range(40)))


@pytest.mark.system
def test_processes_do_not_finish_work_that_is_not_wanted_any_more() -> None:
    def stop_after_the_first() -> None:
        with worker_pool(2) as run:
            for _ in run(partial(asleep_elsewhere, os.getpid()), [0, 300, 300, 300]):
                raise KeyboardInterrupt

    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        stop_after_the_first()
    assert time.monotonic() - start < 30.0


def test_a_result_on_a_full_disk_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    def write() -> None:
        with result_folder(tmp_path / "out") as new:
            (new / "result.json").write_text("{}")
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OutOfResources, match=r"No space.*nothing was written"):
        write()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "stdout"),
    [("", "> /dev/full"), pytest.param("--json", ">&-", marks=pytest.mark.system)],
)
def test_output_that_cannot_be_printed_is_said_on_stderr(words: str, stdout: str) -> None:
    if "/dev" in stdout and not Path("/dev/full").exists():
        pytest.skip("there is no device that is always full")
    command = f'"{sys.executable}" -m legcal inspect hexapod {words} {stdout}'
    done = subprocess.run(["sh", "-c", command], stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("legcal: The output could not be printed: found ")
    assert done.stderr.count("\n") == 1
