"""Planned sessions: what they hold, what they promise, and what is refused."""

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import run
from csv_rows import read_rows
from edits import keyed
from pool_work import OtherProcess

import legcal
from legcal import (
    Machine,
    SimulationSettings,
    inverse_kinematics,
    load_dataset,
    load_mechanism,
    simulate,
)
from legcal.calibration.joint_fit.predicted import WHITE
from legcal.errors import DatasetError, DidNotConverge, NotIdentifiable, NotVisible, UsageError
from legcal.machine.configurations import Configurations
from legcal.planning import places as camera_places
from legcal.planning import planner, request
from legcal.planning.places import Setting, default_setting, parse_bounds
from legcal.planning.poses import candidate_poses as draw_poses
from legcal.planning.request import difference
from legcal.planning.session import Plan, write_session
from legcal.simulation.settings import Level
from legcal.vision.camera import sample_camera
from legcal.vision.camera_file import camera_info

pytestmark = pytest.mark.usefixtures("without_steps")

FEW = replace(default_setting(load_mechanism("3-rpr")), draws=3)
BOUNDS = "0m:2m,-2m:2m,0.5m:2m"  # of cameras


WORDS = ["plan", "3-rpr", "--images", "6", "--cameras", "2", "--seed", "3", "--bounds", BOUNDS]


@pytest.fixture(scope="module", autouse=True)
def small_search() -> Iterator[None]:
    """Fewer candidates: what is found is not as good, but found in the same way."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planner, "MIN_POSES", 8)
        patch.setattr(planner, "POSES_EACH", 2)
        patch.setattr(planner, "ROUNDS", 1)
        patch.setattr(camera_places, "_N_AZIMUTHS", 5)
        yield


@pytest.fixture(scope="module")
def drawn_once() -> Iterator[None]:
    """Draw the candidate poses of equal requests once."""
    drawn: dict[str, tuple[Configurations, Any]] = {}

    def candidate_poses(
        machine: Machine, legs: Any, setting: Setting, n: int, rng: Any, progress: Any
    ) -> Configurations:
        key = f"{machine.yaml_path} {setting} {n} {rng.bit_generator.state}"
        if key not in drawn:
            poses = draw_poses(machine, legs, setting, n, rng, progress)
            drawn[key] = poses, rng.bit_generator.state
        poses, rng.bit_generator.state = drawn[key]
        return poses

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planner, "candidate_poses", candidate_poses)
        yield


@pytest.fixture(scope="module")
def planned(small_search: None) -> Plan:
    """A plan for outlines with white noise, its work done elsewhere."""
    with OtherProcess(1) as executor:
        return legcal.plan(
            "3-rpr", images=6, cameras=2, seed=3, noise=WHITE, setting=FEW,
            bounds=parse_bounds(BOUNDS), workers=executor,
        )  # fmt: skip


@pytest.fixture(scope="module")
def shot(planned: Plan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated session of it, beside the plan."""
    folder = tmp_path_factory.mktemp("planned")
    write_session(planned, folder / "session")
    settings = SimulationSettings(seed=5, plan=folder / "session", level=Level.OUTLINES)
    simulate(load_mechanism("3-rpr"), folder / "shot", settings)
    return folder


def test_a_planned_session_is_a_dataset_and_simulation_shoots_it(planned: Plan, shot: Path) -> None:
    dataset = load_dataset(shot / "session", check_images=False)
    machine, m = dataset.machine, dataset.measurements
    assert m.n_rows == planned.n_images == 6
    poses = [T for view in planned.views for T in view.poses.poses]
    readings = np.array([inverse_kinematics(machine, T) for T in poses])
    motors = list(machine.motors)
    assert np.abs(readings - m.q)[:, motors].max() < 1e-9
    with pytest.raises(DatasetError, match="none of the 6") as refusal:
        load_dataset(shot / "session")  # before its photographs are taken
    assert len(refusal.value.problems) == 1
    taken = load_dataset(shot / "shot").measurements
    assert np.abs(taken.q - m.q)[:, motors].max() < 2e-5  # encoders err
    assert taken.view.tolist() == m.view.tolist()


def test_the_expected_error_is_that_of_a_calibration(planned: Plan, shot: Path) -> None:
    found = legcal.calibrate(shot / "shot", output=shot / "out")
    assert found.platform is not None
    assert found.platform.workspace is not None
    assert planned.error is not None
    stated = found.platform.workspace.mean_displacement
    assert planned.error.mean_displacement == pytest.approx(stated, rel=0.25)


