"""Boards in pictures: where their corners are, and what is said where there is another."""

from dataclasses import replace

import numpy as np
import pytest
from boards import (
    APRILGRID,
    BOARDS,
    CHARUCO,
    CHESSBOARD,
    LENS,
    before,
    picture,
    plain_picture,
    seen_at,
)
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.data.measurements import Measurements, View
from legcal.errors import NotVisible
from legcal.perception.boards import detect_corners, require_board
from legcal.progress import no_progress
from legcal.vision.board import Board
from legcal.vision.corners import described, find_corners, quarter_turns
from legcal.workers import in_turn

KINDS = tuple(board.kind for board in BOARDS)


@pytest.mark.parametrize("kind", KINDS)
def test_corners_are_where_the_camera_sees_them_and_as_good_as_they_claim(kind: str) -> None:
    board, T, image = plain_picture(kind)
    number, px, sigma = find_corners(board, image)
    error = px - seen_at(board, T)[number]
    assert len(number) >= 0.8 * board.n_corners
    assert np.all(np.diff(number) > 0)
    assert np.abs(error.mean(axis=0)).max() < 0.01
    assert np.sqrt(np.mean(error**2)) < 0.03
    assert 0.3 < np.sqrt(np.mean((error / sigma[:, None]) ** 2)) < 1.6
    assert np.all(sigma < 0.06)


def test_a_blurred_picture_gives_corners_that_claim_less() -> None:
    board, T, sharp = plain_picture("chessboard")
    number, px, sigma = find_corners(board, picture(board, T, blur=1.5))
    error = px - seen_at(board, T)[number]
    assert np.median(sigma) > 1.15 * np.median(find_corners(board, sharp)[2])
    assert np.sqrt(np.mean((error / sigma[:, None]) ** 2)) < 1.6


def test_gamma_does_not_move_corners() -> None:
    board, T, _ = plain_picture("charuco")
    linear = picture(board, T, gamma=1.0, bits=16, electrons=np.inf)
    encoded = picture(board, T, gamma=2.4, bits=16, electrons=np.inf)
    (a, one, _), (b, other, _) = find_corners(board, linear), find_corners(board, encoded)
    both = np.intersect1d(a, b)
    shift = one[np.isin(a, both)] - other[np.isin(b, both)]
    assert len(both) > 10
    assert np.abs(shift.mean(axis=0)).max() < 0.004


@pytest.mark.parametrize("turn", [np.pi, -0.4 * np.pi])
def test_a_chessboard_on_its_head_keeps_its_numbers(turn: float) -> None:
    T = before(CHESSBOARD, 0.55) * RigidTransform.from_rotation(Rotation.from_euler("z", turn))
    number, px, _ = find_corners(CHESSBOARD, picture(CHESSBOARD, T))
    assert len(number) >= 0.8 * CHESSBOARD.n_corners
    assert np.abs(px - seen_at(CHESSBOARD, T)[number]).max() < 0.2


def test_what_hides_a_corner_takes_that_corner_only() -> None:
    T = before(CHARUCO)
    hidden = 7
    image = picture(CHARUCO, T, hidden=CHARUCO.points[hidden] - [0.0, 0.0, 0.011])
    number, px, _ = find_corners(CHARUCO, image)
    assert hidden not in number
    assert len(number) >= 6
    assert np.abs(px - seen_at(CHARUCO, T)[number]).max() < 0.3


def test_a_part_of_a_chessboard_is_not_used() -> None:
    image = picture(CHESSBOARD, before(CHESSBOARD), hidden=CHESSBOARD.points[14])
    assert len(find_corners(CHESSBOARD, image)[0]) == 0


def test_a_part_of_a_larger_chessboard_is_not_taken_for_a_small_one() -> None:
    image = plain_picture("chessboard")[2]
    assert len(find_corners(replace(CHESSBOARD, columns=5), image)[0]) == 0


@pytest.mark.parametrize("board", BOARDS, ids=KINDS)
def test_a_picture_without_a_board_has_no_corners(board: Board) -> None:
    blank = np.random.default_rng(0).normal(100.0, 3.0, (120, 160)).astype(np.float32)
    number, px, sigma = find_corners(board, blank)
    assert (number.shape, px.shape, sigma.shape) == ((0,), (0, 2), (0,))
    assert board.kind == "chessboard" or described(board, blank) is None


@pytest.mark.slow
def test_nothing_is_said_of_a_picture_without_a_chessboard() -> None:
    blank = np.random.default_rng(0).normal(100.0, 3.0, (120, 160)).astype(np.float32)
    assert described(CHESSBOARD, blank) is None


def test_tags_of_opencv_stand_on_the_heads_of_those_of_kalibr() -> None:
    assert quarter_turns() == 2


@pytest.mark.parametrize(
    ("said", "kind", "words"),
    [
        (replace(CHARUCO, columns=5, rows=3), "charuco", "markers with numbers up to 11"),
        (replace(APRILGRID, columns=2), "aprilgrid", "tags with numbers up to 5"),
        (replace(CHARUCO, dictionary="DICT_5X5_50"), "charuco", "markers of DICT_4X4"),
        pytest.param(
            replace(CHESSBOARD, columns=8, rows=5),
            "chessboard",
            "a chessboard of 7 x 6 squares",
            marks=pytest.mark.slow,
        ),
        (replace(CHESSBOARD, columns=6, rows=5), "chessboard", "a chessboard of 6 x 7 squares"),
    ],
)
def test_a_board_of_other_dimensions_is_named(said: Board, kind: str, words: str) -> None:
    image = plain_picture(kind)[2]
    assert words in str(described(said, image))


def _rows(n: int) -> Measurements:
    views = (View("c1", LENS),)
    index = np.arange(n)
    names = tuple(f"{k}.png" for k in range(n))
    return Measurements(views, names, np.zeros(n, dtype=np.intp), index, np.zeros((n, 1)), 1e-6)


def test_images_are_searched_by_row_and_a_view_without_the_board_is_refused() -> None:
    board, _, image = plain_picture("aprilgrid")
    blank = np.full_like(image, 90.0)
    steps: list[tuple[int, int]] = []
    images = [blank, image]
    found = detect_corners(
        board, images.__getitem__, [0, 1], in_turn, lambda _, k, n: steps.append((k, n))
    )
    assert set(found.row.tolist()) == {1}
    assert steps == [(0, 2), (1, 2), (2, 2)]
    assert set(found.source) == {"detected"}
    require_board(board, found, images.__getitem__, _rows(2), ["c1"])
    other = replace(board, columns=2)
    nothing = detect_corners(other, lambda _: blank, [0], in_turn, no_progress)
    with pytest.raises(NotVisible, match="c1: the board could not be found in any of its 1 image"):
        require_board(other, nothing, lambda _: image, _rows(1), ["c1"])
    require_board(other, nothing, lambda _: image, _rows(1), [])
