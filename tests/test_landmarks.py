"""Clicks on joints place cameras: of every kind of machine, before recognition begins."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from clicked_joints import camera_beside, seen_from, write_clicks
from csv_rows import read_rows, write_rows
from dataset_folder import dataset_of_readings
from edits import GONE, cell, keyed
from machines import ROOT, by_hand
from scipy.spatial.transform import RigidTransform
from simulated import simulated

from legcal import Calibration, calibrate, load_dataset, load_mechanism
from legcal.calibration.doubts import click_notes
from legcal.calibration.result import Verdict
from legcal.calibration.verdict import judge
from legcal.data.landmarks import Landmarks, joint_name
from legcal.geometry.motions import components, pose_distance
from legcal.machine.model import readings_at
from legcal.machine.rods import ends_at_poses

pytestmark = pytest.mark.usefixtures("without_steps")


def dataset(folder: Path, model: str, n_rows: int = 2, **view: object) -> Path:
    """Write a dataset of one view of a machine, at home and near it."""
    machine = load_mechanism(model)
    home = readings_at(machine, machine.home)[list(machine.motors)]
    travel = np.array([machine.legs[j].travel for j in machine.motors])
    width = np.where(np.isfinite(np.ptp(travel, axis=1)), np.ptp(travel, axis=1), 0.1)
    away = np.random.default_rng(3).uniform(-0.05, 0.05, (n_rows, len(home)))
    q = home + width * away
    camera = str(ROOT / "examples/hexapod/camera_info.yaml")
    sigma = {name: "0.1deg" if machine.legs[j].reads_angle else 1e-5
             for name, j in zip(machine.motor_names, machine.motors, strict=True)}  # fmt: skip
    entry = {"views": {"c1": {"camera": camera, **view}}, "encoder_sigma": sigma}
    return dataset_of_readings(folder, q, entry, model, machine.motor_names)


def off(folder: Path, true: RigidTransform) -> tuple[float, float]:
    """Return how far the rough pose of the first view is from the truth [m], [rad]."""
    placed = load_dataset(folder, check_images=False).measurements.views[0].T_base_camera
    assert placed is not None
    return pose_distance(placed, true)


def test_clicks_place_the_camera(tmp_path: Path) -> None:
    folder = dataset(tmp_path, "delta")
    true = camera_beside(folder, 0.7)
    write_clicks(folder, {1: seen_from(folder, 1, true)})
    far, turned = off(folder, true)
    assert far < 1e-5
    assert turned < 1e-5


def test_noise_of_clicks_leaves_a_rough_pose_that_wins(tmp_path: Path) -> None:
    rough = {"xyz": [0.0, 3.0, 0.3], "quat_xyzw": [0.0, 0.0, 0.0, 1.0]}
    folder = dataset(tmp_path, "hexapod", T_base_camera=rough)
    true, rng = camera_beside(folder, 1.5), np.random.default_rng(1)
    clicks = {
        row: {joint: px + 3.0 * rng.normal(size=2) for joint, px in seen.items()}
        for row in range(2)
        if (seen := seen_from(folder, row, true))
    }
    write_clicks(folder, clicks)
    far, turned = off(folder, true)
    assert load_dataset(folder, check_images=False).measurements.views[0].is_placed
    assert 0.0 < far < 0.03
    assert turned < np.deg2rad(2.0)


@pytest.mark.parametrize("unknown", ["no motors", "three empty"])
def test_base_joints_place_the_camera_where_readings_give_no_pose(
    unknown: str, tmp_path: Path
) -> None:
    folder = dataset(tmp_path, "hexapod")
    true = camera_beside(folder, 0.7)
    seen = seen_from(folder, 0, true)
    table, joints = folder / "measurements.csv", [f"leg{j}_prismatic" for j in range(1, 7)]
    if unknown == "no motors":
        model = str(by_hand(tmp_path / "own"))
        table.write_text("view,image\nc1,0.png\n")
        keyed("dataset.yaml", mechanism=model, encoder_sigma=GONE)(folder)
    else:
        cell("measurements.csv", None, **dict.fromkeys(joints[3:], ""))(folder)
        write_rows(table, [row | {"time": 1} for row in read_rows(table)])
    write_clicks(folder, {0: {j: px for j, px in seen.items() if j.endswith(".base")}})
    far, turned = off(folder, true)
    assert far < 1e-5
    assert turned < 1e-5
    loaded = load_dataset(folder, check_images=False)
    assert not loaded.machine.is_determined
    assert any("leg4_prismatic" in note for note in loaded.notes) == (unknown != "no motors")


@pytest.fixture(scope="module")
def planar(tmp_path_factory: pytest.TempPathFactory) -> Calibration:
    """The calibration of a planar machine in three views."""
    folder = tmp_path_factory.mktemp("planar") / "set"
    return calibrate(simulated(folder, "3-rpr", views=3, poses=6).folder)


def clicks_in(calibration: Calibration, rows: list[int], noise: float) -> Landmarks:
    """Return clicks on all joints in some images, as the fit has them but for noise [px]."""
    m, solution = calibration.dataset.measurements, calibration.solution
    row, leg, end = (x.ravel() for x in np.meshgrid(rows, range(3), (0, 1), indexing="ij"))
    A, B = ends_at_poses(solution.legs, *components(solution.T_Rb_Re))
    seen = [
        solution.cameras[v].project(solution.T_camera_Rb[v].apply(P))
        for v, P in zip(m.view[row], np.stack([A, B], axis=2)[m.pose[row], leg, end], strict=True)
    ]
    px = np.array(seen) + noise * np.random.default_rng(1).normal(size=(len(row), 2))
    return Landmarks(row, leg, end, px, np.full(len(row), 3.0))


def test_a_fit_that_leaves_the_clicks_of_a_view_is_not_trusted(planar: Calibration) -> None:
    calibration, dataset, solution = planar, planar.dataset, planar.solution
    m = dataset.measurements
    rows = [int(np.flatnonzero(m.view == v)[0]) for v in range(2)]
    clicks = clicks_in(planar, rows, 3.0)

    def judged(clicks: Landmarks) -> Verdict:
        with_clicks = replace(dataset, landmarks=clicks)
        return judge(with_clicks, solution, calibration.steps, ()).verdict

    assert judged(clicks) == calibration.verdict
    assert calibration.verdict.trustworthy
    away = clicks.px + np.where((clicks.row == rows[1])[:, None], [30.0, 0.0], 0.0)
    verdict = judged(replace(clicks, px=away))
    assert not verdict.trustworthy
    name = m.views[1].name
    assert f"clicks on joints in view {name} (" in verdict.sentence
    o = solution.outlines
    without = replace(o, used=o.used & (m.view[o.row] != 1))
    unplaced = replace(solution, outlines=without)
    far = replace(dataset, landmarks=replace(clicks, px=away))
    codes = [doubt.code for doubt in judge(far, unplaced, calibration.steps, ()).doubts]
    assert "view_left_out" in codes
    assert "clicks" not in codes


def test_a_click_that_a_fit_contradicts_is_named_with_the_joint_that_it_may_show(
    planar: Calibration,
) -> None:
    dataset, solution = planar.dataset, planar.solution
    clicks = clicks_in(planar, [0], 1.0)
    assert not click_notes(replace(dataset, landmarks=clicks), solution)
    px = clicks.px
    exchanged = px[[0, 1, 5, 3, 4, 5]]  # of the base joint of leg2, at the platform's of leg3
    wrong = replace(dataset, landmarks=replace(clicks, px=exchanged))
    (note,) = click_notes(wrong, solution)
    first, second = (joint_name(dataset.machine.leg_names[j], e) for j, e in ((1, 0), (2, 1)))
    off = np.linalg.norm(px[2] - px[5])
    found = float(note.split(") is ")[1].split(" px")[0])
    assert f"The click on {first} in " in note
    assert found == pytest.approx(off, abs=5.0)
    assert f"needed at most 12 px; perhaps it shows {second}; correct or remove it." in note
