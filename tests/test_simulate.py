"""Simulated datasets and boards: of the spread that they claim, reproducible, whole or not there.

What options of the command give and how wrong ones are refused is in tests/refusal_table.py.
"""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from boards import CHARUCO
from simulated import files_of, settings, simulated, small_camera

import legcal
from legcal import (
    Dataset,
    Machine,
    ParameterErrors,
    SimulationSettings,
    Spread,
    Viewpoint,
    load_dataset,
    load_mechanism,
    simulate,
)
from legcal.data.outlines import read_observations
from legcal.errors import NotVisible, UsageError
from legcal.files.motions import motion_from_xyz_quat
from legcal.geometry.types import Array
from legcal.machine.parameters import geometries
from legcal.perception.board_adjustment import camera_poses_by_board
from legcal.perception.board_corners import certain_corners, search_board
from legcal.simulation.cameras import mild_lens
from legcal.simulation.dataset import TRUTH_NAME, SimulatedDataset
from legcal.simulation.observe import OutlineNoise
from legcal.simulation.settings import Distribution, Level, requested
from legcal.vision.board import parse_board
from legcal.vision.camera import Camera
from legcal.vision.camera_file import camera_info

FEW = settings(poses=1, views=1)


def truth_of(folder: Path) -> dict[str, Any]:
    return dict(json.loads((folder / TRUTH_NAME).read_text()))


# --- what is measured


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> SimulatedDataset:
    folder = tmp_path_factory.mktemp("simulated") / "outlines"
    wide = Spread(1e-4, Distribution.UNIFORM)
    return simulated(folder, "hexapod", poses=8, views=3, readings=wide)


def test_the_dataset_has_the_nominal_model_and_the_truth_beside_it(made: SimulatedDataset) -> None:
    dataset = load_dataset(made.folder)
    assert (dataset.measurements.n_rows, dataset.measurements.n_poses) == (24, 24)
    assert np.array_equal(dataset.machine.A_base, load_mechanism("hexapod").A_base)
    assert dataset.machine.yaml_path.is_relative_to(made.folder)
    for end in ("A", "B"):
        true, nominal = (
            np.array([getattr(leg, end) for leg in geometries(machine)])
            for machine in (made.truth, made.nominal)
        )
        assert 1e-3 < np.abs(true - nominal).max() <= 2e-3 + 1e-12


def test_outlines_scatter_about_the_true_ones_as_their_covariance_says(
    made: SimulatedDataset,
) -> None:
    dataset = load_dataset(made.folder)
    m, found = dataset.measurements, dataset.observations
    exact = read_observations(made.folder / "truth" / "outlines.csv", dataset.machine.legs, m)
    assert found is not None
    assert (found.row.tolist(), found.leg.tolist()) == (exact.row.tolist(), exact.leg.tolist())
    camera = m.views[0].camera
    offset = camera.line_offset(found.h[:, None], camera.undistort(exact.ends))
    whitened = np.linalg.solve(np.linalg.cholesky(found.covariance), offset[..., None])[..., 0]
    assert len(offset) > 200
    assert np.cov(whitened.T) == pytest.approx(np.eye(2), abs=0.25)
    assert np.abs(whitened.mean(axis=0)).max() < 0.2
    assert whitened[exact.edge == 1].mean() == pytest.approx(0.0, abs=0.25)  # per side


def test_readings_scatter_and_camera_poses_are_rough_as_they_claim(made: SimulatedDataset) -> None:
    m, truth = load_dataset(made.folder).measurements, truth_of(made.folder)
    true = np.array([list(truth["poses"][label]["joints"].values()) for label in m.pose_labels])
    error = m.q - true[m.pose]
    assert 0.7e-4 < np.abs(error).max() <= 1e-4
    assert error.std() == pytest.approx(m.sigma_q[0], rel=0.15)
    assert m.sigma_q == pytest.approx(1e-4 / np.sqrt(3.0))
    for view in m.views:
        assert view.T_base_camera is not None
        there = np.array(truth["views"][view.name]["T_base_camera"]["xyz"])
        assert 1e-5 < np.linalg.norm(view.T_base_camera.translation - there) < 0.0151


