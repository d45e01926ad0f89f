"""The Monte Carlo runner: the same results however it is run, written complete or not at all."""

import json
from pathlib import Path

import numpy as np
import pytest
from toy_studies import Deadly, Draws, Mistaken

from legcal.errors import DidNotConverge, OutOfResources, UsageError
from legcal.simulation.paper import DOCUMENT_NAME, run_study


def test_runs_do_not_depend_on_their_number_and_are_counted(tmp_path: Path) -> None:
    progress = list[tuple[str, int, int]]()
    few = run_study(
        Draws(), 10, output=tmp_path, progress=lambda *now: progress.append(now)
    ).document()
    assert progress == [("Study draws", done, 10) for done in range(11)]
    assert json.loads((tmp_path / DOCUMENT_NAME).read_bytes()) == few
    assert (tmp_path / "total.txt").read_text() == str(few["total"])
    more = run_study(Draws(), 25, output=tmp_path).document()
    assert json.loads((tmp_path / DOCUMENT_NAME).read_bytes()) == more
    some = run_study(Draws(fails_above=0.0), 25).document()
    assert some["n"] + some["failures"]["DidNotConverge"] == 25 == some["runs"]
    assert some["total"] < 0.0
    assert some["settings"] == {"scale": 1.0, "fails": {"above": 0.0}}


def test_a_study_of_failures_only_says_why() -> None:
    with pytest.raises(DidNotConverge, match=r"all of its 5 runs failed.*The draw is"):
        run_study(Draws(fails_above=-np.inf), 5)


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.system)])
def test_a_mistake_in_a_study_is_no_failed_run(workers: int) -> None:
    with pytest.raises(ZeroDivisionError):
        run_study(Mistaken(), 4, workers=workers)


@pytest.mark.system
def test_processes_give_the_same_and_one_that_is_ended_from_outside_is_told(
    tmp_path: Path,
) -> None:
    study = Draws(fails_above=1.0)
    assert run_study(study, 30, workers=2).document() == run_study(study, 30).document()
    with pytest.raises(OutOfResources, match="one of the processes was ended from outside"):
        run_study(Deadly(), 20, workers=2, output=tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("there", "output", "message"),
    [
        ({"notes.txt": "mine"}, "", "a folder with other files"),
        ({DOCUMENT_NAME: "mine"}, "", "that is damaged or not of legcal"),
        ({"notes.txt": "mine"}, "notes.txt/below", "needed a path that can be created"),
    ],
    ids=range(3),
)
def test_a_folder_or_a_file_of_somebody_else_is_refused_and_kept(
    tmp_path: Path, there: dict[str, str], output: str, message: str
) -> None:
    for name, text in there.items():
        (tmp_path / name).write_text(text)
    with pytest.raises(UsageError, match=message):
        run_study(Mistaken(), 3, output=tmp_path / output)  # before any run
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == there


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
