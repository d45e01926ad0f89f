"""What the viewer shows for sliders: kinematics, exaggeration, photographs; without a browser."""

import socket
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from hexapod_example import HEXAPOD, Run
from layouts import Layout, write_machine
from machines import of_types
from scipy.ndimage import map_coordinates

from legcal.machine.files import shipped_names
from legcal.machine.kinematics import inverse_kinematics
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.viewer.motion import Motion
from legcal.viewer.source import Photographs, Source, open_source
from legcal.viewer.stage import Stage

MODELS = [name for name in shipped_names() if "hexapod-" not in name or name == "hexapod-rod"]


@pytest.mark.parametrize("name", MODELS)
def test_a_reading_moves_the_platform_and_no_other_motor(name: str) -> None:
    machine = load_mechanism(name)
    motion = Motion(machine)
    j = machine.motors[-1]
    before = motion.posture.q.copy()
    wanted = before.copy()
    for step in (0.003, 0.008):
        wanted[j] = before[j] + step
        posture = motion.read(j, wanted[j])
        assert not posture.problem
        q = inverse_kinematics(machine, posture.T)  # refuses poses that legs do not allow
        np.testing.assert_allclose(q[list(machine.motors)], wanted[list(machine.motors)], atol=1e-9)


@pytest.mark.parametrize("name", MODELS)
def test_a_coordinate_of_the_pose_moves_the_legs_and_no_other_coordinate(name: str) -> None:
    machine = load_mechanism(name)
    motion = Motion(machine)
    assert len(motion.columns) == machine.mobility
    for k, which in enumerate(motion.columns.tolist()):
        before = motion.coordinates
        before[k] += 0.004 if which < 3 else 0.02
        posture = motion.place(k, before[k])
        assert not posture.problem
        np.testing.assert_allclose(motion.coordinates, before, atol=1e-9)
        np.testing.assert_allclose(inverse_kinematics(machine, posture.T), posture.q, atol=1e-9)
    j = machine.motors[0]
    there = motion.posture.q
    motion.read(j, there[j] + 0.002)  # on from there, not from home
    np.testing.assert_allclose(
        motion.posture.q[list(machine.motors[1:])], there[list(machine.motors[1:])], atol=1e-9
    )


def test_a_machine_without_motors_is_moved_by_its_pose(tmp_path: Path) -> None:
    spec = of_types(["US"] * 6, ["passive"] * 6)
    motion = Motion(load_mechanism(write_machine(tmp_path, spec, Layout())))
    assert "Readings do not move it" in motion.read(0, 0.1).problem
    z = motion.posture.T.translation[2]
    assert not motion.place(2, z + 0.01).problem
    assert abs(motion.posture.T.translation[2] - z - 0.01) < 1e-9
    assert "Readings do not give the pose" in motion.show(motion.posture.q).problem


@pytest.fixture(scope="module")
def hexapod() -> Machine:
    return load_mechanism("hexapod")


@pytest.fixture(scope="module")
def result(example_run: Run) -> Source:
    return open_source(example_run.output, example_run.folder)


def test_nominal_and_calibrated_stand_at_the_same_readings(result: Source) -> None:
    stage, motion = Stage(result), Motion(result.machine)
    motion.read(0, motion.posture.q[0] + 0.01)
    seen = {f: stage.seen(motion.posture, factor=f) for f in (0.0, 1.0, 10.0)}
    nominal = seen[1.0].beside
    assert nominal is not None
    assert result.nominal is not None
    for A, B, machine in (
        (*nominal, result.nominal),
        (seen[1.0].A, seen[1.0].B, result.machine),
    ):
        lengths = np.linalg.norm(B - A, axis=1)
        np.testing.assert_allclose(lengths, machine.lengths_at(motion.posture.q), atol=1e-9)
    np.testing.assert_allclose(seen[0.0].B, nominal[1], atol=1e-15)
    np.testing.assert_allclose(
        seen[10.0].B - nominal[1], 10.0 * (seen[1.0].B - nominal[1]), atol=1e-12
    )
    assert 1e-4 < seen[1.0].apart < 1e-2


