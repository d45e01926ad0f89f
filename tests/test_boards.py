"""Calibration boards: as files describe them, as they are printed, found, and place cameras."""

from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
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

from legcal.data.corners import Corners, found_corners, join_corners
from legcal.data.measurements import Measurements, View
from legcal.data.reasons import Reason
from legcal.errors import DatasetError, NotVisible
from legcal.geometry.types import Array, Image, IntArray
from legcal.perception.board_adjustment import camera_poses_by_board, plane_poses
from legcal.perception.board_corners import (
    SeenBoard,
    certain_corners,
    describe_image,
    detect_corners,
    require_board,
    search_board,
    shown_board,
    tags_are_mirrored,
)
from legcal.progress import no_progress
from legcal.vision.board import Board, board_document, board_of, charuco_board, parse_board
from legcal.vision.camera import Camera
from legcal.vision.image_file import reduced, rescaled
from legcal.workers import in_turn

PATH = Path("dataset.yaml")
SIGMA = 0.05


# What a board is, and how files describe it.


def find_corners(board: Board, image: Image) -> tuple[IntArray, Array, Array]:
    return certain_corners(board, search_board(board, image))


def test_corners_are_numbered_as_opencv_and_kalibr_number_them() -> None:
    assert CHESSBOARD.points[[0, 1, 6]] == pytest.approx(
        np.array([[0.0, 0.0, 0.0], [0.03, 0.0, 0.0], [0.0, 0.03, 0.0]])
    )
    theirs = np.asarray(charuco_board(CHARUCO).getChessboardCorners())
    assert CHARUCO.points == pytest.approx(theirs, abs=1e-7)
    # Row by row of corners: two of each tag, 0.3 of a tag between tags.
    x = 0.06 * np.array([0.0, 1.0, 1.3, 2.3, 2.6, 3.6])
    assert APRILGRID.points[:6, 0] == pytest.approx(x)
    assert APRILGRID.points[::6, 1] == pytest.approx(x[:4])
    for board in BOARDS:
        low, high = board.extent.min(axis=0), board.extent.max(axis=0)
        assert np.all((board.points >= low - 1e-12) & (board.points <= high + 1e-12))


@pytest.mark.parametrize(
    "board", [*BOARDS, replace(CHARUCO, legacy=True)], ids=lambda b: f"{b.kind}-{b.legacy}"
)
def test_a_board_is_read_as_it_was_written(board: Board) -> None:
    read = parse_board(board_document(board), PATH)
    assert read.T_link_board is None
    assert asdict(read.board) == asdict(board)
    assert read.board.points == pytest.approx(board.points, abs=0.0)
    pose = {"xyz": [0.1, 0.2, 0.3], "quat_xyzw": [0.0, 0.0, 0.6, 0.8]}
    T = parse_board({**board_document(board), "T_base_board": pose}, PATH).T_link_board
    assert T is not None
    assert T.translation == pytest.approx([0.1, 0.2, 0.3])
    assert T.rotation.as_quat() == pytest.approx([0.0, 0.0, 0.6, 0.8])


@pytest.mark.parametrize(
    ("target", "board"),
    [
        ("target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 5\ntagSize: 0.06\ntagSpacing: 0.3\n",
         replace(APRILGRID, columns=6, rows=5)),
        ('{"tagCols": 6, "tagRows": 5, "tagSize": 0.06, "tagSpacing": 0.3}',
         replace(APRILGRID, columns=6, rows=5)),
        ("target_type: checkerboard\ntargetCols: 8\ntargetRows: 6\nrowSpacingMeters: 0.03\n"
         "colSpacingMeters: 0.03\n", Board("chessboard", 9, 7, 0.03)),
    ],
)  # fmt: skip
def test_targets_of_kalibr_and_basalt_are_boards(tmp_path: Path, target: str, board: Board) -> None:
    path = tmp_path / "target.yaml"
    path.write_text(target)
    assert vars(board_of(path)) == vars(board)
    circles = {"target_type": "circlegrid", "targetCols": 6}
    for wrong, named in (
        (target.replace("0.06", "88").replace("colSpacingMeters: 0.03", ""), "needed"),
        (yaml.safe_dump(circles), "'circlegrid'"),
    ):
        path.write_text(wrong)
        with pytest.raises(DatasetError, match=named):
            board_of(path)


