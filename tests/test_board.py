"""The block ``board`` of a dataset: what it says, and what it may not say."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from boards import APRILGRID, BOARDS, CHARUCO, CHESSBOARD
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from legcal.errors import DatasetError
from legcal.simulation.board import INK, BoardPrint
from legcal.vision.board import Board, board_document, charuco_board, described_board, read_board

PATH = Path("dataset.yaml")
CHESS = {"kind": "chessboard", "squares_x": 9, "squares_y": 6, "square": 0.03}
CHAR = {
    "kind": "charuco", "squares_x": 7, "squares_y": 5, "square": 0.04, "marker": 0.03,
    "dictionary": "DICT_4X4_50",
}  # fmt: skip
APRIL = {"kind": "aprilgrid", "tags_x": 6, "tags_y": 6, "tag_size": 0.088, "tag_spacing": 0.3}


def test_corners_of_a_charuco_board_are_those_of_opencv() -> None:
    theirs = np.asarray(charuco_board(CHARUCO).getChessboardCorners())
    assert CHARUCO.points == pytest.approx(theirs, abs=1e-7)


def test_corner_0_of_a_chessboard_is_the_origin_and_x_comes_first() -> None:
    assert CHESSBOARD.n_corners == 30
    assert CHESSBOARD.points[[0, 1, 6]] == pytest.approx(
        np.array([[0.0, 0.0, 0.0], [0.03, 0.0, 0.0], [0.0, 0.03, 0.0]])
    )


def test_corners_of_an_aprilgrid_are_those_of_kalibr() -> None:
    # Row by row of corners: two of each tag, 0.3 of a tag between tags.
    x = 0.06 * np.array([0.0, 1.0, 1.3, 2.3, 2.6, 3.6])
    assert APRILGRID.points[:6, 0] == pytest.approx(x)
    assert APRILGRID.points[::6, 1] == pytest.approx(x[:4])


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize(("columns", "rows"), [(5, 4), (4, 5), (5, 5)])
def test_the_print_of_a_charuco_board_is_that_of_opencv(
    columns: int, rows: int, legacy: bool
) -> None:
    board = Board(
        "charuco", columns, rows, 0.04, marker=0.03, dictionary="DICT_4X4_50", legacy=legacy
    )
    side = 80
    theirs = np.asarray(charuco_board(board).generateImage((side * columns, side * rows))) > 127
    v, u = np.indices(theirs.shape) + 0.5
    sheet = BoardPrint.of(board, 2, np.zeros(2))
    x, y = u.ravel() * 0.04 / side, v.ravel() * 0.04 / side
    ours = sheet.reflectance(x, y).reshape(theirs.shape) > 0.5
    assert np.mean(ours != theirs) < 1e-3


def test_tags_are_printed_as_kalibr_prints_them() -> None:
    # Tag 0 of the family 36h11, its code row by row from the top left, y upwards.
    sheet = BoardPrint.of(APRILGRID, 5, np.zeros(2))
    module = 0.06 / 10
    k = np.arange(6)
    x, y = np.meshgrid((2.5 + k) * module, (7.5 - k) * module)
    code = sheet.reflectance(x.ravel(), y.ravel()) > 0.5
    assert int("".join("1" if white else "0" for white in code), 2) == 0xD5D628584
    gap = 0.3 * 0.06
    black = sheet.reflectance(np.array([-0.5 * gap, 0.03]), np.array([-0.5 * gap, -0.5 * gap]))
    assert black == pytest.approx([INK, 1.0])


def test_the_first_square_of_a_chessboard_is_black() -> None:
    sheet = BoardPrint.of(CHESSBOARD, 2, np.zeros(2))
    x = np.array([-0.015, 0.015, 0.015])
    y = np.array([-0.015, -0.015, 0.015])
    assert sheet.reflectance(x, y) == pytest.approx([INK, 1.0, INK])


@pytest.mark.parametrize("board", BOARDS, ids=[b.kind for b in BOARDS])
def test_what_is_printed_lies_inside_the_extent(board: Board) -> None:
    low, high = board.extent.min(axis=0), board.extent.max(axis=0)
    assert np.all(board.points >= low - 1e-12)
    assert np.all(board.points <= high + 1e-12)


@settings(max_examples=50)
@given(
    st.sampled_from(["chessboard", "charuco", "aprilgrid"]),
    st.integers(2, 12),
    st.integers(2, 12),
    st.floats(0.001, 0.5),
    st.floats(0.2, 0.9),
    st.booleans(),
)
def test_a_board_is_read_as_it_was_written(
    kind: str, x: int, y: int, side: float, part: float, legacy: bool
) -> None:
    if kind == "chessboard":
        assume(min(x, y) >= 4 and x % 2 != y % 2)
        board = Board("chessboard", x, y, side)
    elif kind == "charuco":
        assume((x - 1) * (y - 1) >= 4 and part * side >= 0.0005)
        marker = part * side
        board = Board(
            "charuco", x, y, side, marker=marker, dictionary="DICT_5X5_100", legacy=legacy
        )
    else:
        board = Board("aprilgrid", x, y, side, spacing=part, dictionary="DICT_APRILTAG_36h11")
    read, T = described_board(board_document(board), PATH)
    assert T is None
    assert vars(read).keys() == vars(board).keys()
    assert board_document(read) == board_document(board)
    assert read.points == pytest.approx(board.points, abs=0.0)


def test_a_board_may_say_where_it_is() -> None:
    pose = {"xyz": [0.1, 0.2, 0.3], "quat_xyzw": [0.0, 0.0, 0.6, 0.8]}
    _, T = described_board({**CHESS, "T_base_board": pose}, PATH)
    assert T is not None
    assert T.translation == pytest.approx([0.1, 0.2, 0.3])
    assert read_board(None, PATH) == (None, None)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({**CHESS, "square": 30}, r"board.square could not be used: found 30 m.*0.03 for 30 mm"),
        ({**CHESS, "square": 0.0}, "board.square could not be used: found 0 m"),
        ({**CHESS, "square": float("nan")}, "board.square could not be read"),
        ({**CHESS, "kind": "chess"}, "board.kind could not be read: found 'chess', needed chessb"),
        ({"squares_x": 9}, "board.kind could not be read: found no such key"),
        ({**CHESS, "squares_x": 8}, "8 x 6 squares, which looks the same after half a turn"),
        ({**CHESS, "squares_x": 7, "squares_y": 5}, "7 x 5 squares, which looks the same"),
        ({**CHESS, "squares_x": 3}, "3 x 6 squares, needed 4 or more each way"),
        ({**CHESS, "squares_x": 9.5}, "board.squares_x could not be read"),
        ({**CHESS, "squares_x": -1}, "board.squares_x could not be used: found -1"),
        ({**CHESS, "squares_x": True}, "board.squares_x could not be read"),
        ({**CHESS, "columns": 9}, "board.columns could not be used: found an unknown key"),
        ({**CHESS, "T_base_board": {"xyz": [0, 0, 0]}}, "board.T_base_board.quat_xyzw could not"),
        ({**CHAR, "marker": 0.05}, "markers of 0.05 m in squares of 0.04 m, needed smaller"),
        ({**CHAR, "marker": 30}, "board.marker could not be used: found 30 m"),
        ({**CHAR, "dictionary": "4X4"}, "board.dictionary could not be used: found '4X4'"),
        ({**CHAR, "squares_x": 20, "squares_y": 20}, "200 markers on 20 x 20 .* at most the 50 of"),
        ({**CHAR, "squares_x": 2, "squares_y": 3}, "2 x 3 squares, needed four or more corners"),
        ({k: v for k, v in CHAR.items() if k != "marker"}, "board.marker could not be read: found"),
        ({**APRIL, "tag_size": 88}, "board.tag_size could not be used: found 88 m"),
        ({**APRIL, "tag_spacing": 0.026}, "found 0.026, needed 0.05 to 2: the gap between two"),
        ({**APRIL, "tags_x": 60, "tags_y": 60}, "60 x 60 tags, needed 2 to 587 tags"),
        ({**APRIL, "family": "25h9"}, "board.family could not be read: found '25h9'"),
    ],
)
def test_a_board_that_cannot_be_is_refused(entry: dict[str, Any], message: str) -> None:
    with pytest.raises(DatasetError, match=message) as caught:
        described_board(entry, PATH)
    assert len(caught.value.problems) == 1


def test_opencv_has_what_boards_need() -> None:
    for name in ("findChessboardCornersSB", "solvePnPGeneric", "aruco"):
        assert hasattr(cv2, name)
    for name in ("ArucoDetector", "CharucoDetector", "CharucoBoard"):
        assert hasattr(cv2.aruco, name)