def test_outlines_lie_on_the_legs_as_their_camera_sees_them(result: Source) -> None:
    photographs, motion = Photographs(result), Motion(result.machine)
    assert len(photographs.poses) == 45
    stage, near = Stage(result), []
    for pose in range(0, 45, 5):
        seen = stage.seen(motion.show(photographs.q[pose]))
        for place in photographs.places:
            row = photographs.row(place, pose)
            if row is None:
                continue
            ends, used = photographs.outlines(place, row, 0.3)
            assert used.sum() >= 4
            centre = place.T_base_camera.translation
            u = (seen.B - seen.A) / np.linalg.norm(seen.B - seen.A, axis=1)[:, None]
            for end in ends[used].reshape(-1, 3):  # how near its ray passes to the legs
                ray = (end - centre) / np.linalg.norm(end - centre)
                across = np.cross(ray, u)
                gap = np.abs(np.sum((seen.A - centre) * across, axis=1))
                near.append(float((gap / np.linalg.norm(across, axis=1)).min()))
    radii = [c.radius for leg in result.machine.legs for c in leg.cylinders]
    assert len(near) > 50
    assert np.median(near) < 1.1 * max(radii)


def test_photographs_come_without_distortion_and_say_where_they_are_missing(
    result: Source, tmp_path: Path
) -> None:
    photographs = Photographs(result)
    place = photographs.places[0]
    row = next(r for p in range(45) if (r := photographs.row(place, p)) is not None)
    picture, problem = photographs.picture(place, row)
    assert not problem
    assert picture is not None
    assert abs(picture.shape[1] / picture.shape[0] - place.aspect) < 0.01
    assert result.dataset is not None
    grey = result.dataset.image_reader([row])(0)
    barrel = replace(
        place, view=-1, camera=replace(place.camera, distortion=np.array([-0.2, 0.05, 1e-3, 0, 0]))
    )
    straight, _ = photographs.picture(barrel, row)
    assert straight is not None
    pixels = np.random.default_rng(3).uniform([60, 60], [960, 700], (300, 2))
    for seen_by, shown in ((place, picture), (barrel, straight)):
        xy = seen_by.camera.undistort(pixels)  # lines of sight of both must show the same
        at = 0.5 * (xy / seen_by.half + 1.0) * shown.shape[1::-1] - 0.5
        levels = [
            map_coordinates(of, where.T[::-1], order=1)
            for of, where in ((grey, pixels), (shown[..., 0].astype(float), at))
        ]
        assert np.corrcoef(levels)[0, 1] > 0.99
    elsewhere = replace(result, dataset=replace(result.dataset, folder=tmp_path))
    nothing, problem = Photographs(elsewhere).picture(place, row)
    assert nothing is None
    assert "could not be read" in problem


def _port_in_use() -> tuple[socket.socket, str]:
    taken = socket.socket()
    taken.bind(("127.0.0.1", 0))
    taken.listen()
    return taken, str(taken.getsockname()[1])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["missing"], "found no such file"),
        (["{tmp}"], "found a folder without dataset.yaml"),
        ([str(HEXAPOD), "--dataset", str(HEXAPOD)], "--dataset could not be used"),
        (["3-upu", "--dataset", str(HEXAPOD)], "needed those of 3-upu"),
        (["hexapod", "--host", "no.such.host.invalid"], "which is no name of a host here"),
        (["hexapod", "--host", "192.0.2.1"], "needed an address of this machine"),
        (["hexapod", "--port", "{port}"], "is in use"),
        (["hexapod", "--port", "70000"], "'--port'"),
    ],
)
def test_what_cannot_be_shown_is_refused_in_a_sentence(
    words: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("legcal.viewer.window.find_spec", lambda name: name)
    taken, port = _port_in_use()
    with taken:
        filled = [word.format(tmp=tmp_path, port=port) for word in words]
        assert run(monkeypatch, "view", *filled) == 2
    found = capsys.readouterr().err
    assert said in found
    assert found.count("\n") == 1


def test_without_viser_the_command_that_installs_it_is_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("legcal.viewer.window.find_spec", lambda name: None)
    assert run(monkeypatch, "view", "hexapod") == 2
    assert "pip install 'legcal[view]'" in capsys.readouterr().err