# Where its corners are in an image.


def sharpened(image: Image) -> Image:
    """Return what a camera makes of an image: edges overshoot by a tenth of the contrast and more.

    And its JPEG is coarse.
    """
    sharp = image + 1.3 * (image - cv2.GaussianBlur(image, (0, 0), 1.5))
    _, file = cv2.imencode(".jpg", np.clip(sharp, 0, 255), [cv2.IMWRITE_JPEG_QUALITY, 75])
    return np.asarray(cv2.imdecode(file, cv2.IMREAD_GRAYSCALE))


@pytest.mark.parametrize("kind", [board.kind for board in BOARDS])
@pytest.mark.parametrize(
    ("look", "shown", "rms", "ratio"),
    [("plain", 0.8, 0.03, 1.6), ("sharpened", 0.95, 0.05, 2.0)],
)
def test_corners_are_where_the_camera_sees_them_and_as_good_as_they_claim(
    look: str, shown: float, rms: float, ratio: float, kind: str
) -> None:
    board, T, image = plain_picture(kind)
    number, px, sigma = find_corners(board, sharpened(image) if look == "sharpened" else image)
    error = px - seen_at(board, T)[number]
    assert len(number) >= shown * board.n_corners
    assert np.all(np.diff(number) > 0)
    assert np.sqrt(np.mean(error**2)) < rms
    assert 0.3 < np.sqrt(np.mean((error / sigma[:, None]) ** 2)) < ratio
    if look == "plain":
        assert np.abs(error.mean(axis=0)).max() < 0.01
        assert np.all(sigma < 0.06)


@pytest.mark.parametrize("board", BOARDS, ids=lambda b: b.kind)
def test_images_of_anything_else_show_no_board(board: Board) -> None:
    rng = np.random.default_rng(1)
    for shape in ((1, 1), (2, 9), (60, 80)):
        for image in (np.zeros(shape), rng.normal(100.0, 2.0, shape), rng.uniform(0, 255, shape)):
            assert len(find_corners(board, image)[0]) == 0


def test_tags_of_a_blurred_picture_are_read() -> None:
    """No module of a tag is told from the next by OpenCV before the image is sharpened."""
    T = before(APRILGRID)
    number, px, sigma = find_corners(APRILGRID, picture(APRILGRID, T, blur=3.2))
    error = px - seen_at(APRILGRID, T)[number]
    assert len(number) >= 0.9 * APRILGRID.n_corners
    assert np.sqrt(np.mean((error / sigma[:, None]) ** 2)) < 2.0


@pytest.mark.parametrize("scale", [2, 1.6, 0.7])
def test_pixels_of_a_rescaled_image_are_put_back_where_they_were(scale: float) -> None:
    """Corners of small boards are searched in an enlarged image, of large images in a smaller."""
    x, y = np.meshgrid(np.arange(60.0), np.arange(40.0))
    spot = 200.0 * np.exp(-0.5 * ((x - 31.3) ** 2 + (y - 17.8) ** 2) / 9.0)
    image = rescaled(spot.astype(np.uint8), scale)
    height, width = image.shape
    assert (height, width) == (40 * scale, 60 * scale)
    v, u = np.indices((height, width))
    centroid = np.array([(u * image).sum(), (v * image).sum()]) / image.sum(dtype=np.float64)
    assert reduced(centroid, scale) == pytest.approx([31.3, 17.8], abs=0.03)


@pytest.mark.parametrize("board", [CHARUCO, CHESSBOARD], ids=lambda b: b.kind)
def test_a_hidden_corner_is_left_out_and_the_others_are_found(board: Board) -> None:
    hidden, T = 14 if board is CHESSBOARD else 7, before(board)
    image = picture(board, T, hidden=board.points[hidden] - [0.0, 0.0, 0.011])
    number, px, _ = find_corners(board, image)
    assert hidden not in number
    assert len(number) >= 0.5 * board.n_corners
    assert np.abs(px - seen_at(board, T)[number]).max() < 0.3


