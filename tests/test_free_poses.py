"""Platforms that readings do not place: moved by hand, or with fewer motors than freedoms."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dataset_folder import Folder, folder
from fit_sessions import machine_session, with_boards
from layouts import Layout, MachineSpec, write_machine
from leg_pictures import clutter, edges, motion, segments
from machines import by_hand, of_types
from outline_sessions import made
from simulated import settings, small_camera

import legcal
from legcal import LegcalError, load_mechanism, simulate
from legcal.data.landmarks import Landmarks, place_by_landmarks, platforms_by_landmarks
from legcal.data.measurements import Measurements, View
from legcal.data.reasons import Reason, Rejection
from legcal.errors import NotIdentifiable, UsageError
from legcal.geometry.motions import look_at, pose_distance
from legcal.machine.parameters import geometries, vector_of
from legcal.perception.candidate_pairs import find_candidate_pairs
from legcal.perception.free_poses import find_free_poses
from legcal.perception.pair_matching import leg_segments
from legcal.perception.placement import Search
from legcal.simulation.settings import Level
from legcal.vision.camera import Camera
from legcal.workers import in_turn

__all__ = ["folder"]  # a fixture
KINDS: dict[str, tuple[list[str], list[str], int]] = {
    "3-SPS + passive UPS": (["SS"] * 3 + ["US"], ["actuated"] * 3 + ["passive"], 6),
    "5-SPS": (["SS"] * 5, ["actuated"] * 5, 6),
    "6-UPS by hand": (["US"] * 6, ["passive"] * 6, 6),
    "3-RPS, two motors": (["RS"] * 3, ["actuated"] * 2 + ["passive"], 3),
}


CAMERA = Camera(np.array([[1000.0, 0.0, 639.5], [0.0, 1000.0, 479.5], [0.0, 0.0, 1.0]]), 1280, 960)


def drawn(kind: str) -> MachineSpec:
    types, kinds, _ = KINDS[kind]
    return of_types(types, kinds)


# --- ranks --------------------------------------------------------------------------------------


@pytest.mark.usefixtures("without_remedies")
@pytest.mark.parametrize(
    ("kind", "n_views", "n_images", "rank"),
    [("3-SPS + passive UPS", 2, 6, 15), ("5-SPS", 1, 1, 13)],
)
def test_ranks_are_those_of_a_dense_jacobian(
    kind: str, n_views: int, n_images: int, rank: int, tmp_path: Path
) -> None:
    """It was computed once, by differences, of outlines, readings and radii known to 2 %."""
    machine = load_mechanism(write_machine(tmp_path, drawn(kind), Layout()))
    found = legcal.identifiability(machine, [machine.leg_names] * n_views, images=n_images)
    assert found.full.of == 6 * machine.n_legs - 12 + len(machine.motors)
    assert found.full.rank == rank
    assert found.platform_sigma is None
    assert any(machine.undetermined in note for note in found.notes)


# --- recognition --------------------------------------------------------------------------------


def test_poses_are_found_by_clicks(tmp_path: Path) -> None:
    machine, rng = load_mechanism(by_hand(tmp_path)), np.random.default_rng(0)
    true = [
        look_at(1.1 * np.array([np.cos(a), np.sin(a), 0.4]), np.array([0.0, 0.0, 0.2]))
        for a in (0.4, 2)
    ]
    rough = [T * motion(rng.normal(0.0, 0.01, 3), rng.normal(0.0, 0.015, 3)) for T in true]
    T = [
        machine.home * motion(rng.uniform(-0.06, 0.06, 3), rng.uniform(-0.2, 0.2, 3))
        for _ in range(3)
    ]
    B = np.array([one.apply(machine.B_platform) for one in T])[[0, 1, 2, 2]]
    A = np.broadcast_to(machine.A_base, B.shape)
    view, pose = np.array([0, 1, 0, 1]), np.array([0, 1, 2, 2])
    cylinders = [leg.cylinders for leg in machine.legs]
    every = np.arange(machine.n_legs)
    pairs = {
        row: find_candidate_pairs(
            segments(
                np.concatenate(
                    [
                        edges(leg_segments(A[row], B[row], cylinders, every), true[view[row]]),
                        clutter(15, rng),
                    ]
                )
            )
        )
        for row in range(4)
    }
    measurements = Measurements(
        tuple(View(f"c{v}", CAMERA, rough[v]) for v in range(2)),
        ("a", "b", "c", "d"),
        view,
        pose,
        np.full((4, machine.n_legs), np.nan),
        np.full(machine.n_legs, 2e-6),
    )
    # Clicks on all joints of each picture; cameras follow from those of the base.
    image, end, leg = (x.ravel() for x in np.meshgrid(range(4), (0, 1), every, indexing="ij"))
    X = np.where(end[:, None] == 0, A[image, leg], B[image, leg])
    shown = [CAMERA.project(true[view[r]].inv().apply(x)) for r, x in zip(image, X, strict=True)]
    px = np.array(shown) + 3.0 * rng.normal(size=(len(X), 2))
    landmarks = Landmarks(image, leg, end, px, np.full(len(X), 3.0))
    measurements, _ = place_by_landmarks(Path("a.csv"), machine, measurements, landmarks)
    rough = [one.T_base_camera for one in measurements.views if one.T_base_camera is not None]
    assert max(pose_distance(*both)[0] for both in zip(rough, true, strict=True)) < 0.04
    clicked = platforms_by_landmarks(machine, measurements, landmarks)
    assert max(min(pose_distance(x, T[k])[0] for x in clicked[k]) for k in range(3)) < 0.05
    search = Search(
        lambda row: np.zeros((960, 1280), dtype=np.uint8),
        measurements,
        A,
        np.broadcast_to(machine.home.apply(machine.B_platform), B.shape),
        cylinders,
        np.ones((2, machine.n_legs), dtype=np.bool_),
        machine.leg_names,
        machine.size,
        pairs,
    )
    T_base_platform, T_base_camera = find_free_poses(
        search, machine, range(4), rough, in_turn, lambda _: None, clicked
    )
    off, off_at_home = [], []
    for row in range(4):
        X = np.concatenate([A[row], B[row]])
        camera = T_base_camera[view[row]]
        assert camera is not None
        B_found = T_base_platform[int(pose[row])][0].apply(machine.B_platform)
        seen = CAMERA.project(camera.inv().apply(np.concatenate([A[row], B_found])))
        truth = CAMERA.project(true[view[row]].inv().apply(X))
        B_home = machine.home.apply(machine.B_platform)
        at_home = CAMERA.project(rough[view[row]].inv().apply(np.concatenate([A[row], B_home])))
        off.append(np.linalg.norm(seen - truth, axis=1).max())
        off_at_home.append(np.linalg.norm(at_home - truth, axis=1).max())
    assert max(off) < 20.0  # px
    assert min(off_at_home) > 40.0


def test_images_that_leave_a_pose_open_are_left_out(tmp_path: Path) -> None:
    """One leg and three readings let a platform slide, which no fit comes to the end of."""
    path = write_machine(tmp_path, drawn("3-SPS + passive UPS"), Layout())
    session = machine_session(str(path), n_views=2, n_poses=10)
    pose = session.measurements.pose[session.outlines.row]
    few = session.outlines.choose((pose > 3) | (session.outlines.leg == 0))
    found = replace(session, outlines=few).fit()
    assert session.off(found.legs) < 1e-7
    open_ones = session.measurements.pose[few.row] < 4
    np.testing.assert_array_equal(found.outlines.used, ~open_ones)
    assert {why for why, out in zip(found.outlines.reason, open_ones, strict=True) if out} == {
        Rejection(Reason.FEW_LEGS)
    }


@pytest.mark.system
@pytest.mark.parametrize(("kind", "seed"), [("3-RPS, two motors", 8), ("3-SPS + passive UPS", 16)])
def test_poses_that_a_few_lines_leave_ambiguous_are_searched_from_many_places(
    kind: str, seed: int, tmp_path: Path
) -> None:
    machine = write_machine(tmp_path, drawn(kind), Layout())
    made = simulate(machine, tmp_path / "set", settings(poses=10, seed=seed))
    found = legcal.calibrate(made.folder)
    assert np.all(found.solution.outlines.used)  # from one start, those of an image are not
    assert found.verdict.trustworthy


@pytest.mark.system
def test_photographs_of_a_platform_that_motors_leave_a_freedom_are_calibrated(
    tmp_path: Path,
) -> None:
    machine = made("5-sps", tmp_path / "model")
    camera = small_camera(tmp_path, 480, 360)
    photographs = settings(level=Level.PHOTOGRAPHS, seed=4, poses=6, hints=True, camera=camera)
    folder = tmp_path / "set"
    simulate(machine.yaml_path, folder, photographs)
    found = legcal.calibrate(folder)
    assert found.platform is None
    assert "no platform error can be predicted" in found.verdict.sentence
    true = load_mechanism(folder / "truth/models/5-sps.yaml")
    solution, legs = found.solution, geometries(true)
    both = (vector_of(solution.kinematic.parametrization, g, legs) for g in (solution.legs, legs))
    error = np.subtract(*both)
    squared = error @ np.linalg.solve(solution.kinematic.value_covariance, error) / len(error)
    assert 0.3 < squared < 2.2  # 28 numbers


# --- refusals -----------------------------------------------------------------------------------


def free_set(folder: Folder, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Return a dataset of a hexapod of three motors, of whose views one has no rough camera."""
    machine = load_mechanism(by_hand(tmp_path, [f"leg{j}_prismatic" for j in (1, 2, 3)]))
    monkeypatch.setattr("legcal.data.dataset.load_mechanism", lambda path: machine)
    folder.columns = folder.columns[:5]
    folder.entry["views"]["c2"].pop("legs")
    return folder.write()