@pytest.mark.system
def test_the_command_writes_what_python_plans(
    planned: Plan,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With the same seed it is the same, to the last bit, wherever work is done."""
    monkeypatch.setattr(request, "plan", partial(request.plan, setting=FEW))
    monkeypatch.setattr("legcal.calibration.joint_fit.predicted.DEFAULT_NOISE", WHITE)
    session, lens = tmp_path / "session", tmp_path / "lens.yaml"
    lens.write_text(f"# calibrated\n{camera_info(planned.camera, 'lens')}")
    outcome = run(*WORDS, "--camera", lens, "--json", "-o", session)
    assert outcome.code == 0
    assert (session / "camera_info.yaml").read_bytes() == lens.read_bytes()
    assert outcome.document == planned.document() == json.loads((session / "plan.json").read_text())
    header = (session / "dataset.yaml").read_text().partition("\n")[0]
    assert (session / header.rpartition("=")[2]).name == "dataset.json"
    assert (session / header.rpartition("=")[2]).is_file()
    for view in planned.views:
        assert (session / "previews" / f"{view.name}.jpg").read_bytes().startswith(b"\xff\xd8")
        assert view.name in (session / "places.svg").read_text()
        where = view.T_base_camera.translation
        assert np.all((where > [-1e-6, -2.0, 0.5]) & (where < 2.0))
    page = (session / "plan.html").read_text()
    assert "Distances to measure" in page
    assert "Checklist" in page
    assert re.search(r"Set the tripod to within [\d.]{1,4} cm and 5 deg", page)
    assert len((session / "poses.csv").read_text().splitlines()) == 1 + 6


def test_a_machine_without_motors_is_planned_too(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The strut of constant length carries the scale."""
    simulate("hexapod-strut", tmp_path / "d", SimulationSettings(level=Level.OUTLINES, poses=2))
    model = tmp_path / "d/models/hexapod-strut.yaml"
    keyed(model.name, name_mot=[])(model.parent)
    monkeypatch.setattr(planner, "ROUNDS", 0)
    found = legcal.plan(model, images=18, noise=WHITE, setting=FEW)
    write_session(found, tmp_path / "session")
    dataset = load_dataset(tmp_path / "session", check_images=False)
    assert len(dataset.machine.motors) == 0
    assert dataset.measurements.n_rows == 18
    assert found.error is None


def test_a_better_known_machine_is_what_more_images_and_a_given_session_make(
    planned: Plan, shot: Path
) -> None:
    assert np.all(np.diff(planned.growth[:, 1]) < 0.0)
    more = legcal.plan(
        "3-rpr", images=2, cameras=1, given=shot / "session", noise=WHITE, setting=FEW
    )
    assert more.error is not None
    assert planned.error is not None
    assert more.error.mean_displacement < planned.error.mean_displacement
    assert f"2 photographs beside those of {shot / 'session'}" in more.sentence
    assert any("6 of 6 photographs" in note for note in more.notes)
    assert not {*more.labels} & {*planned.labels}  # poses are others
    assert [view.name for view in more.views] == ["c3"]


def test_a_session_by_hand_is_shot_with_its_board_where_the_plan_lays_it(
    small_search: None, tmp_path: Path
) -> None:
    """Every image shows the board, also by rays at the solids of the simulation."""
    held = legcal.plan(
        "3-rpr", images=4, board="chessboard:6x5:40mm", hand_held=True, noise=WHITE,
        setting=FEW,
    )  # fmt: skip
    held = replace(held, views=(*held.views[:3], replace(held.views[3], via=("2",))))
    assert held.board is not None
    write_session(held, tmp_path / "session")
    (*_, last) = read_rows(tmp_path / "session" / "poses.csv")
    assert (last["pose"], last["on the way"]) == (held.views[3].name, held.views[1].name)
    settings = SimulationSettings(plan=tmp_path / "session", level=Level.OUTLINES)
    simulate(load_mechanism("3-rpr"), tmp_path / "shot", settings)
    shot = load_dataset(tmp_path / "shot")
    truth = json.loads((tmp_path / "shot" / "truth" / "truth.json").read_text())
    where = truth["board"]["T_base_board"]["xyz"]
    np.testing.assert_allclose(where, held.board.T_base_board.translation, atol=1e-9)
    assert all(view.hand_held for view in shot.measurements.views)
    assert shot.corners is not None
    assert len(shot.corners.row) == 4 * held.board.board.n_corners
    keyed("plan.json", tolerance__camera_rad=3.0)(tmp_path / "session")
    with pytest.raises(
        DatasetError, match=r"tolerance.camera_rad .* found 3.0, needed 0.8 or less"
    ):
        simulate(load_mechanism("3-rpr"), tmp_path / "again", settings)


FAR: dict[str, Any] = {"images": 4, "setting": FEW}
REFUSED: list[tuple[dict[str, Any], type[legcal.LegcalError], str]] = [
    ({"images": 401}, UsageError, "1 to 400"),
    ({"images": 9, "images_per_view": 3}, UsageError, "--images-per-view"),
    ({"images": 9, "target": 1e-4}, UsageError, "--target"),
    ({"images": 2, "cameras": 3}, UsageError, "--images 3"),
    ({"cameras": 0}, UsageError, "--cameras 0"),
    ({"target": 0.0}, UsageError, "more than 0"),
    ({"seed": -1}, UsageError, "--seed"),
    ({"hand_held": True, "cameras": None}, UsageError, "--board"),
    ({"hand_held": True, "board": "chessboard:9x6:25mm", "cameras": 2}, UsageError, "--cameras"),
    ({"board": "chessboard:7x5:25mm"}, DatasetError, "after half a turn"),
    ({"board": "chessbord:9x6"}, UsageError, "chessbord"),
    ({"given": "nowhere"}, DatasetError, "nowhere"),
    ({"noise": __file__}, UsageError, "found no JSON"),
    ({"encoder_sigma": "0.5deg"}, UsageError, "encoder sigma"),
    ({"encoder_sigma": "2"}, UsageError, "without a unit"),
    ({"setting": Setting(0.05, 2e-3, draws=0)}, UsageError, "0 draws"),
    ({"setting": Setting(0.05, 3.0)}, UsageError, "a model error of 3 m"),
    (
        {"setting": Setting(0.05, 0.5, draws=3), "images": 4},
        DidNotConverge,
        "; plan with a smaller length",
    ),
    (FAR | {"bounds": np.array([[5.0, 6.0]] * 3)}, NotVisible, "widen --bounds"),
    (FAR | {"bounds": np.array([[0.3, 0.31]] * 3)}, NotVisible, "widen --bounds"),
]


@pytest.mark.usefixtures("drawn_once")
@pytest.mark.parametrize(("asked", "error", "named"), REFUSED, ids=lambda x: str(x)[:40])
def test_what_cannot_be_planned_is_refused(
    asked: dict[str, Any], error: type[legcal.LegcalError], named: str
) -> None:
    with pytest.raises(error) as refusal:
        legcal.plan("3-rpr", **({"cameras": 2} | asked))
    assert len(refusal.value.problems) == 1
    assert named in str(refusal.value)


@pytest.mark.usefixtures("drawn_once")
def test_what_else_is_in_the_way_is_refused(planned: Plan, shot: Path) -> None:
    def refused(error: type[legcal.LegcalError], named: str, **asked: Any) -> None:
        of: dict[str, Any] = {"model": "3-rpr", "images": 4, "cameras": 1, "setting": FEW}
        with pytest.raises(error, match=named):
            legcal.plan(**(of | asked))

    telephoto = replace(sample_camera(), K=sample_camera().K * [[50.0], [50.0], [1.0]])
    refused(NotVisible, "wider view, or correct the focal length", camera=telephoto)
    for share, error in ((0.3, NotVisible), (0.4, NotIdentifiable)):
        K = sample_camera().K * [[share], [share], [1.0]]
        coarse = replace(sample_camera(), width=int(1024 * share), height=int(768 * share), K=K)
        named = "legs are [34].. px wide .* a --camera with more pixels"
        refused(error, named, model="linear-delta", camera=coarse, setting=None)
    refused(NotVisible, "; use a board with larger", board="charuco:7x5:4mm:3mm:DICT_4X4_50")
    refused(NotVisible, "use another board, wider --bounds", board="chessboard:90x61:1m")
    refused(NotVisible, "; use a board with larger squares", board="chessboard:9x6:5mm")
    refused(NotVisible, "; widen --bounds, or use a board", board="chessboard:9x6:5mm",
            bounds="-9m:9m,-9m:9m,-9m:9m")  # fmt: skip
    refused(NotIdentifiable, "give --images . or more", images=1)
    refused(DatasetError, "needed images of 3-rps", model="3-rps", given=shot / "session")
    upright, tilted = map(load_mechanism, ("3-upu", "3-upu-tilted"))
    assert difference(upright, tilted) == "axes of joints up to 15 deg from those of the model"
    assert not difference(tilted, tilted)
    with pytest.raises(UsageError, match="found an earlier session"):
        write_session(planned, shot / "session")
    for text in ("1m", "0m:1m,0m:1m,1m:0m", "0m:1m,0m:1m,0m:1kg"):
        with pytest.raises(UsageError, match="--bounds"):
            parse_bounds(text)