def test_a_part_of_a_chessboard_is_placed_on_it_but_not_for_certain() -> None:
    board, T, image = plain_picture("chessboard")
    assert len(find_corners(replace(board, columns=5), image)[0]) == 0  # it is larger
    truth = seen_at(board, T)
    cut = int(truth[board.grid[0] - 2 :: board.grid[0], 0].min())  # through the last columns
    part = image[:, :cut]
    assert len(find_corners(board, part)[0]) == 0
    found = search_board(board, part).numbered(board)
    assert not found.certain
    assert len(found.number) >= 12
    away = np.linalg.norm(found.px[:, None] - truth, axis=2)
    assert away.min(axis=1).max() < 0.1
    assert len(np.unique(away.argmin(axis=1))) == len(found.number)
    # as on the board, but for a whole step and half a turn
    there, here = board.points[away.argmin(axis=1), :2], board.points[found.number, :2]
    turn, *_ = np.linalg.lstsq(there - there.mean(axis=0), here - here.mean(axis=0))
    assert np.abs(turn) == pytest.approx(np.abs(turn).round(), abs=1e-9)
    assert np.linalg.det(turn) == pytest.approx(1.0)


def _shows(columns: int, rows: int) -> SeenBoard:
    """Return what is seen of a board of so many corners."""
    j, i = np.indices((rows, columns))
    ij = np.column_stack([i.ravel(), j.ravel()])
    black = np.where(ij.sum(axis=1) % 2 == 0, 1, -1)
    return SeenBoard(ij, 20.0 * ij.astype(np.float64), np.full(len(ij), 0.1), black)


@pytest.mark.parametrize(
    ("stated", "extents", "shown", "words"),
    [
        ((9, 6), [(8, 5)] * 2 + [(9, 6)], (9, 6), ""),
        ((9, 6), [(9, 6)] * 3 + [(8, 5), (4, 3)], (10, 7), "write --board chessboard:10x7:30mm."),
        ((9, 6), [(7, 5)] * 3, (9, 6), "8 x 6 squares or that part of one is seen in 3 of its 3"),
        ((11, 8), [(6, 9)] * 2 + [(5, 4)], (11, 8), "10 x 7 squares or that part of one"),
        ((9, 6), [(10, 7)] * 2 + [(8, 5)], None, "a chessboard of 11 x 8 squares in 2 of its 3"),
    ],
)  # fmt: skip
def test_squares_or_inner_corners_are_told_by_all_images(
    stated: tuple[int, int],
    extents: list[tuple[int, int]],
    shown: tuple[int, int] | None,
    words: str,
) -> None:
    board, said = shown_board(Board("chessboard", *stated, 0.03), [_shows(*e) for e in extents])
    assert (board and (board.columns, board.rows)) == shown
    assert words in said
    assert bool(words) == bool(said)


def test_tags_of_a_mirrored_picture_are_named() -> None:
    board, _, image = plain_picture("aprilgrid")
    assert not tags_are_mirrored(board, image)
    assert tags_are_mirrored(board, image[:, ::-1])
    assert "mirrored" in str(describe_image(board, image[:, ::-1]))


@pytest.mark.parametrize("legacy", [False, True])
def test_the_older_pattern_of_a_charuco_board_is_told_by_its_markers(legacy: bool) -> None:
    board = Board("charuco", 5, 4, 0.04, marker=0.03, dictionary="DICT_4X4_50", legacy=legacy)
    paper = np.asarray(charuco_board(board).generateImage((400, 320), marginSize=20))
    seen = search_board(board, paper.astype(np.float64))
    assert len(seen.tags) == 10
    assert shown_board(board, [seen]) == (board, "")
    shown, said = shown_board(replace(board, legacy=not legacy), [seen])
    assert shown is None
    assert ("without :legacy" if not legacy else "of the older pattern (:legacy)") in said


def _measurements(per_view: tuple[int, ...], camera: Camera = LENS) -> Measurements:
    view = np.repeat(np.arange(len(per_view)), per_view)
    n = len(view)
    return Measurements(
        views=tuple(View(f"c{v + 1}", camera) for v in range(len(per_view))),
        image=tuple(f"{k}.png" for k in range(n)),
        view=view,
        pose=np.arange(n),
        q=np.zeros((n, 1)),
        sigma_q=np.full(1, 1e-6),
    )


