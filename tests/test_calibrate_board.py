"""Datasets with a calibration board, calibrated as users do, cameras in the hand among them."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import RigidTransform, Rotation

import legcal
from legcal.calibration.board import BoardViews, base_of_board, board_notes, observe_board
from legcal.calibration.joint_fit.choices import BOARD_SCALE
from legcal.calibration.verdict import Calibration
from legcal.data.corners import found_corners
from legcal.data.measurements import Measurements, View
from legcal.data.rows import Order
from legcal.errors import DatasetError, DidNotConverge, NotVisible
from legcal.machine import geometries, vector_of
from legcal.simulation.request import Level
from legcal.vision.board import Board
from legcal.vision.camera import Camera

Edit = Callable[[dict[str, Any]], None]
HIDDEN = 5  # corners that are moved


@pytest.fixture(scope="module")
def in_the_hand(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset of 3 x 5 images, each from a place of its own, and no place is told."""
    folder = tmp_path_factory.mktemp("board") / "hand"
    settings = legcal.SimulationSettings(
        level=Level.OUTLINES, board="chessboard", hand_held=True, views=3, poses=5, seed=4
    )
    legcal.simulate("hexapod", folder, settings)
    return folder


def changed(dataset: Path, to: Path, edit: Edit) -> Path:
    shutil.copytree(dataset, to)
    path = to / "dataset.yaml"
    document = yaml.safe_load(path.read_text())
    edit(document)
    path.write_text(yaml.safe_dump(document))
    return to


def of_sigma(calibration: Calibration, dataset: Path) -> np.ndarray[Any, Any]:
    """Return the errors of kinematic parameters over their standard deviations."""
    solution = calibration.solution
    truth = legcal.load_mechanism(dataset / "truth/models/hexapod.yaml")
    error = vector_of(solution.parametrization, solution.legs, geometries(truth)) - vector_of(
        solution.parametrization, geometries(truth), geometries(truth)
    )
    sigma = np.sqrt(np.diagonal(solution.value_covariance))
    return np.asarray(error[sigma > 0.0] / sigma[sigma > 0.0])


@pytest.fixture(scope="module")
def of_the_hand(in_the_hand: Path) -> tuple[Calibration, Path]:
    """Return the calibration with those images, and where it was written."""
    output = in_the_hand.parent / "result"
    return legcal.calibrate(in_the_hand, output=output), output


def test_cameras_in_the_hand_need_no_places_of_theirs(
    in_the_hand: Path, of_the_hand: tuple[Calibration, Path]
) -> None:
    calibration, output = of_the_hand
    assert len(calibration.solution.T_camera_Rb) == 15
    assert np.sqrt(np.mean(of_sigma(calibration, in_the_hand) ** 2)) < 1.8
    assert calibration.verdict.trustworthy
    assert abs(calibration.solution.values[BOARD_SCALE] - 1.0) < 2e-3
    assert (output / "corners.csv").is_file()
    result = yaml.safe_load((output / "result.json").read_text())
    assert result["board"]["given"] is None
    assert len(result["views"]) == 15


def test_a_board_joins_views_that_share_no_leg(in_the_hand: Path, tmp_path: Path) -> None:
    """Two legs a view: steps 3 and 4 have too little, yet 1 and 2 place the cameras."""

    def two_legs(document: dict[str, Any]) -> None:
        for view, legs in zip(document["views"].values(), ((1, 2), (3, 4), (5, 6)), strict=True):
            view["legs"] = [f"leg{number}" for number in legs]

    calibration = legcal.calibrate(changed(in_the_hand, tmp_path / "pairs", two_legs))
    assert calibration.steps.legs is None
    assert np.sqrt(np.mean(of_sigma(calibration, in_the_hand) ** 2)) < 2.0


def test_a_place_of_the_board_that_cannot_be_is_told(
    in_the_hand: Path, of_the_hand: tuple[Calibration, Path], tmp_path: Path
) -> None:
    right = of_the_hand[0]
    T_Rb_board = right.solution.T_Rb_board
    assert T_Rb_board is not None
    found = right.dataset.machine.T_base_Rb * T_Rb_board

    def placed(document: dict[str, Any]) -> None:
        document["board"]["T_base_board"] = {
            "xyz": (found.translation + np.array([0.0, 0.0, 0.2])).tolist(),
            "quat_xyzw": found.rotation.as_quat().tolist(),
        }

    calibration = legcal.calibrate(changed(in_the_hand, tmp_path / "placed", placed))
    assert any("stands 200 mm" in note for note in calibration.notes)
    np.testing.assert_allclose(
        calibration.solution.parameters.base_joints,
        right.solution.parameters.base_joints,
        atol=1e-8,
    )
    assert not any("calibration board" in note for note in right.notes)


def test_a_board_and_cameras_that_contradict_each_other_are_refused() -> None:
    shown = (RigidTransform.from_translation([0.0, 0.0, -1.0]), None)
    none = np.zeros(0)
    corners = found_corners(none.astype(np.intp), none.astype(np.intp), np.zeros((0, 2)), none)
    board = BoardViews(Board("chessboard", 7, 6, 0.03), corners, shown, ())
    place = RigidTransform.from_translation([0.3, 0.0, 0.0])
    dataset: Any = SimpleNamespace(T_base_board=place, yaml_path="dataset.yaml")
    camera = RigidTransform.from_translation([0.3, 0.04, -1.0])
    near, far = ((T, None) for T in (camera, camera * camera))
    assert base_of_board(dataset, board, (None, None)) is place
    assert base_of_board(dataset, board, near) is place
    with pytest.raises(DatasetError, match=r"T_base_board and the T_base_camera .* found the boa"):
        base_of_board(dataset, board, far)
    dataset.T_base_board = None
    found = base_of_board(dataset, board, near)
    assert found is not None
    np.testing.assert_allclose(found.translation, [0.3, 0.04, 0.0], atol=1e-12)
    assert base_of_board(dataset, board, (None, camera)) is None


