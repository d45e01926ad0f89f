"""Commands that are stopped at any moment leave a whole result or none, and can go on."""

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from kills import (
    COMMANDS,
    SIGNALS,
    STOPPED,
    WITH_SIGNALS,
    answers,
    drawn_kills,
    faults_of,
    remove_finished,
)

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/environ").exists(), reason="looks at processes in /proc"
)


def _started(folder: Path) -> subprocess.Popen[str]:
    """Start a command that takes minutes; return when it has its handlers: first of all."""
    process = subprocess.Popen(
        [sys.executable, "-c", WITH_SIGNALS, "study", "paper", "-o", str(folder)],
        stderr=subprocess.PIPE,
        text=True,
    )
    end = time.monotonic() + 60.0
    while not answers(process.pid):
        assert process.poll() is None
        assert time.monotonic() < end
    return process


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_answered_while_libraries_are_loaded(
    number: signal.Signals, tmp_path: Path
) -> None:
    process = _started(tmp_path / "out")
    process.send_signal(number)
    _, said = process.communicate(timeout=60.0)
    assert (process.returncode, said) == (130, f"{STOPPED}\n")
    assert not (tmp_path / "out").exists()


def test_a_second_signal_ends_the_process(tmp_path: Path) -> None:
    process = _started(tmp_path / "out")
    process.send_signal(signal.SIGINT)
    while process.poll() is None and answers(process.pid):
        time.sleep(0.001)
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=60.0)
    assert process.returncode in (130, -signal.SIGTERM)
    assert said in ("", f"{STOPPED}\n")


def test_nothing_that_takes_time_is_loaded_before_signals_are_answered() -> None:
    script = "import sys; import legcal.cli; sys.exit(len({'typer', 'numpy'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0


@pytest.fixture
def _removed() -> Iterator[None]:
    yield
    remove_finished()


@pytest.mark.system
@pytest.mark.usefixtures("_removed")
def test_a_kill_by_each_signal_leaves_no_half_result() -> None:
    """A calibration of photographs is a detection and a fit to outlines, which are among these."""
    chosen = ("calibrate outlines", "simulate outlines", "study", "detect, two processes")
    kills = drawn_kills(4, 1, [command for command in COMMANDS if command.name in chosen])
    assert {kill.number for kill in kills} == set(SIGNALS)
    assert [f"{kill}: {fault}" for kill in kills for fault in faults_of(kill)] == []