def test_images_are_searched_by_row_and_a_view_without_the_board_is_refused() -> None:
    board, _, image = plain_picture("aprilgrid")
    blank = np.random.default_rng(0).normal(100.0, 3.0, (120, 160)).astype(np.float32)
    steps: list[tuple[int, int]] = []
    images = [blank, image]
    corners = detect_corners(
        board, images.__getitem__, [0, 1], in_turn, lambda _, k, n: steps.append((k, n))
    )
    assert set(corners.row.tolist()) == {1}
    assert steps == [(0, 2), (1, 2), (2, 2)]
    require_board(board, corners, images.__getitem__, _measurements((2,)), ["c1"])
    other = replace(board, columns=2)
    nothing = detect_corners(other, lambda _: blank, [0], in_turn, no_progress)
    assert len(nothing) == 0
    assert describe_image(board, blank) is None
    require_board(other, nothing, lambda _: image, _measurements((1,)), [])
    with pytest.raises(NotVisible, match=r"c1: .* any of its 1 image: found an AprilGrid of 3 x 2"):
        require_board(other, nothing, lambda _: image, _measurements((1,)), ["c1"])


# Where cameras stand before it.


def _corners(
    board: Board,
    places: list[RigidTransform],
    seed: int = 0,
    camera: Camera = LENS,
    sigma: float = SIGMA,
) -> Corners:
    rng, tables = np.random.default_rng(seed), []
    for row, T in enumerate(places):
        px = seen_at(board, T, camera)
        px = px + sigma * rng.normal(size=px.shape)
        n = len(px)
        row_of = np.full(n, row)
        tables.append(found_corners(row_of, np.arange(n), px, np.full(n, max(sigma, 1e-3))))
    return join_corners(tables)


def _turn(one: RigidTransform | None, other: RigidTransform) -> float:
    assert one is not None
    return float((one.rotation * other.rotation.inv()).magnitude())


def test_errors_are_as_large_as_the_information_says_and_images_add_up() -> None:
    T = before(CHARUCO, 0.6)
    truth, squares = T.inv(), []
    joint: list[tuple[float, float]] = []
    for seed in range(5):
        corners = _corners(CHARUCO, [T] * 4, seed)
        one = corners.choose(corners.row == 0)
        best = plane_poses(LENS, CHARUCO.points[one.corner], one.px, one.sigma_px)[0]
        turn = (best.T_camera_board[0].rotation * truth.rotation.inv()).as_rotvec()
        d = np.concatenate([turn, best.T_camera_board[0].translation - truth.translation])
        squares.append(d @ best.information[0] @ d / 6.0)
        pose = camera_poses_by_board(corners, CHARUCO, _measurements((4,)))[0][0]
        joint.append((float(np.linalg.norm(turn)), _turn(pose, T)))
    assert 0.6 < np.mean(squares) < 1.5
    alone, together = np.sqrt(np.mean(np.square(joint), axis=0))
    assert together == pytest.approx(alone / 2.0, rel=0.5)


def test_a_view_without_the_board_has_no_pose_and_is_refused_only_where_it_is_needed() -> None:
    corners, m = _corners(CHARUCO, [before(CHARUCO)]), _measurements((1, 2))
    assert camera_poses_by_board(corners, CHARUCO, m)[0][1] is None
    with pytest.raises(NotVisible, match=r"view c2: .* none of its 2 images, needed them in one"):
        camera_poses_by_board(corners, CHARUCO, m, ["c2"])
    line = corners.choose(corners.corner < CHARUCO.grid[0])
    assert camera_poses_by_board(line, CHARUCO, _measurements((1,)))[0] == (None,)


def test_two_poses_that_explain_a_board_alike_are_refused_or_told_apart_by_more_images() -> None:
    board = replace(CHESSBOARD, side=0.004)  # almost without perspective
    T = before(board, 0.4, np.array([0.3, 0.0, 0.0]))
    one = _corners(board, [T], 2, sigma=0.2)
    both = plane_poses(LENS, board.points, one.px, one.sigma_px)
    assert len(both) == 2
    assert 0.0 <= both[1].cost - both[0].cost < 12.0
    with pytest.raises(NotVisible, match=r"two poses that explain the 30 corners .* degrees apart"):
        camera_poses_by_board(one, board, _measurements((1,)), ["c1"])
    assert camera_poses_by_board(one, board, _measurements((1,)))[0] == (None,)
    many = _corners(board, [T] * 12, 2, sigma=0.2)
    pose = camera_poses_by_board(many, board, _measurements((12,)), ["c1"])[0][0]
    assert _turn(pose, T) < np.deg2rad(2.0)