def test_without_errors_and_noise_the_dataset_is_that_of_the_model(tmp_path: Path) -> None:
    exact = settings(
        errors=ParameterErrors(), sigma_px=0.0, readings=Spread(), poses=2, views=2, images=2,
        shared_poses=True, hints=False,
    )  # fmt: skip
    made = simulate("hexapod", tmp_path / "set", exact)
    m, truth = load_dataset(made.folder).measurements, truth_of(made.folder)
    assert (m.n_rows, m.pose_labels) == (8, ("p01", "p02"))
    assert m.pose.tolist() == [0, 0, 1, 1] * 2  # two images of each pose, seen by all views
    for label, q in zip(m.pose_labels, m.q_of_poses, strict=True):
        assert list(truth["poses"][label]["joints"].values()) == pytest.approx(q, abs=1e-12)
    assert all(view.T_base_camera is None and view.legs is None for view in m.views)
    given = files_of(made.folder)
    assert given["observations.csv"] == given["truth/outlines.csv"]
    assert np.array_equal(made.truth.A_base, made.nominal.A_base)


def test_the_seed_and_nothing_else_decides_what_is_drawn(tmp_path: Path) -> None:
    def files(name: str, **changes: object) -> dict[str, bytes]:
        few = replace(FEW, **changes)  # type: ignore[arg-type]
        return files_of(simulate("hexapod", tmp_path / name, few).folder)

    one, again, other = files("a", seed=7), files("b", seed=7), files("c", seed=8)
    assert one == again
    assert one["measurements.csv"] != other["measurements.csv"]
    exact = files("d", seed=7, sigma_px=0.0)
    for name in ("measurements.csv", "truth/urdf/hexapod.urdf", "truth/outlines.csv"):
        assert one[name] == exact[name]
    assert one["observations.csv"] != exact["observations.csv"]


def test_photographs_are_those_of_the_kind_of_camera_and_its_file(tmp_path: Path) -> None:
    nominal, lens = load_mechanism("3-rps"), small_camera(tmp_path)
    found = requested(nominal, camera=["webcam:60", str(lens)], poses="1")
    look = found.appearance
    assert (look.camera, look.jpeg, look.colour, found.camera) == ("webcam", 60, True, lens)
    made = simulate("3-rps", tmp_path / "made", replace(found, views=1))
    dataset = load_dataset(made.folder)
    (name,) = dataset.measurements.image
    assert name.endswith(".jpg")
    assert dataset.image_reader([0])(0).shape == (150, 200)


def _few_photographs(folder: Path, workers: int) -> SimulatedDataset:
    """Photograph one pose twice."""
    look = legcal.Appearance(gamma=1.8, clutter=0, samples=13)
    few = settings(
        level=Level.PHOTOGRAPHS, poses=1, views=1, images=2, camera=small_camera(folder),
        appearance=look,
    )  # fmt: skip
    return simulate("3-rps", folder / str(workers), few, workers=workers)


@pytest.mark.system
def test_photographs_do_not_depend_on_the_number_of_processes(tmp_path: Path) -> None:
    one, two = (files_of(_few_photographs(tmp_path, n).folder) for n in (1, 2))
    assert one == two


def test_repeated_photographs_differ_by_the_noise_of_the_sensor(tmp_path: Path) -> None:
    one = _few_photographs(tmp_path, 1)
    images = [x for name, x in files_of(one.folder).items() if name.endswith(".png")]
    assert len(set(images)) == 2
    (view,) = load_dataset(one.folder).measurements.views
    assert (view.camera.gamma, view.camera.gamma_is_given) == (1.8, True)


def test_the_covariance_of_an_outline_is_that_of_a_line_fitted_to_white_points() -> None:
    noise = OutlineNoise(sigma_px=0.2, n_points=50)
    rng = np.random.default_rng(0)
    t = np.linspace(0.0, 1.0, 50)
    fits = np.polyfit(t, rng.normal(scale=0.2, size=(50, 20000)), 1)
    ends = np.stack([fits[1], fits[0] + fits[1]])
    assert np.allclose(np.cov(ends), noise.covariance(0.0), rtol=0.1, atol=2e-4)


# --- settings


FROM_THE_SIDE = motion_from_xyz_quat((0.93, 0.26, 0.19), (0.411, 0.574, -0.552, -0.443))
VIEW = Viewpoint("side", mild_lens(), FROM_THE_SIDE)  # of a hexapod


