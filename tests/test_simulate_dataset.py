"""Simulated datasets: whole, reproducible, of the spread that they claim, with the truth beside."""

import json
from pathlib import Path

import numpy as np
import pytest
from simulated import files_of, settings, small_camera

import legcal
from legcal.data.dataset import load_dataset
from legcal.data.outlines import read_observations
from legcal.simulation.dataset import SimulatedDataset, simulate
from legcal.simulation.request import Level
from legcal.simulation.settings import ParameterErrors, Spread


@pytest.fixture(scope="module")
def outlines(tmp_path_factory: pytest.TempPathFactory) -> SimulatedDataset:
    folder = tmp_path_factory.mktemp("simulated") / "outlines"
    return simulate("hexapod", folder, settings(poses=8, views=3))


def test_a_simulated_dataset_loads_with_the_nominal_model(outlines: SimulatedDataset) -> None:
    dataset = load_dataset(outlines.folder)
    assert dataset.measurements.n_rows == 24
    assert dataset.measurements.n_poses == 24
    nominal = legcal.load_mechanism("hexapod")
    assert np.array_equal(dataset.machine.A_base, nominal.A_base)
    assert dataset.machine.yaml_path.is_relative_to(outlines.folder)


def test_calibration_comes_much_nearer_to_the_truth(
    outlines: SimulatedDataset, tmp_path: Path
) -> None:
    legcal.calibrate(outlines.folder, output=tmp_path / "result")
    truth = outlines.truth_path
    before = legcal.evaluate(outlines.nominal.yaml_path, truth)
    after = legcal.evaluate(tmp_path / "result" / "calibrated.yaml", truth)
    assert before.displacement.mean() > 1e-3
    assert after.displacement.mean() < 0.03 * before.displacement.mean()


def test_axes_with_the_noise_of_table_1_calibrate_too(tmp_path: Path) -> None:
    made = simulate("hexapod", tmp_path / "axes", settings(level=Level.AXES, poses=5, views=3))
    legcal.calibrate(made.folder, output=tmp_path / "result")
    before = legcal.evaluate(made.nominal.yaml_path, made.truth_path)
    after = legcal.evaluate(tmp_path / "result" / "calibrated.yaml", made.truth_path)
    assert after.displacement.mean() < 0.3 * before.displacement.mean()


def test_outlines_scatter_about_the_true_ones_as_their_covariance_says(
    outlines: SimulatedDataset,
) -> None:
    dataset = load_dataset(outlines.folder)
    m = dataset.measurements
    exact = read_observations(outlines.folder / "truth" / "outlines.csv", dataset.machine.legs, m)
    found = dataset.observations
    assert found is not None
    assert (found.row.tolist(), found.leg.tolist()) == (exact.row.tolist(), exact.leg.tolist())
    camera = m.views[0].camera
    offset = camera.line_offset(found.h[:, None], camera.undistort(exact.ends))
    whitened = np.linalg.solve(np.linalg.cholesky(found.covariance), offset[..., None])[..., 0]
    assert len(offset) > 200
    assert np.cov(whitened.T) == pytest.approx(np.eye(2), abs=0.25)
    assert np.abs(whitened.mean(axis=0)).max() < 0.2
    assert whitened[exact.edge == 1].mean() == pytest.approx(0.0, abs=0.25)  # per side


def test_true_parameters_differ_by_no_more_than_was_asked(outlines: SimulatedDataset) -> None:
    difference = np.concatenate(
        [
            (getattr(outlines.truth.parameters, name) - getattr(outlines.nominal.parameters, name))
            for name in ("base_joints", "platform_joints")
        ]
    )
    assert 1e-3 < np.abs(difference).max() <= 2e-3 + 1e-12


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(tmp_path: Path) -> None:
    a, b, c = (
        simulate("hexapod", tmp_path / name, settings(seed=seed, poses=1, views=1)).folder
        for name, seed in (("a", 7), ("b", 7), ("c", 8))
    )
    assert files_of(a) == files_of(b)
    assert files_of(a)["measurements.csv"] != files_of(c)["measurements.csv"]


def test_two_levels_with_one_seed_show_one_machine_in_the_same_poses(tmp_path: Path) -> None:
    one = simulate("hexapod", tmp_path / "one", settings(poses=1, views=1))
    two = simulate("hexapod", tmp_path / "two", settings(level=Level.AXES, poses=1, views=1))
    same = ("measurements.csv", "truth/urdf/hexapod.urdf", "truth/outlines.csv", "camera_info.yaml")
    for name in same:
        assert files_of(one.folder)[name] == files_of(two.folder)[name]
    assert not (two.folder / "observations.csv").exists()