def test_a_board_that_moved_in_an_image_is_named_with_how_far() -> None:
    T, shift = before(CHARUCO, 0.6), 0.001
    moved = RigidTransform.from_translation([shift, 0.0, 0.0]) * T
    with pytest.raises(DatasetError, match=r"view c1: .* in 2.png than in \d.png, by up") as caught:
        camera_poses_by_board(_corners(CHARUCO, [T, T, moved, T]), CHARUCO, _measurements((4,)))
    apart = float(str(caught.value).split("by up to ")[1].split(" mm")[0])
    assert apart == pytest.approx(1e3 * shift, rel=0.3)
    assert (
        camera_poses_by_board(_corners(CHARUCO, [T] * 4), CHARUCO, _measurements((4,)))[0][0]
        is not None
    )


@pytest.mark.parametrize("n", [2, 3, 6])
def test_a_view_from_the_hand_is_not_taken_for_another_board(n: int) -> None:
    turns = Rotation.from_euler("z", np.linspace(0.0, 2.5, n)[:, None])
    places = [before(CHARUCO, 0.6) * RigidTransform.from_rotation(turn) for turn in turns]
    with pytest.raises(DatasetError, match=r"^view c1: .* elsewhere in .*; write hand_held: true"):
        camera_poses_by_board(_corners(CHARUCO, places), CHARUCO, _measurements((n,)))


OTHER_LENS = replace(LENS, K=LENS.K * np.array([[0.6], [1.0], [1.0]]))


@pytest.mark.parametrize(
    ("true", "stated", "camera", "words"),
    [
        (APRILGRID, replace(APRILGRID, spacing=0.5), LENS, "the numbers of tags and tag_spacing"),
        (APRILGRID, replace(APRILGRID, columns=2, rows=3), LENS, "the numbers of tags"),
        (CHARUCO, replace(CHARUCO, columns=4, rows=6), LENS, "squares, marker and square"),
        (CHARUCO, CHARUCO, OTHER_LENS, "camera file is of this camera and lens"),
    ],
)
def test_corners_of_another_board_or_lens_are_refused(
    true: Board, stated: Board, camera: Camera, words: str
) -> None:
    corners = _corners(true, [before(true)])
    with pytest.raises(DatasetError, match=f"view c1: .* pose of the {true.kind} .*{words}"):
        camera_poses_by_board(corners, stated, _measurements((1,), camera))


def test_corners_that_no_one_pose_has_before_the_camera_are_refused() -> None:
    """Each image shows one half of the board, and by it the other half is behind the camera."""
    x, y = CHARUCO.points[:, 0], CHARUCO.points[:, 1]
    tables = []
    for row, sign in enumerate((1.0, -1.0)):
        depth = sign * (x - x.mean())
        here = np.flatnonzero(depth > 0.1 * np.ptp(x))
        P = np.column_stack([y - y.mean(), np.full(len(x), 0.5 * sign * np.ptp(x)), depth])
        px, sigma = LENS.project(P[here]), np.full(len(here), SIGMA)
        tables.append(found_corners(np.full(len(here), row), here, px, sigma))
    with pytest.raises(DatasetError, match=r"found no one pose of the charuco .* all its images"):
        camera_poses_by_board(join_corners(tables), CHARUCO, _measurements((2,)))


def test_an_outlier_is_rejected_and_does_not_bend_the_pose() -> None:
    T = before(CHARUCO, 0.6)
    corners = _corners(CHARUCO, [T], 3)
    px = corners.px.copy()
    px[4] += [6.0, -4.0]
    poses, kept = camera_poses_by_board(replace(corners, px=px), CHARUCO, _measurements((1,)))
    assert np.flatnonzero(~kept.used).tolist() == [4]
    assert kept.reason[4].reason is Reason.CORNER_OFF
    clean = camera_poses_by_board(corners, CHARUCO, _measurements((1,)))[0][0]
    assert clean is not None
    assert _turn(poses[0], clean) < 4e-3