def test_without_a_rough_camera_pose_no_image_is_searched(
    folder: Folder, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = free_set(folder, monkeypatch, tmp_path)
    monkeypatch.setattr("legcal.calibration.pipeline.check_identifiable", lambda *_: [])
    with pytest.raises(NotIdentifiable) as refusal:
        legcal.calibrate(path)
    (problem,) = refusal.value.problems
    assert problem.startswith("view c2: the images could not be searched")
    assert "write T_base_camera" in problem


def test_a_page_to_click_on_is_written_where_no_image_can_be_searched(
    folder: Folder, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = free_set(folder, monkeypatch, tmp_path)
    found = legcal.doctor(path, output=tmp_path / "found")
    said = [one.what for one in found.findings if one.check == "legs"]
    assert any("view c2" in what and "landmarks.csv" in what for what in said)
    assert "data-place" in (tmp_path / "found" / "index.html").read_text()


def test_no_images_are_kept_aside_where_readings_give_no_poses(
    folder: Folder, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = free_set(folder, monkeypatch, tmp_path)
    with pytest.raises(UsageError, match="3 motors do not determine the pose"):
        legcal.calibrate(path, holdout=0.25)


@pytest.mark.parametrize(("kind", "says"), [("6-UPS by hand", True), ("5-SPS", False)])
def test_a_fit_that_fails_without_any_length_says_what_to_measure(
    kind: str, says: bool, tmp_path: Path
) -> None:
    path = write_machine(tmp_path, drawn(kind), Layout())
    session = machine_session(str(path), n_views=1, n_poses=3)
    some = session.outlines.choose(session.outlines.leg < 4)
    with pytest.raises(LegcalError) as refusal:
        replace(session, outlines=some).fit()
    first = refusal.value.problems[0]
    assert ("no measured length" in first and "board on the platform" in first) == says


def test_legs_and_a_board_on_the_platform_calibrate_what_is_moved_by_hand(tmp_path: Path) -> None:
    """No length is measured: squares of the board give the scale, and each pose."""
    path = write_machine(tmp_path, drawn("6-UPS by hand"), Layout())
    session = machine_session(str(path), n_poses=8)
    seen, start = with_boards(session, base=False)
    assert session.off(session.start.legs) > 2e-3
    assert session.off(session.fit(start, board=seen).legs) < 1e-9