def test_one_wrong_pose_of_a_camera_turns_no_other() -> None:
    shown = (RigidTransform.from_translation([0.0, 0.0, -1.0]),) * 3
    none = np.zeros(0)
    corners = found_corners(none.astype(np.intp), none.astype(np.intp), np.zeros((0, 2)), none)
    board = BoardViews(Board("chessboard", 7, 6, 0.03), corners, shown, ())
    place = RigidTransform.from_translation([0.3, 0.0, 0.0])
    turned = RigidTransform.from_rotation(Rotation.from_euler("z", 90.0, degrees=True))
    hints = (turned * place * shown[0], place * shown[1], place * shown[2])
    dataset: Any = SimpleNamespace(T_base_board=None, yaml_path="dataset.yaml")
    found = base_of_board(dataset, board, hints)
    assert found is not None
    np.testing.assert_allclose(found.as_matrix(), place.as_matrix(), atol=1e-12)
    dataset.T_base_board = place
    assert base_of_board(dataset, board, hints) is place
    assert base_of_board(dataset, board, (*hints[:1], None, *hints[2:])) is place


def test_a_board_of_other_squares_is_refused(in_the_hand: Path, tmp_path: Path) -> None:
    def smaller(document: dict[str, Any]) -> None:
        document["board"]["square"] *= 0.95

    folder = changed(in_the_hand, tmp_path / "smaller", smaller)
    with pytest.raises(DidNotConverge, match=r"is 1\.05\d* times as large"):
        legcal.calibrate(folder)
    free = legcal.calibrate(folder, free=[BOARD_SCALE])
    assert abs(free.solution.values[BOARD_SCALE] - 1.0 / 0.95) < 5e-3


@pytest.fixture(scope="module")
def placed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset of a board and of cameras that have places."""
    folder = tmp_path_factory.mktemp("board") / "placed"
    settings = legcal.SimulationSettings(
        level=Level.OUTLINES, board="charuco", views=2, poses=2, seed=1
    )
    legcal.simulate("hexapod", folder, settings)
    return folder


@pytest.mark.parametrize("rejected", [True, False], ids=["all rejected", "two left"])
def test_a_board_that_no_image_shows_is_refused_where_cameras_have_places(
    placed: Path, tmp_path: Path, rejected: bool
) -> None:
    dataset = changed(placed, tmp_path / "placed", lambda document: None)
    table = dataset / "corners.csv"
    text = table.read_text()
    table.write_text(
        text.replace(",used,", ",rejected,") if rejected else "".join(text.splitlines(True)[:3])
    )
    with pytest.raises(NotVisible, match="found no image with 4 of its corners or more"):
        legcal.calibrate(dataset)


def test_views_that_lost_the_board_are_named() -> None:
    views = [SimpleNamespace(name=name) for name in ("c1", "c2", "c3")]
    dataset: Any = SimpleNamespace(
        measurements=SimpleNamespace(views=views, view=np.array([0, 1, 1])), T_base_board=None
    )
    corner = np.zeros(2, dtype=np.intp)
    corners = found_corners(np.array([0, 1]), corner, np.zeros((2, 2)), np.ones(2))
    solution: Any = SimpleNamespace(T_Rb_board=None)
    assert board_notes(dataset, solution, corners) == []
    assert board_notes(dataset, solution, None) == []
    lost = replace(corners, used=np.array([True, False]))
    (note,) = board_notes(dataset, solution, lost)
    assert note.startswith("No image of c2 shows the calibration board")


def test_only_views_in_the_hand_need_the_board() -> None:
    board = Board("chessboard", 7, 6, 0.03)
    rows = np.arange(2, dtype=np.intp)
    K = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
    camera = View("c1", Camera(K, 640, 480))
    tilt = RigidTransform.from_components([-0.05, -0.04, 0.6], Rotation.from_rotvec([0.5, 0.2, 0]))
    px = camera.camera.project(tilt.apply(board.points))
    n = board.n_corners
    corners = found_corners(np.zeros(n, dtype=np.intp), np.arange(n), px, np.full(n, 0.05))
    views = (camera, replace(camera, name="c2"))
    m = Measurements(views, ("a.png", "b.png"), rows, rows, np.zeros((2, 1)), 1e-6)
    order = Order(rows=rows, legs=rows[:1], views=rows)
    dataset = SimpleNamespace(board=board, corners=corners, yaml_path="dataset.yaml")
    work: Any = SimpleNamespace(dataset=dataset, measurements=m, order=order)
    found = observe_board(work)
    assert found is not None
    assert found.T_board_camera[0] is not None
    assert found.T_board_camera[1] is None
    work.measurements = replace(m, views=(camera, replace(views[1], hand_held=True)))
    with pytest.raises(NotVisible, match="view c2"):
        observe_board(work)