def test_options_become_settings(tmp_path: Path) -> None:
    lens = small_camera(tmp_path)
    joints = Spread(1e-3, Distribution.NORMAL)
    errors = ParameterErrors(base_joints=joints, platform_joints=joints, radii=Spread(1e-4))
    found = requested(
        load_mechanism("hexapod"), level="outlines", camera=[str(lens)], poses="7",
        error=["none", "radii=0.1mm", "joints=1mm:normal"], board="charuco", hand_held=True, seed=4,
    )  # fmt: skip
    assert found == SimulationSettings(
        level=Level.OUTLINES, camera=lens, poses=7, errors=errors, board="charuco", hand_held=True,
        seed=4,
    )  # fmt: skip
    assert requested(load_mechanism("hexapod"), poses=str(lens)).poses == lens


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"sigma_px": -0.1}, "-0.1 as the noise of edge points, needed 0 to 100 px"),
        ({"sigma_px": "0.1px"}, "sigma_px, needed a number"),
        ({"errors": ParameterErrors(axes=0.1)}, "errors.axes"),  # type: ignore[arg-type]
        ({"level": "pictures"}, "level 'pictures', needed outlines or photographs"),
        ({"poses": 10**9}, "poses, needed 1 to 100000"),
        ({"seed": -1}, "seed, needed 0 or more"),
        ({"poses": 1000, "views": 100, "images": 2}, "200000 images"),
        ({"board": "charuco", "hand_held": True, "images": 2}, "2 images of each pose"),
        ({"board": "charuco", "hand_held": True, "views": [VIEW]}, "cameras that stand already"),
        ({"platform_board": "charuco", "plan": "session"}, "cameras that stand already"),
        ({"board_pose": True}, "the pose of a board without a board"),
        ({"views": "cameras.yaml"}, "views, needed a whole number or Viewpoints"),
        ({"views": [VIEW, VIEW]}, "views named 'side', 'side', needed different names"),
        ({"views": [replace(VIEW, name="../side")]}, "views named '../side'"),
    ],
)
def test_settings_without_sense_are_refused(changes: dict[str, object], named: str) -> None:
    with pytest.raises(UsageError, match=f"The dataset could not be simulated: found .*{named}"):
        settings(**changes)


@pytest.mark.parametrize(
    ("size", "distribution"),
    [
        ("2mm", "uniform"), (1e-3, "flat"), (-1e-6, "normal"), (2.0, "normal"),
        (float("nan"), "uniform"), (float("inf"), "uniform"),
    ],
)  # fmt: skip
def test_spreads_without_sense_are_refused(size: Any, distribution: Any) -> None:
    with pytest.raises(UsageError, match=r"found the size .* and the distribution"):
        Spread(size, distribution)


@pytest.mark.parametrize(
    ("model", "changes", "named"),
    [
        ("hexapod", {"readings": Spread(1.0)}, "readings .* needed .* 29.6 mm"),
        ("delta", {"lengths": {"leg1.base:leg2.platform": 5e-5}}, "length 'leg1.base:leg2.platfo"),
        ("hexapod", {"views": [replace(VIEW, legs=("leg7",))]}, "view side: .* found leg7, which"),
    ],
)
def test_settings_without_sense_for_a_machine_are_refused(
    model: str, changes: dict[str, object], named: str, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match=named):
        simulate(model, tmp_path / "set", settings(poses=1, **changes))
    assert files_of(tmp_path) == {}


# --- the folder


@pytest.mark.parametrize(
    ("there", "name", "named"),
    [
        ("dataset.yaml", "", "found a folder with files, needed a new or empty folder"),
        (TRUTH_NAME, "", "found an earlier dataset, needed .* remove that one"),
        ("file", "file", "found a file of that name"),
        ("file", "file/sub", "file is a file"),
        ("file", "n" * 300, "'File name too long'"),
    ],
)
def test_what_is_there_is_never_touched(there: str, name: str, named: str, tmp_path: Path) -> None:
    (tmp_path / there).parent.mkdir(exist_ok=True)
    (tmp_path / there).write_text('{"legcal_truth": 1}')
    files = files_of(tmp_path)
    with pytest.raises(UsageError, match=named):
        simulate("hexapod", tmp_path / name, FEW)
    assert files_of(tmp_path) == files


