"""Stopping: by any signal, once, and with all processes."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from legcal.errors import OutOfResources
from legcal.signals import stopped_by_signals
from legcal.workers import worker_pool

POOL = """
import multiprocessing, os, time
from legcal.workers import worker_pool

if __name__ == "__main__":
    with worker_pool(2) as run:
        list(run(abs, range(8)))
        print(*[child.pid for child in multiprocessing.active_children()], flush=True)
        time.sleep(60.0)
"""


@contextmanager
def handled(number: signal.Signals, by: signal.Handlers) -> Iterator[None]:
    """Handle a signal in one way for a while, whatever the tests were started under."""
    before = signal.signal(number, by)
    try:
        yield
    finally:
        signal.signal(number, before)


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_any_signal_stops_once_and_lets_the_clean_up_end(name: str) -> None:
    number, ended = signal.Signals[name], []

    @stopped_by_signals()
    def work() -> None:
        try:
            signal.raise_signal(number)
        finally:
            signal.raise_signal(number)
            ended.append(True)

    with handled(number, signal.SIG_DFL):
        with pytest.raises(KeyboardInterrupt):
            work()
        assert ended
        assert signal.getsignal(number) is signal.SIG_DFL


@pytest.mark.parametrize("name", ["SIGINT", "SIGHUP"])
def test_a_signal_that_was_ignored_stays_so(name: str) -> None:
    number = signal.Signals[name]
    with handled(number, signal.SIG_IGN):
        with stopped_by_signals():
            signal.raise_signal(number)
        assert signal.getsignal(number) is signal.SIG_IGN


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


def test_a_process_that_is_ended_from_outside_is_said_in_one_sentence() -> None:
    with pytest.raises(OutOfResources, match="ended from outside"), worker_pool(2) as run:
        list(run(os._exit, [1, 1]))


def test_processes_do_not_finish_work_that_is_not_wanted_any_more() -> None:
    def stop_after_the_first() -> None:
        with worker_pool(2) as run:
            for _ in run(time.sleep, [0, 300, 300, 300]):
                raise KeyboardInterrupt

    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        stop_after_the_first()
    assert time.monotonic() - start < 30.0
