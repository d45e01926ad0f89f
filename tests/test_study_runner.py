"""The Monte Carlo runner: the same results however it is run, and nothing lost."""

import json
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from toy_studies import Deadly, Draws, Mistaken

from legcal.errors import DidNotConverge, OutOfResources, UsageError
from legcal.simulation.study import CHECKPOINT_NAME, DOCUMENT_NAME, run_study

PROGRAM = Path(__file__).with_name("toy_studies.py")


def _lines(folder: Path) -> list[bytes]:
    path = folder / CHECKPOINT_NAME
    return path.read_bytes().splitlines(keepends=True) if path.exists() else []


def test_more_runs_are_added_to_those_that_are_there_and_missing_ones_made_up_for(
    tmp_path: Path,
) -> None:
    few = run_study(Draws(), 10, output=tmp_path).document()
    begun, progress = _lines(tmp_path), list[tuple[str, int, int]]()
    more = run_study(Draws(), 25, output=tmp_path, progress=lambda *now: progress.append(now))
    assert (progress[0], progress[-1]) == (("Study draws", 10, 25), ("Study draws", 25, 25))
    assert [done for _, done, _ in progress] == sorted(done for _, done, _ in progress)
    assert _lines(tmp_path)[: len(begun)] == begun
    assert more.document() == run_study(Draws(), 25).document()
    assert run_study(Draws(), 10, output=tmp_path).document() == few
    assert json.loads((tmp_path / DOCUMENT_NAME).read_bytes()) == few
    assert (tmp_path / "total.txt").read_text() == str(few["total"])
    (tmp_path / CHECKPOINT_NAME).write_bytes(b"".join([*begun[:4], *begun[6:]]))
    assert run_study(Draws(), 10, output=tmp_path).document() == few
    assert sorted(_lines(tmp_path)) == sorted(begun)


def test_a_study_of_failures_only_says_why() -> None:
    with pytest.raises(DidNotConverge, match=r"all of its 5 runs failed.*The draw is"):
        run_study(Draws(fails_above=-np.inf), 5)


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.system)])
def test_a_mistake_in_a_study_is_no_failed_run(workers: int) -> None:
    with pytest.raises(ZeroDivisionError):
        run_study(Mistaken(), 4, workers=workers)


@pytest.mark.system
def test_a_process_that_is_ended_from_outside_is_told_and_what_was_done_is_kept(
    tmp_path: Path,
) -> None:
    run_study(Draws(), 5, output=tmp_path)
    before = _lines(tmp_path)
    with pytest.raises(OutOfResources, match="one of the processes was ended from outside"):
        run_study(Deadly(), 20, workers=2, output=tmp_path)
    assert _lines(tmp_path) == before


