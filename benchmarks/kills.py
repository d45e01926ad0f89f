"""Commands stopped at drawn moments: what is lost, left behind or falsified.

    python benchmarks/kills.py [--kills 500] [--seed 0]

SIGINT, SIGTERM and SIGKILL at moments drawn between start and end of calibrate, detect, simulate
and study, with and without a result that stands already, with one process and two, to the first
of them or to all. After each the output is that of the whole command, or what was there before, or
nothing; no process is left; and the same command again gives what an undisturbed one gives, byte
for byte. Printed is every fault.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
MAX_STOP = 20.0  # [s] on a busy machine, from the signal to the end
LINGER = 10.0  # [s] that a process of a pool may take to end after the command
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
TIME_OF_PAGES = "1790000000"  # for SOURCE_DATE_EPOCH: all that differs between pages otherwise
STOPPED = "legcal: Stopped before the end."
FALSE_WORDS = ("Traceback", "ended from outside", "mistake in legcal")
MARK = "LEGCAL_KILL"  # in the environment of the command and of all that it starts

# Tests may run with Ctrl-C ignored, which programs that they start inherit.
WITH_SIGNALS = (
    "import os, signal, sys; "
    "[signal.signal(n, signal.SIG_DFL) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]; "
    "os.execv(sys.executable, [sys.executable, '-m', 'legcal', *sys.argv[1:]])"
)

Contents = dict[str, str]
"""The digest of every file of a folder, by its path."""


@dataclass(frozen=True)
class Command:
    """A command to stop: its words, what it starts from, and what it leaves."""

    name: str
    words: str
    input: str = ""  # the words that make the folder "in", or a folder to copy
    kept: tuple[str, ...] = ()  # files of checkpoints and caches, which may be there in part
    replaces: bool = True  # takes the place of a result that stands already
    guarded: tuple[str, ...] = ()  # files that are not written over if somebody changed them


OUTLINES = "simulate 3-rpr -o in --level outlines --poses 8 --seed 3"
PHOTOGRAPHS = "tests/data/six-photographs"
COMMANDS = (
    Command("calibrate outlines", "calibrate in -o out", OUTLINES),
    Command(
        "simulate outlines",
        "simulate 3-rpr -o out --level outlines --poses 2",
        replaces=False,
    ),
    Command("study", "study paper --runs 2 --workers 1 -o out"),
    Command(
        "detect",
        "detect in -o out --workers 1",
        PHOTOGRAPHS,
        guarded=("out/observations.csv",),
    ),
    Command(
        "calibrate photographs, two processes",
        "calibrate in -o out",
        PHOTOGRAPHS,
        kept=("in/observations.csv", "in/.legcal-cache.json"),
    ),
    Command(
        "detect, two processes",
        "detect in -o out --workers 2",
        PHOTOGRAPHS,
        guarded=("out/observations.csv",),
    ),
    Command(
        "simulate photographs, two processes",
        "simulate 3-rpr -o out --poses 1",
        replaces=False,
    ),
    Command("study, two processes", "study paper --runs 4 --workers 2 -o out"),
)


@dataclass(frozen=True)
class Kill:
    """A signal at a part of the time that a command takes."""

    command: Command
    number: signal.Signals
    part: float
    to_all: bool  # to all processes of the command, as from a terminal, or to the first
    existing: bool  # a result of the same command stands already

    def __str__(self) -> str:
        """In words."""
        receiver = "all of " if self.to_all else ""
        before = ", over a result" if self.existing else ""
        return f"{self.number.name} at {self.part:.2f} to {receiver}'{self.command.name}'{before}"


def drawn_kills(count: int, seed: int, commands: Sequence[Command] = COMMANDS) -> list[Kill]:
    """Return that many kills, of all commands and signals in turn."""
    chance = np.random.default_rng(seed)
    return [
        Kill(
            commands[k % len(commands)],
            SIGNALS[(k // len(commands) + k % len(commands)) % len(SIGNALS)],
            float(chance.uniform(0.0, 1.05)),
            bool(chance.integers(2)),
            bool(chance.integers(2)) and commands[k % len(commands)].replaces,
        )
        for k in range(count)
    ]


def faults_of(kill: Kill) -> Iterator[str]:
    """Stop a command, let it go on, and yield what is wrong."""
    command = kill.command
    duration, finished, results, whole = _undisturbed(command)
    with tempfile.TemporaryDirectory(prefix="legcal-kill-") as top:
        folder, mark = Path(top), uuid.uuid4().hex
        _prepare(command, folder)
        if kill.existing:
            _lay_older_result(command, finished, folder)
        before = _contents(folder)
        process = _start(command, folder, mark)
        time.sleep(kill.part * duration)
        answered = answers(process.pid)
        with suppress(ProcessLookupError):
            (os.killpg if kill.to_all else os.kill)(process.pid, kill.number)
        try:
            code = process.wait(MAX_STOP)
        except subprocess.TimeoutExpired:
            yield f"runs on {MAX_STOP:g} s after the signal"
            process.kill()
            code = process.wait()
        left = _lingering(mark)
        if left:
            yield f"{left} processes are left"
        now = _contents(folder)
        yield from _faults_of_output(command, before, results, now, code == whole)
        if kill.number is signal.SIGKILL:
            allowed = {whole, -9}
        elif _is_one_of(now, results, command):  # Python was about to end
            allowed = {whole, 130, -kill.number}
        else:  # before the handlers stood, Python ended itself, in its own words
            allowed = {130} if answered else {code}
        if code not in allowed:
            yield f"exit code {code}: {_said(folder)}"
        elif code == 130 and not _said(folder).endswith(STOPPED):
            yield f"said {_said(folder)}"
        if kill.number is not signal.SIGKILL and answered:
            yield from (f"said {word}" for word in FALSE_WORDS if word in _said(folder))
        is_refused = bool(_result(now, command)) and not command.replaces
        if now == before or code == whole or is_refused:
            return  # nothing to go on from
        if _start(command, folder, mark).wait() != whole:
            yield f"cannot be run again: {_said(folder)}"
        elif not _is_one_of(_contents(folder), results, command):
            yield "another result when run again"


def _faults_of_output(
    command: Command, before: Contents, results: Sequence[Contents], now: Contents, ended: bool
) -> Iterator[str]:
    """Yield what is neither as before nor as in a whole result."""
    if ended and not _is_one_of(now, results, command):
        yield "ended, and the result is not complete"
    elif not _is_one_of(now, [before, *results], command):
        yield f"half a result: {sorted(_result(now, command))}"
    changed = {name for name in before if name.startswith("in/") and name not in command.kept}
    if any(now.get(name) != before[name] for name in changed):
        yield "another input"


def _is_one_of(found: Contents, results: Sequence[Contents], command: Command) -> bool:
    return _result(found, command) in [_result(each, command) for each in results]


def _result(contents: Contents, command: Command) -> Contents:
    """Return what a command writes, apart from checkpoints and caches."""
    return {
        name: digest
        for name, digest in contents.items()
        if name.startswith("out/") and name not in command.kept
    }


_finished: list[Path] = []


@cache
def _undisturbed(command: Command) -> tuple[float, Path, list[Contents], int]:
    """Return how long a command takes, where its result is, all it may have, and its exit code.

    With a cache it has two results: tables hold rounded numbers. The code is 1 where the verdict on
    a result is that it should not be used.
    """
    folder = Path(tempfile.mkdtemp(prefix="legcal-whole-"))
    _finished.append(folder)
    _prepare(command, folder)
    begin = time.perf_counter()
    code = _start(command, folder, "first").wait()
    assert code in (0, 1), _said(folder)
    duration = time.perf_counter() - begin
    results = [_contents(folder)]
    if any(name.startswith("in/") for name in command.kept):
        assert _start(command, folder, "first").wait() == code, _said(folder)
        results.append(_contents(folder))
    return duration, folder, results, code


def remove_finished() -> None:
    """Delete inputs and undisturbed results."""
    while _finished:
        shutil.rmtree(_finished.pop(), ignore_errors=True)
    _undisturbed.cache_clear()
    _made.cache_clear()


def _prepare(command: Command, folder: Path) -> None:
    if command.input:
        shutil.copytree(_made(command.input), folder / "in")


@cache
def _made(source: str) -> Path:
    """Return the folder of an input."""
    if (ROOT / source).is_dir():
        return ROOT / source
    folder = Path(tempfile.mkdtemp(prefix="legcal-input-"))
    _finished.append(folder)
    subprocess.run([sys.executable, "-m", "legcal", *source.split(), "--quiet"], cwd=folder,
                   env={**os.environ, "PYTHONPATH": str(ROOT)}, check=True)  # fmt: skip
    return folder / "in"


def _lay_older_result(command: Command, finished: Path, folder: Path) -> None:
    """Put a result where the command writes, with every file changed that may be."""
    shutil.copytree(finished / "out", folder / "out")
    same = {folder / name for name in (*command.kept, *command.guarded)}
    for path in (folder / "out").rglob("*"):
        if path.is_file() and path not in same:
            with path.open("ab") as file:
                file.write(b"\n")


def _start(command: Command, folder: Path, mark: str) -> subprocess.Popen[bytes]:
    environment = dict(
        os.environ,
        OMP_NUM_THREADS="1",
        PYTHONPATH=str(ROOT),
        SOURCE_DATE_EPOCH=TIME_OF_PAGES,
        **{MARK: mark},
    )
    with (folder / "said.txt").open("wb") as said:
        return subprocess.Popen(
            [sys.executable, "-c", WITH_SIGNALS, *command.words.split()],
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=said,
            start_new_session=True,
        )


def answers(process: int) -> bool:
    """Say whether a command has its handlers: Python has one for SIGINT alone before."""
    try:
        status = Path(f"/proc/{process}/status").read_text()
    except OSError:
        return False
    caught = next((line for line in status.splitlines() if line.startswith("SigCgt:")), "0 0")
    return bool(int(caught.split()[1], 16) >> (signal.SIGTERM - 1) & 1)


def _said(folder: Path) -> str:
    """Return what a command printed; progress comes first."""
    text = (folder / "said.txt").read_text(errors="replace").strip()
    return text or "nothing"


def _lingering(mark: str) -> int:
    """Return how many processes with a mark are there after a while, and end them."""
    end = time.perf_counter() + LINGER
    while True:
        count = len(_marked(mark))
        if count == 0 or time.perf_counter() > end:
            for process in _marked(mark):
                with suppress(ProcessLookupError):
                    os.kill(process, signal.SIGKILL)
            return count
        time.sleep(0.05)


def _marked(mark: str) -> list[int]:
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                if f"{MARK}={mark}".encode() in (entry / "environ").read_bytes():
                    found.append(int(entry.name))
            except OSError:
                continue
    return found


def _contents(folder: Path) -> Contents:
    return {
        str(path.relative_to(folder)): sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "said.txt"
    }


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    begin, faulty, signals = time.perf_counter(), 0, Counter[str]()
    try:
        for done, kill in enumerate(drawn_kills(asked.kills, asked.seed), 1):
            faults = list(faults_of(kill))
            faulty += bool(faults)
            signals[kill.number.name] += 1
            for fault in faults:
                print(f"{kill}: {fault}", flush=True)
            if done % 10 == 0:
                print(f"{done} kills, {faulty} with faults", file=sys.stderr, flush=True)
    finally:
        remove_finished()
    counts = ", ".join(f"{count} {name}" for name, count in sorted(signals.items()))
    print(
        f"{asked.kills} kills ({counts}) in {time.perf_counter() - begin:.0f} s, "
        f"{faulty} with faults"
    )


if __name__ == "__main__":
    main()
