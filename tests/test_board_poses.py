"""Cameras before the board: their poses, what they are worth, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from boards import APRILGRID, CHARUCO, CHESSBOARD, LENS, before, seen_at
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.data.corners import Corners, found_corners, join_corners
from legcal.data.measurements import Measurements, View
from legcal.errors import DatasetError, NotVisible
from legcal.geometry.types import Array
from legcal.perception.boards import BoardPoses, camera_poses
from legcal.vision.board import Board
from legcal.vision.camera import Camera
from legcal.vision.plane_pose import plane_poses

SIGMA = 0.05
FISHEYE = Camera(LENS.K, LENS.width, LENS.height, np.array([0.02, -0.01, 0.0, 0.0]), "equidistant")
RATIONAL = Camera(
    LENS.K,
    LENS.width,
    LENS.height,
    np.array([0.3, 0.1, 1e-4, -1e-4, 0.01, 0.4, 0.08, 0.01]),
    "rational_polynomial",
)


def _measurements(per_view: tuple[int, ...], camera: Camera = LENS) -> Measurements:
    view = np.repeat(np.arange(len(per_view)), per_view)
    n = len(view)
    return Measurements(
        views=tuple(View(f"c{v + 1}", camera) for v in range(len(per_view))),
        image=tuple(f"{k}.png" for k in range(n)),
        view=view,
        pose=np.arange(n),
        q=np.zeros((n, 1)),
        sigma_q=1e-6,
    )


def _corners(
    board: Board,
    places: list[RigidTransform | None],
    rng: np.random.Generator,
    camera: Camera = LENS,
    sigma: float = SIGMA,
) -> Corners:
    tables = []
    for row, T in enumerate(places):
        if T is not None:
            px = seen_at(board, T, camera)
            px = px + sigma * rng.normal(size=px.shape)
            n = len(px)
            index = np.arange(n)
            tables.append(found_corners(np.full(n, row), index, px, np.full(n, max(sigma, 1e-3))))
    return join_corners(tables)


def _error(poses: BoardPoses, v: int, T_board_camera: RigidTransform) -> Array:
    found = poses.views[v]
    assert found is not None
    here, there = T_board_camera.inv(), found.inv()
    turn = (here.rotation * there.rotation.inv()).as_rotvec()
    return np.concatenate([here.translation - there.translation, turn])


@pytest.mark.parametrize("camera", [LENS, FISHEYE, RATIONAL], ids=["usual", "fisheye", "rational"])
@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO, APRILGRID], ids=lambda b: b.kind)
def test_without_noise_the_pose_is_exact(board: Board, camera: Camera) -> None:
    T = before(board, 0.6)
    corners = _corners(board, [T], np.random.default_rng(0), camera, 0.0)
    poses = camera_poses(corners, board, _measurements((1,), camera))
    assert np.abs(_error(poses, 0, T)).max() < 1e-8
    assert poses.rows[0] is not None


def test_errors_are_as_large_as_the_covariance_says() -> None:
    T = before(CHARUCO, 0.6)
    rng = np.random.default_rng(4)
    squares = []
    for _ in range(12):
        poses = camera_poses(_corners(CHARUCO, [T, T], rng), CHARUCO, _measurements((2,)))
        d = _error(poses, 0, T)
        squares.append(d @ np.linalg.solve(poses.covariance[0], d) / 6.0)
    assert 0.6 < np.mean(squares) < 1.5


def test_images_of_a_view_are_joined() -> None:
    T = before(CHARUCO, 0.6)
    rng = np.random.default_rng(5)
    one = camera_poses(_corners(CHARUCO, [T], rng), CHARUCO, _measurements((1,)))
    nine = camera_poses(_corners(CHARUCO, [T] * 9, rng), CHARUCO, _measurements((9,)))
    ratio = np.sqrt(np.diag(one.covariance[0]) / np.diag(nine.covariance[0]))
    assert ratio == pytest.approx(np.full(6, 3.0), rel=0.25)


def test_a_view_without_the_board_has_no_pose_and_is_refused_only_where_it_is_needed() -> None:
    corners = _corners(CHARUCO, [before(CHARUCO)], np.random.default_rng(0))
    m = _measurements((1, 2))
    poses = camera_poses(corners, CHARUCO, m)
    assert poses.views[1] is None
    assert np.isnan(poses.covariance[1]).all()
    with pytest.raises(NotVisible, match=r"view c2: .* none of its 2 images, needed them in one"):
        camera_poses(corners, CHARUCO, m, ["c2"])


def test_corners_on_a_line_give_no_pose() -> None:
    corners = _corners(CHARUCO, [before(CHARUCO)], np.random.default_rng(0))
    line = corners.choose(corners.corner < CHARUCO.grid[0])
    assert camera_poses(line, CHARUCO, _measurements((1,))).views == (None,)


def _flat() -> tuple[Board, RigidTransform]:
    """A small board far away, almost without perspective."""
    board = replace(CHESSBOARD, side=0.004)
    return board, before(board, 0.4, np.array([0.3, 0.0, 0.0]))


def test_two_poses_that_explain_a_board_alike_are_refused_or_told_apart_by_more_images() -> None:
    board, T = _flat()
    rng = np.random.default_rng(2)
    px = seen_at(board, T)
    sigma = np.full(len(px), 0.2)
    both = plane_poses(LENS, board.points, px + 0.2 * rng.normal(size=px.shape), sigma)
    assert len(both) == 2
    assert both[1].cost - both[0].cost < 12.0
    one = _corners(board, [T], rng, sigma=0.2)
    with pytest.raises(NotVisible, match=r"two poses that explain the 30 corners .* degrees apart"):
        camera_poses(one, board, _measurements((1,)), ["c1"])
    assert camera_poses(one, board, _measurements((1,))).views == (None,)
    many = _corners(board, [T] * 12, rng, sigma=0.2)
    poses = camera_poses(many, board, _measurements((12,)), ["c1"])
    assert np.linalg.norm(_error(poses, 0, T)[3:]) < np.deg2rad(2.0)


@pytest.mark.parametrize("shift", [0.001, 0.01])
def test_a_board_that_moved_in_an_image_is_named_with_how_far(shift: float) -> None:
    T = before(CHARUCO, 0.6)
    moved = RigidTransform.from_translation([shift, 0.0, 0.0]) * T
    rng = np.random.default_rng(0)
    corners = _corners(CHARUCO, [T, T, moved, T], rng)
    match = rf"view c1: .* elsewhere in 2.png than in \d.png, by up to {1e3 * shift:.2g}"
    with pytest.raises(DatasetError, match=match.replace("10", r"\d+").replace(" 1", r" [\d.]+")):
        camera_poses(corners, CHARUCO, _measurements((4,)))
    still = _corners(CHARUCO, [T, T, T, T], rng)
    assert camera_poses(still, CHARUCO, _measurements((4,))).views[0] is not None


@pytest.mark.parametrize(
    ("said", "words"),
    [
        (replace(APRILGRID, spacing=0.5), "the numbers of tags and tag_spacing"),
        (replace(APRILGRID, columns=2, rows=3), "the numbers of tags and tag_spacing"),
        (replace(CHARUCO, columns=4, rows=6), "the numbers of squares, marker and square"),
    ],
)
def test_corners_of_another_board_are_refused(said: Board, words: str) -> None:
    true = APRILGRID if said.kind == "aprilgrid" else CHARUCO
    corners = _corners(true, [before(true)], np.random.default_rng(0))
    with pytest.raises(
        DatasetError, match=f"view c1: .* found .*pose of the {said.kind} .*; check {words}"
    ):
        camera_poses(corners, said, _measurements((1,)))


def test_corners_that_no_one_pose_has_before_the_camera_are_refused() -> None:
    """Each image shows one half of the board, and by it the other half is behind the camera."""
    x, y = CHARUCO.points[:, 0], CHARUCO.points[:, 1]
    tables = []
    for row, sign in enumerate((1.0, -1.0)):
        depth = sign * (x - x.mean())
        here = np.flatnonzero(depth > 0.1 * np.ptp(x))
        seen = np.column_stack([y - y.mean(), np.full(len(x), 0.5 * sign * np.ptp(x)), depth])
        px = LENS.project(seen[here])
        tables.append(found_corners(np.full(len(here), row), here, px, np.full(len(here), SIGMA)))
    with pytest.raises(DatasetError, match=r"found no one pose of the charuco .* all its images"):
        camera_poses(join_corners(tables), CHARUCO, _measurements((2,)))


def test_corners_of_another_lens_are_refused() -> None:
    other = replace(LENS, K=LENS.K * np.array([[0.6], [1.0], [1.0]]))
    corners = _corners(CHARUCO, [before(CHARUCO)], np.random.default_rng(0))
    with pytest.raises(DatasetError, match="camera file is of this camera and lens"):
        camera_poses(corners, CHARUCO, _measurements((1,), other))


def test_a_corner_that_contradicts_the_others_is_rejected_and_does_not_bend_the_pose() -> None:
    T = before(CHARUCO, 0.6)
    corners = _corners(CHARUCO, [T], np.random.default_rng(3))
    px = corners.px.copy()
    px[4] += [6.0, -4.0]
    poses = camera_poses(replace(corners, px=px), CHARUCO, _measurements((1,)))
    assert np.flatnonzero(~poses.corners.used).tolist() == [4]
    assert "px from where the other corners put it" in poses.corners.reason[4]
    d = _error(poses, 0, T)
    assert d @ np.linalg.solve(poses.covariance[0], d) / 6.0 < 4.0


def test_turning_the_camera_about_its_axis_turns_the_pose() -> None:
    T = before(CHARUCO, 0.6)
    turned = T * RigidTransform.from_rotation(Rotation.from_euler("z", 0.5))
    rng = np.random.default_rng(0)
    corners = _corners(CHARUCO, [T, turned], rng, sigma=0.0)
    poses = camera_poses(corners, CHARUCO, _measurements((1, 1)))
    assert poses.views[0] is not None
    assert poses.views[1] is not None
    between = poses.views[0].inv() * poses.views[1]
    assert between.rotation.as_rotvec() == pytest.approx([0.0, 0.0, 0.5], abs=1e-7)
    assert between.translation == pytest.approx(np.zeros(3), abs=1e-7)
