"""A calibration board on the platform: in a fit without legs, in datasets, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fit_sessions import (
    T_RE_BOARD,
    MachineSession,
    machine_session,
    place_of_board,
    with_boards,
)

from legcal.calibration.joint_fit import refine
from legcal.data.outlines import no_outlines
from legcal.errors import DatasetError
from legcal.vision.board_file import parse_boards

PATH = Path("dataset.yaml")
CHARUCO: dict[str, Any] = {
    "kind": "charuco", "squares_x": 7, "squares_y": 5, "square": 0.03, "marker": 0.02,
    "dictionary": "DICT_4X4_50",
}  # fmt: skip
CHESSBOARD: dict[str, Any] = {
    "kind": "chessboard", "squares_x": 9, "squares_y": 6, "square": 0.03
}  # fmt: skip
ON_PLATFORM = {"on": "platform"}


def _off(session: MachineSession, legs: Any) -> float:
    fitted, true = session.legs, session.truth.legs
    return float(np.abs(fitted.vector(legs) - fitted.vector(true)).max())


@pytest.mark.parametrize(
    ("name", "base"),
    [("hexapod", True), ("hexapod", False), ("6-sps", True), ("nategh-agheli", True)],
)
def test_boards_alone_give_the_machine_exactly_without_noise(name: str, base: bool) -> None:
    """From joints that are 3 mm and axes that are 1 degree off; no image shows a leg."""
    session = machine_session(name, n_poses=8)
    assert _off(session, session.start.legs) > 0.002
    seen, start = with_boards(session, base=base)
    found = refine(session.legs, session.measurements, no_outlines(), start, board=seen)
    assert _off(session, found.legs) < 1e-7
    assert found.radii == {}
    place = T_RE_BOARD.inv() * found.T_frame_board["platform"]
    assert np.linalg.norm(place.translation) < 1e-7
    if base:
        place = place_of_board(session).inv() * found.T_frame_board["base"]
        assert np.linalg.norm(place.translation) < 1e-7


def test_corners_of_the_board_on_the_platform_have_noise_and_outliers_of_their_own() -> None:
    session = machine_session("hexapod", n_poses=15)
    m = session.measurements
    seen, start = with_boards(session, seed=3)
    fixed = seen.boards[1]
    moved = fixed.has(seen.corners.corner)
    wrong = moved & (seen.corners.corner == fixed.first + 5) & (seen.corners.row % 6 == 0)
    px = seen.corners.px + np.where(wrong[:, None], [4.0, -3.0], 0.0)
    sigma = np.where(moved, 0.5, 1.0) * seen.corners.sigma_px  # said to be better than they are
    corners = replace(seen.corners, px=px, sigma_px=sigma)
    found = refine(session.legs, m, no_outlines(), start, board=replace(seen, corners=corners))
    rows = np.unique(seen.corners.row[wrong])
    assert set(found.rejected_corners) == {
        (m.views[m.view[row]].name, int(m.pose[row]), fixed.first + 5) for row in rows
    }
    right = refine(session.legs, m, no_outlines(), start, board=seen)
    np.testing.assert_allclose(found.sigma, right.sigma, rtol=0.1)
    assert found.rms_corners_px["platform"] == pytest.approx(0.05, rel=0.1)


@pytest.mark.parametrize(
    ("board", "words"),
    [
        (CHARUCO | {"on": "leg1_tube"}, ("board.on", "'leg1_tube'", "base or platform")),
        (CHARUCO | {"on": None}, ("board.on", "base or platform")),
        ([CHARUCO, CHESSBOARD], ("two boards on the base", "on the platform")),
        ([CHARUCO, CHARUCO | ON_PLATFORM | {"square": 0.04}], ("DICT_4X4", "apart")),
        ([CHARUCO, CHARUCO | ON_PLATFORM | {"dictionary": "DICT_4X4_100"}], ("DICT_4X4",)),
        ([CHESSBOARD, CHESSBOARD | ON_PLATFORM | {"square": 0.02}], ("numbers of squares",)),
        (CHARUCO | ON_PLATFORM | {"T_base_board": {"xyz": [0, 0, 0], "quat_xyzw": [0, 0, 0, 1]}},
         ("T_base_board", "T_platform_board")),
        ([], ("empty list",)),
        ([CHARUCO, "chessboard"], ("'chessboard'", "mapping")),
    ],
)  # fmt: skip
def test_boards_that_cannot_be_used_are_refused(board: Any, words: tuple[str, ...]) -> None:
    with pytest.raises(DatasetError) as caught:
        parse_boards(board, PATH)
    (problem,) = caught.value.problems
    assert [word for word in (str(PATH), "needed", *words) if word not in problem] == []


def test_boards_of_both_links_are_numbered_one_after_the_other_in_any_order() -> None:
    other = CHARUCO | ON_PLATFORM | {"dictionary": "DICT_5X5_50"}
    for blocks in ([CHARUCO, other], [other, CHARUCO]):
        base, platform = parse_boards(blocks, PATH)
        assert (base.link, platform.link) == ("base", "platform")
        assert (base.first, platform.first) == (0, 24)
        assert platform.has(np.array([23, 24, 47, 48])).tolist() == [False, True, True, False]
