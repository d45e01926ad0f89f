"""``legcal identify``: the report, a board, choices, datasets, words, tables and refusals."""

import io
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from command_line import run
from hexapod_example import HEXAPOD
from rich.console import Console

import legcal
from legcal.calibration.identify.identifiability import (
    Analysis,
    check_identifiable,
    identifiability_of_dataset,
)
from legcal.calibration.identify.report import Identifiability
from legcal.calibration.identify.session import recorded_session
from legcal.calibration.joint_fit.parameter_choices import Choices, Prior
from legcal.data.corners import found_corners
from legcal.data.dataset import Dataset, load_dataset
from legcal.data.image_choice import dataset_at
from legcal.errors import NotIdentifiable
from legcal.machine.model import Machine
from legcal.machine.parameters import parametrization_of
from legcal.report.machine import identify_table
from legcal.vision.board import Board, FixedBoard

pytestmark = pytest.mark.usefixtures("without_remedies")  # test_identify_ranks.py has them

LEGS = tuple(f"leg{j}" for j in range(1, 7))
VIEWS = {
    "paper": (LEGS[:4], LEGS[2:], (*LEGS[:2], *LEGS[4:])),
    "weak joint": (LEGS[:5], LEGS[:5], LEGS[4:]),
    "halves": (LEGS[:3], LEGS[3:], LEGS[:3]),
}


@cache
def loaded(name: str) -> Machine:
    return legcal.load_mechanism(name)


@cache
def report(views: str, **choices: Any) -> Identifiability:
    return legcal.identifiability(loaded("hexapod"), VIEWS[views], **choices)


@cache
def example() -> Dataset:
    return load_dataset(HEXAPOD, check_images=False)


@cache
def two_images() -> Dataset:
    return dataset_at(example(), np.array([0, 15]))


def said(found: Identifiability) -> str:
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(identify_table(found))
    return " ".join(console.export_text().split())


def options(views: Sequence[Sequence[str]]) -> Iterator[str]:
    for view in views:
        yield from ("--view", ",".join(view))


# A calibration board


@pytest.mark.parametrize(
    ("views", "images", "ranks"),
    [("weak joint", 6, (30, 30)), ("weak joint", 1, (26, 30))],
)
def test_a_board_raises_the_rank_and_takes_the_place_of_a_condition(
    views: str, images: int, ranks: tuple[int, int]
) -> None:
    without, given = (report(views, images=images, board=board) for board in (False, True))
    assert (without.full.rank, given.full.rank) == ranks
    assert (without.board, given.board) == (False, True)
    assert [c.needed for c in (without.conditions[0], given.conditions[0])] == [None, False]
    assert not given.conditions[0].fails


def test_only_a_board_lets_a_camera_in_the_hand_meet_the_conditions() -> None:
    found = report("paper", board=True, hand_held=True)
    assert (len(found.views), set(found.images)) == (45, {1})
    assert found.full.rank == 30
    assert found.paper.ok
    assert found.board
    assert "views 1 to 15: legs 1, 2, 3, 4 in 1 image each" in said(found)


# The document and the command


def test_the_document_is_that_of_the_report(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        run(monkeypatch, "identify", "hexapod", *options(VIEWS["halves"]), "--board", "--json") == 0
    )
    document = json.loads(capsys.readouterr().out)
    found = report("halves", board=True)
    assert document == json.loads(json.dumps(found.document()))
    sizes = {"spatial": True, "n": 6, "n_d": 3, "r": 0, "n_ac": 6}
    assert {k: document[k] for k in sizes} == sizes
    assert document["conditions"][0] == {
        "name": "eq12", "equations": 9, "unknowns": 12, "ok": False, "needed": False,
    }  # fmt: skip
    assert "needed" not in document["conditions"][1]
    assert document["paper"] == {"ok": found.paper.ok}
    assert document["board"] is True
    assert document["views"] == [list(view) for view in VIEWS["halves"]]
    assert found == report("halves", images=15, board=True)


# Datasets


def test_a_dataset_with_a_board_is_judged_with_it() -> None:
    """Everywhere until somebody has looked for it, then in the views that show it."""
    board = Board("chessboard", 9, 6, 0.03)
    with_board = replace(example(), boards=(FixedBoard(board, "base"),))
    assert not recorded_session(example()).board.any()
    assert recorded_session(with_board).board.all()
    row = np.flatnonzero(example().measurements.view == 1)[:1]
    one = found_corners(row, np.array([0]), np.array([[10.0, 20.0]]), np.array([0.05]))
    shown = recorded_session(replace(with_board, corners=one)).board
    np.testing.assert_array_equal(shown, [False, True, False])
    found = identifiability_of_dataset(with_board)
    assert found.board
    assert found.conditions[0].needed is False


def test_choices_determine_what_they_say_and_no_more() -> None:
    names = parametrization_of(two_images().machine).names
    with pytest.raises(NotIdentifiable, match="or state known values with --set"):
        check_identifiable(two_images())
    known, vague = (
        Choices(priors={name: Prior(0.3, sigma) for name in names}) for sigma in (1e-4, 100.0)
    )
    assert check_identifiable(two_images(), known) == ()

    def rank(choices: Choices) -> int:
        return Analysis(recorded_session(two_images()), choices).full.rank

    alone = rank(Choices())
    assert rank(Choices(fixed=frozenset(names))) == 30
    assert rank(Choices(fixed=frozenset({"leg4.offset"}))) == alone + 1
    assert rank(vague) == alone


@pytest.mark.parametrize(("name", "images", "noted"), [("3-rps", 3, True), ("hexapod", 4, False)])
def test_directions_that_a_fit_would_refuse_are_noted(name: str, images: int, noted: bool) -> None:
    machine = legcal.load_mechanism(name)
    report = legcal.identifiability(machine, [machine.leg_names], images)
    assert report.identifiable
    assert report.platform_sigma is not None
    assert (report.platform_sigma.dX_m > 0.02) == noted
    assert any("a tenth of a leg" in note for note in report.notes) == noted
