"""A calibration board on the base: what it is needed for, what it mends, how the report says so."""

import io
import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from test_identify_command import run

import legcal
from legcal.calibration.identify.identifiability import identifiability_of_dataset
from legcal.calibration.identify.report import Identifiability
from legcal.calibration.identify.session import planned_session, recorded_session
from legcal.calibration.identify.steps import locate_joints
from legcal.data.corners import found_corners
from legcal.errors import UsageError
from legcal.machine import Machine
from legcal.report.identify import identify_table
from legcal.vision.board import Board

LEGS = tuple(f"leg{j}" for j in range(1, 7))
WEAK_JOINT = [LEGS[:5], LEGS[:5], LEGS[4:]]
HALVES = [LEGS[:3], LEGS[3:], LEGS[:3]]
PAPER = [LEGS[:4], LEGS[2:], (*LEGS[:2], *LEGS[4:])]


@cache
def hexapod() -> Machine:
    return legcal.load_mechanism("hexapod")


@cache
def report(views: str, **choices: Any) -> Identifiability:
    chosen = {"weak joint": WEAK_JOINT, "halves": HALVES, "paper": PAPER}[views]
    return legcal.identifiability(hexapod(), chosen, **choices)


def said(found: Identifiability) -> str:
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(identify_table(found))
    return " ".join(console.export_text().split())


def test_board_places_the_joint_that_hangs_on_one_distance() -> None:
    found = report("weak joint").board
    assert not found.present
    assert (found.without.staged_rank, found.with_board.staged_rank) == (26, 28)
    assert (found.without.full_rank, found.with_board.full_rank) == (30, 30)
    assert found.mends == ("x and y of base joint 6", "z of base joint 6")


def test_what_is_told_of_a_board_is_what_it_does() -> None:
    for views in ("weak joint", "halves"):
        without, given = report(views), report(views, board=True)
        assert without.board.with_board == given.board.with_board
        assert without.board.without == given.board.without
        assert given.staged.rank == given.board.with_board.staged_rank
        assert given.full.rank == given.board.with_board.full_rank
        assert (without.board.present, given.board.present) == (False, True)


def test_equation_12_is_printed_but_not_needed_with_a_board() -> None:
    before, after = (report("halves", board=board).conditions[0] for board in (False, True))
    assert (before.equations, before.unknowns, before.ok) == (9, 12, False)
    assert (before.needed, after.needed) == (True, False)
    assert (after.ok, after.fails) == (False, False)
    assert report("halves").board.needed_for == ("eq12",)


def test_views_that_determine_everything_need_no_board() -> None:
    found = report("paper").board
    assert found.needed_for == found.mends == ()
    assert found.without == found.with_board
    assert "A calibration board is not needed" in said(report("paper"))


def test_only_a_board_lets_the_steps_use_a_camera_in_the_hand() -> None:
    found = report("paper", board=True, hand_held=True)
    assert (len(found.views), set(found.images)) == (45, {1})
    assert found.staged.rank == found.full.rank == 30
    assert found.conditions_hold
    assert found.board.without.staged_rank == 0
    assert {"two_directions", "staged"} <= set(found.board.needed_for)
    assert "views 1 to 15: legs 1, 2, 3, 4 in 1 image each" in said(found)


def test_board_makes_images_of_all_places_one_camera_position() -> None:
    """Step 1 with a board: joints in its frame, one for each leg, from all images together."""
    views = [tuple(range(6))] * 8
    located = locate_joints(planned_session(hexapod(), views, 1, board=True))
    assert located.joint.shape == (1, 6)
    assert np.all(located.joint)
    assert not np.any(locate_joints(planned_session(hexapod(), views, 1)).joint)


def test_smallest_views_with_a_board_suffice_with_it() -> None:
    tricept = legcal.load_mechanism("tricept")
    found = legcal.identifiability(tricept, board=True)
    assert found.recommendation
    for choice in found.recommendation:
        again = legcal.identifiability(tricept, choice.views, board=True)
        assert again.conditions_hold
        assert again.staged.complete
        assert again.identifiable


def test_report_says_what_a_board_is_needed_for() -> None:
    text = said(report("halves"))
    assert "A calibration board on the base is needed for base joints and axes (12)" in text
    assert "raises the ranks from 18 to 24 of 30 step by step, and from 30 to 30 at once" in text
    assert "fails, not needed with the board" in said(report("halves", board=True))
    text = said(report("weak joint", board=True))
    assert "a calibration board on the base in every view" in text
    assert "and mends: x and y of base joint 6; z of base joint 6." in text


def test_json_has_the_board(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [word for view in HALVES for word in ("--view", ",".join(view))]
    assert run(monkeypatch, "hexapod", *words, "--board", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["conditions"][0]["needed"] is False
    assert "needed" not in document["conditions"][1]
    board = document["board"]
    assert board["without"] == {"staged_rank": 18, "full_rank": 30, "identifiable": True}
    assert board["with"] == {"staged_rank": 24, "full_rank": 30, "identifiable": True}
    assert (board["present"], board["needed_for"]) == (True, ["eq12"])
    assert "z of base joint 6" in board["mends"]


def test_hand_held_images_need_a_board_and_views() -> None:
    with pytest.raises(UsageError, match=r"found no board, needed .*give --board and --view"):
        legcal.identifiability(hexapod(), PAPER, hand_held=True)
    with pytest.raises(UsageError, match="found no views"):
        legcal.identifiability(hexapod(), board=True, hand_held=True)


@pytest.mark.parametrize("option", ["--board", "--hand-held"])
def test_a_dataset_says_itself_whether_it_has_a_board(
    option: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = Path(__file__).parents[1] / "examples" / "hexapod"
    assert run(monkeypatch, folder, option, "--json") == 2
    assert f"could not be judged with {option}" in capsys.readouterr().out


def test_a_dataset_with_a_board_is_judged_with_it() -> None:
    """Everywhere until somebody has looked for it, then in the views that show it."""
    folder = Path(__file__).parents[1] / "examples" / "hexapod"
    dataset = legcal.load_dataset(folder)
    with_board = replace(dataset, board=Board("chessboard", 9, 6, 0.03))
    assert not recorded_session(dataset).board.any()
    assert recorded_session(with_board).board.all()
    m = dataset.measurements
    row = np.flatnonzero(m.view == 1)[:1]
    one = found_corners(row, np.array([0]), np.array([[10.0, 20.0]]), np.array([0.05]))
    shown = recorded_session(replace(with_board, corners=one)).board
    np.testing.assert_array_equal(shown, [False, True, False])
    report = identifiability_of_dataset(with_board)
    assert report.board.present
    assert not report.conditions[0].needed
    assert not identifiability_of_dataset(dataset).board.present