@pytest.mark.parametrize(
    ("xyz", "quat_xyzw", "refused", "named"),
    [
        ((1.5, 0.0, 0.2), (0.5, 0.5, 0.5, 0.5), NotVisible, "view c1: .* no image shows a leg"),
        ((90.0, 0.0, 0.2), (-0.5, -0.5, 0.5, 0.5), NotVisible, "view c1: .* px long in them"),
        ((0.0, 0.0, 0.2), (0.0, 0.0, 0.0, 1.0), UsageError, "view c1: .* inside the machine"),
    ],
)
def test_cameras_that_show_nothing_are_refused_and_nothing_is_written(
    xyz: Any, quat_xyzw: Any, refused: type[Exception], named: str, tmp_path: Path
) -> None:
    view = Viewpoint("c1", mild_lens(), motion_from_xyz_quat(xyz, quat_xyzw))
    with pytest.raises(refused, match=named):
        simulate("hexapod", tmp_path / "set", settings(views=[view]))
    assert files_of(tmp_path) == {}


def test_a_fisheye_that_sees_everything_before_it_stands_where_legs_are_long(
    tmp_path: Path,
) -> None:
    K = np.array([[480.0, 0.0, 600.0], [0.0, 480.0, 450.0], [0.0, 0.0, 1.0]])
    lens = tmp_path / "fisheye.yaml"  # its corners look 90 deg aside
    lens.write_text(camera_info(Camera(K, 1200, 900, np.zeros(4), model="equidistant"), "fisheye"))
    made = simulate("hexapod", tmp_path / "set", settings(poses=2, camera=lens))
    assert made.seen.all()


# Boards


@cache
def machine() -> Machine:
    return load_mechanism("3-rps")


def _with_board(folder: Path, **settings: Any) -> Path:
    simulate(machine(), folder, SimulationSettings(level=Level.OUTLINES, views=1, **settings))
    return folder


def _exact_corners(dataset: Dataset) -> Array:
    """Return where the first view sees the corners of the board by the truth, (n_corners, 2)."""
    truth = truth_of(dataset.folder)
    T_base_board = parse_board(truth["board"], dataset.folder).T_link_board
    assert T_base_board is not None
    T = motion_from_xyz_quat(**truth["views"]["c1"]["T_base_camera"]).inv() * T_base_board
    points = dataset.boards[0].board.points
    return dataset.measurements.views[0].camera.project(T.apply(points))


def test_corners_are_off_by_as_much_as_they_claim(tmp_path: Path) -> None:
    folder = _with_board(tmp_path / "set", poses=2, board="charuco", board_pose=True, seed=3)
    dataset = load_dataset(folder)
    corners, (fixed,) = dataset.corners, dataset.boards
    assert corners is not None
    exact = _exact_corners(dataset)
    assert len(corners) >= 2 * 0.5 * len(exact)
    assert np.std(corners.px - exact[corners.corner]) == pytest.approx(0.1, rel=0.3)
    T_base_board = parse_board(truth_of(folder)["board"], folder).T_link_board
    assert fixed.T_link_board is not None
    assert T_base_board is not None
    np.testing.assert_allclose(fixed.T_link_board.as_matrix(), T_base_board.as_matrix(), atol=1e-9)
    assert np.all(corners.sigma_px == 0.1)


def test_every_hand_held_image_has_its_own_place_and_the_board_gives_it(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    _with_board(folder, poses=3, board="aprilgrid", hand_held=True, sigma_px=0.0)
    dataset = load_dataset(folder)
    m = dataset.measurements
    assert dataset.corners is not None
    assert [view.name for view in m.views] == [f"c1-{k + 1}" for k in range(m.n_rows)]
    poses, _ = camera_poses_by_board(
        dataset.corners, dataset.boards[0].board, m, [view.name for view in m.views]
    )
    truth = truth_of(folder)
    T_base_board = parse_board(truth["board"], folder).T_link_board
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
    number, px, sigma = certain_corners(board, search_board(board, dataset.image_reader([0])(0)))
    error = px - _exact_corners(dataset)[number]
    assert len(number) >= 20
    assert np.sqrt(np.mean(error**2)) < 0.04
    assert np.sqrt(np.mean((error / sigma[:, None]) ** 2)) < 2.0


def test_a_board_without_a_place_is_refused(tmp_path: Path) -> None:
    settings = SimulationSettings(
        level=Level.OUTLINES, poses=1, views=1, board=replace(CHARUCO, side=1.0, marker=0.7)
    )
    with pytest.raises(NotVisible, match="The board could not be placed: found no place near the"):
        simulate(machine(), tmp_path / "none", settings)