def test_photographs_do_not_depend_on_the_number_of_processes(tmp_path: Path) -> None:
    few = settings(
        level=Level.PHOTOGRAPHS, poses=2, views=1, images=2, camera=small_camera(tmp_path)
    )
    one = simulate("3-rps", tmp_path / "one", few)
    two = simulate("3-rps", tmp_path / "two", few, workers=2)
    assert files_of(one.folder) == files_of(two.folder)
    images = [x for name, x in files_of(one.folder).items() if name.endswith(".png")]
    assert len(set(images)) == 4  # repeated images differ by the noise of the sensor


def test_shared_poses_are_labelled_alike_in_all_views(tmp_path: Path) -> None:
    made = simulate("hexapod", tmp_path / "set", settings(shared_poses=True, images=2, poses=2))
    m = load_dataset(made.folder).measurements
    assert (m.n_rows, m.n_poses) == (8, 2)
    assert m.pose_labels == ("p01", "p02")
    assert m.pose.tolist() == [0, 0, 1, 1] * 2


def test_hints_are_rough_and_can_be_left_out(tmp_path: Path) -> None:
    told = load_dataset(simulate("hexapod", tmp_path / "a", settings(poses=1, views=1)).folder)
    truth = json.loads((tmp_path / "a" / "truth" / "truth.json").read_text())
    for view in told.measurements.views:
        assert view.T_base_camera is not None
        true = np.array(truth["views"][view.name]["T_base_camera"]["xyz"])
        off = np.linalg.norm(view.T_base_camera.translation - true)
        assert 1e-5 < off < 0.0151
    silent = load_dataset(
        simulate("hexapod", tmp_path / "b", settings(hints=False, poses=1, views=1)).folder
    )
    assert all(v.T_base_camera is None and v.legs is None for v in silent.measurements.views)


def test_without_errors_and_noise_readings_and_outlines_are_those_of_the_model(
    tmp_path: Path,
) -> None:
    made = simulate(
        "hexapod",
        tmp_path / "set",
        settings(errors=ParameterErrors(), sigma_px=0.0, readings=Spread(), poses=2, views=1),
    )
    m = made.measurements
    truth = json.loads((made.folder / "truth" / "truth.json").read_text())
    for label, row in zip(m.pose_labels, m.q, strict=True):
        assert list(truth["poses"][label]["joints"].values()) == pytest.approx(row, abs=1e-15)
    given = files_of(made.folder)
    assert given["observations.csv"] == given["truth/outlines.csv"]
    assert np.array_equal(made.truth.A_base, made.nominal.A_base)


def test_uniform_noise_of_readings_stays_in_its_limits(tmp_path: Path) -> None:
    from legcal.simulation.settings import Distribution

    wide = Spread(1e-4, Distribution.UNIFORM)
    made = simulate("hexapod", tmp_path / "set", settings(readings=wide, poses=6, views=1))
    truth = json.loads((made.folder / "truth" / "truth.json").read_text())
    true = np.array([list(p["joints"].values()) for p in truth["poses"].values()])
    error = made.measurements.q - true
    assert 0.7e-4 < np.abs(error).max() <= 1e-4
    assert made.measurements.sigma_q == pytest.approx(1e-4 / np.sqrt(3.0))


def test_given_cameras_and_lenses_are_used(tmp_path: Path) -> None:
    (tmp_path / "cameras.yaml").write_text(
        "views:\n"
        "  left: {camera: small.yaml, T_base_camera: {xyz: [0.93, 0.26, 0.19], "
        "quat_xyzw: [0.41111, 0.57416, -0.55209, -0.44331]}}\n"
        "  right: {T_base_camera: {xyz: [0.94, 0.26, 0.20], "
        "quat_xyzw: [0.41111, 0.57416, -0.55209, -0.44331]}}\n"
    )
    small_camera(tmp_path)
    made = simulate("hexapod", tmp_path / "set", settings(views=tmp_path / "cameras.yaml", poses=1))
    left, right = load_dataset(made.folder).measurements.views
    assert (left.name, left.camera.width, right.name, right.camera.width) == (
        "left", 200, "right", 1024,
    )  # fmt: skip


def test_given_poses_are_seen_by_all_views_at_their_readings(tmp_path: Path) -> None:
    rows = ["0.06,0.06,0.06,0.06,0.06,0.06", "0.07,0.06,0.05,0.06,0.08,0.06"]
    header = ",".join(f"leg{j}_prismatic" for j in range(1, 7))
    (tmp_path / "poses.csv").write_text("\n".join([header, *rows]) + "\n")
    exact = settings(poses=tmp_path / "poses.csv", readings=Spread(), level=Level.AXES)
    m = load_dataset(simulate("hexapod", tmp_path / "set", exact).folder).measurements
    given = np.array([[float(x) for x in row.split(",")] for row in rows])
    assert m.pose.tolist() == [0, 1, 0, 1]
    assert m.q == pytest.approx(given[m.pose], abs=1e-12)
