"""Boards in simulated datasets: where they stand, what images show of them, and what is refused."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from boards import CHARUCO
from simulated import small_camera

from legcal.data.dataset import load_dataset
from legcal.errors import NotVisible
from legcal.files.motions import motion_from_xyz_quat
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.perception.board_adjustment import camera_poses_by_board
from legcal.perception.board_corners import find_corners
from legcal.simulation.dataset import simulate
from legcal.simulation.settings import Level, SimulationSettings
from legcal.vision.board import parse_board


@cache
def machine() -> Machine:
    return load_mechanism("3-rps")


def _truth(folder: Path) -> dict[str, Any]:
    return dict(json.loads((folder / "truth" / "truth.json").read_text()))


@pytest.fixture(scope="module")
def standing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("board") / "standing"
    settings = SimulationSettings(
        level=Level.OUTLINES, poses=2, views=1, board="charuco", board_pose=True, seed=3
    )
    simulate(machine(), folder, settings)
    return folder


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("board") / "held"
    settings = SimulationSettings(
        level=Level.OUTLINES, poses=3, views=1, board="aprilgrid", hand_held=True, sigma_px=0.0
    )
    simulate(machine(), folder, settings)
    return folder


def test_corners_are_off_by_as_much_as_they_claim(standing: Path) -> None:
    dataset = load_dataset(standing)
    corners, (fixed,) = dataset.corners, dataset.boards
    board, T_base_board = fixed.board, fixed.T_link_board
    assert corners is not None
    assert T_base_board is not None
    view = dataset.measurements.views[0]
    truth = _truth(standing)["views"]["c1"]["T_base_camera"]
    T = motion_from_xyz_quat(**truth).inv() * T_base_board
    exact = view.camera.project(T.apply(board.points))[corners.corner]
    assert len(corners) >= 2 * 0.5 * board.n_corners
    assert np.std(corners.px - exact) == pytest.approx(0.1, rel=0.3)
    assert np.all(corners.sigma_px == 0.1)


def test_every_hand_held_image_has_its_own_place_and_the_board_gives_it(held: Path) -> None:
    dataset = load_dataset(held)
    m = dataset.measurements
    assert dataset.corners is not None
    assert [view.name for view in m.views] == [f"c1-{k + 1}" for k in range(m.n_rows)]
    poses, _ = camera_poses_by_board(
        dataset.corners, dataset.boards[0].board, m, [view.name for view in m.views]
    )
    truth = _truth(held)
    T_base_board = parse_board(truth["board"], held).T_link_board
    assert T_base_board is not None
    places = []
    for view, T_board_camera in zip(m.views, poses, strict=True):
        assert T_board_camera is not None
        there = motion_from_xyz_quat(**truth["views"][view.name]["T_base_camera"])
        assert (T_base_board * T_board_camera).translation == pytest.approx(
            there.translation, abs=1e-7
        )
        places.append(there.translation)
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).min() > 0.05


def test_photographs_show_the_board_where_it_is(tmp_path: Path) -> None:
    camera = small_camera(tmp_path, 640, 480)
    settings = SimulationSettings(poses=1, views=1, board="aprilgrid", seed=3, camera=camera)
    simulate(machine(), tmp_path / "seen", settings)
    dataset = load_dataset(tmp_path / "seen")
    assert dataset.corners is None
    board = dataset.boards[0].board
    number, px, sigma = find_corners(board, dataset.image_reader([0])(0))
    truth = _truth(tmp_path / "seen")
    T_base_board = parse_board(truth["board"], tmp_path).T_link_board
    assert T_base_board is not None
    T = motion_from_xyz_quat(**truth["views"]["c1"]["T_base_camera"]).inv() * T_base_board
    exact = dataset.measurements.views[0].camera.project(T.apply(board.points))
    error = px - exact[number]
    assert len(number) >= 20
    assert np.sqrt(np.mean(error**2)) < 0.04
    assert np.sqrt(np.mean((error / sigma[:, None]) ** 2)) < 2.0


def test_a_board_without_a_place_is_refused(tmp_path: Path) -> None:
    settings = SimulationSettings(
        level=Level.OUTLINES, poses=1, views=1, board=replace(CHARUCO, side=1.0, marker=0.7)
    )
    with pytest.raises(NotVisible, match="The board could not be placed: found no place near the"):
        simulate(machine(), tmp_path / "none", settings)