@contextmanager
def _files_no_larger_than(size: int) -> Iterator[None]:
    """Let writing fail beyond a size, in the middle of a line, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("size", [40, 700])
def test_a_full_disk_is_told_and_the_study_goes_on_when_there_is_room(
    tmp_path: Path, size: int
) -> None:
    with (
        _files_no_larger_than(size),
        pytest.raises(OutOfResources, match=r"could not be kept.*goes on from the runs"),
    ):
        run_study(Draws(), 100, output=tmp_path)
    assert (tmp_path / CHECKPOINT_NAME).stat().st_size == size
    assert run_study(Draws(), 100, output=tmp_path).document() == run_study(Draws(), 100).document()


def test_figures_that_cannot_be_written_are_told_and_no_run_is_lost(tmp_path: Path) -> None:
    run_study(Draws(), 1, output=tmp_path)
    (tmp_path / "total.txt").unlink()
    (tmp_path / "total.txt").mkdir()
    (tmp_path / "total.txt" / "mine").touch()
    with pytest.raises(UsageError, match=r"result of the study.*total.txt, which is a folder"):
        run_study(Draws(), 3, output=tmp_path)
    assert len(_lines(tmp_path)) == 4


@pytest.mark.parametrize(
    ("kept", "rest"),
    [
        (12, b'{"run":11,"rec'),
        (12, b'{"run":11,"record":{"x":1.0}}'),
        (12, b"\0\0\0\0\n"),
        (0, b""),
        (0, b'{"legcal_study":'),  # half of the first line
    ],
)
def test_a_half_written_last_line_is_done_again(tmp_path: Path, kept: int, rest: bytes) -> None:
    run_study(Draws(), 11, output=tmp_path / "whole")
    lines = _lines(tmp_path / "whole")
    assert len(lines) == 12
    assert kept or lines[0].startswith(rest)
    folder = tmp_path / "damaged"
    folder.mkdir()
    (folder / CHECKPOINT_NAME).write_bytes(b"".join([*lines[:kept], rest]))
    assert run_study(Draws(), 20, output=folder).document() == run_study(Draws(), 20).document()
    assert len(_lines(folder)) == 21


@pytest.mark.parametrize(
    "damaged",
    [
        b'{"run":1,\n',
        b"[" * 100_000 + b"\n",
        b"[1]\n",
        b'{"run":1}\n',
        b'{"record":{"x":1.0}}\n',
        b'{"run":-1,"record":{"x":1.0}}\n',
        b'{"run":true,"record":{"x":1.0}}\n',
        b'{"run":1,"record":null}\n',
        b'{"run":1,"failure":"x"}\n',
    ],
    ids=range(9),
)
def test_a_damaged_line_is_refused(tmp_path: Path, damaged: bytes) -> None:
    run_study(Draws(), 5, output=tmp_path)
    before = _lines(tmp_path)
    # As the last line, half of one may be what a killed run left.
    lines = [*before[:2], damaged, *before[3 : 3 + (not damaged.endswith(b"}\n"))]]
    (tmp_path / CHECKPOINT_NAME).write_bytes(b"".join(lines))
    with pytest.raises(UsageError, match="found line 3 damaged"):
        run_study(Draws(), 5, output=tmp_path)
    assert _lines(tmp_path) == lines


NO_CHECKPOINT, DEEP = "no checkpoint of legcal", "[" * 100_000 + "\n"
LONG = "long" * 100


@pytest.mark.parametrize(
    ("there", "output", "message"),
    [
        ({"notes.txt": "mine"}, "", "a folder with other files"),
        ({CHECKPOINT_NAME: "", DOCUMENT_NAME: "mine"}, "", "a folder with other files"),
        ({"notes.txt": "mine"}, "notes.txt", "a file of that name"),
        ({"notes.txt": "mine"}, "notes.txt/below", "needed a path that can be created"),
        ({}, LONG, "needed a path that can be created"),
        ({CHECKPOINT_NAME: "mine\n", "notes.txt": "mine"}, "", NO_CHECKPOINT),
        ({CHECKPOINT_NAME: "mine"}, "", NO_CHECKPOINT),
        ({CHECKPOINT_NAME: DEEP}, "", NO_CHECKPOINT),
    ],
    ids=range(8),
)
def test_a_folder_or_a_file_of_somebody_else_is_refused_and_kept(
    tmp_path: Path, there: dict[str, str], output: str, message: str
) -> None:
    for name, text in there.items():
        (tmp_path / name).write_text(text)
    with pytest.raises(UsageError, match=message):
        run_study(Draws(), 3, output=tmp_path / output)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == there


@pytest.mark.parametrize(
    ("study", "seed", "message"),
    [
        (Draws("others"), 0, "study 'draws' instead of 'others'"),
        (
            Draws(scale=2.0, fails_above=1.0),
            0,
            r"scale 1\.0 instead of 2\.0; fails ",
        ),
        (Draws(), 1, r"another command \(seed 0 instead of 1\)"),
    ],
)
def test_a_checkpoint_of_another_study_is_refused_and_kept(
    tmp_path: Path, study: Draws, seed: int, message: str
) -> None:
    run_study(Draws(), 5, output=tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(UsageError, match=message):
        run_study(study, 5, seed=seed, output=tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_numbers_that_make_no_sense_are_refused() -> None:
    for n_runs, seed, workers, message in (
        (0, 0, 1, "runs = 0, needed 1 or more"),
        (10**9, 0, 1, "runs = 1000000000, needed 1000000 at most"),
        (1, -1, 1, "seed = -1, needed 0 or more"),
        (1, 0, 0, "workers = 0, needed 1 or more"),
    ):
        with pytest.raises(UsageError, match=message):
            run_study(Draws(), n_runs, seed=seed, workers=workers)
    run_study(Draws(), 1, workers=10**11)  # more than are of use are not started


@contextmanager
def _running(folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Give a process that runs a study of 400 runs, some of which are done."""
    process = subprocess.Popen(
        [sys.executable, str(PROGRAM), str(folder)], stderr=subprocess.PIPE, start_new_session=True
    )
    try:
        end = time.monotonic() + 60.0
        while len(_lines(folder)) < 20:
            assert process.poll() is None
            assert time.monotonic() < end
            time.sleep(0.02)
        yield process
    finally:
        process.kill()
        process.wait()
        assert process.stderr is not None
        process.stderr.close()


def _processes_of(group: int) -> list[str]:
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:  # it ended meanwhile
            continue
        if int(fields[2]) == group and fields[0] != "Z":
            found.append(stat.parent.name)
    return found


@pytest.mark.system
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks at processes in /proc")
def test_a_killed_study_leaves_no_process_and_is_continued(tmp_path: Path) -> None:
    with _running(tmp_path) as process:
        process.send_signal(signal.SIGKILL)
        process.wait()
        end = time.monotonic() + 10.0
        while _processes_of(process.pid):
            assert time.monotonic() < end
            time.sleep(0.1)
        assert process.stderr is not None
        assert process.stderr.read() == b""
    n_done = len(_lines(tmp_path))
    assert 20 <= n_done < 401
    assert run_study(Draws(), 400, output=tmp_path).document() == run_study(Draws(), 400).document()
