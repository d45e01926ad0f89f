"""What the viewer shows for sliders: kinematics, models, photographs; without a browser."""

import json
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import run
from hexapod_example import HEXAPOD, Run
from layouts import Layout, write_machine
from machines import of_types

from legcal import inverse_kinematics, load_mechanism
from legcal.exports.subject import Subject
from legcal.viewer.server import Address
from legcal.viewer.source import Photographs, open_source
from legcal.viewer.view_server import Motion, ViewServer

MODELS = ["hexapod-rod", "3-rpr", "3-upu", "tricept", "delta"]


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


def test_a_folder_with_one_model_is_shown(tmp_path: Path) -> None:
    spec = of_types(["US"] * 6, ["passive"] * 6)
    (tmp_path / "models").mkdir()
    written = write_machine(tmp_path / "models", spec, Layout())
    assert open_source(tmp_path).machine.yaml_path == written


def test_a_machine_without_motors_is_moved_by_its_pose(tmp_path: Path) -> None:
    spec = of_types(["US"] * 6, ["passive"] * 6)
    motion = Motion(load_mechanism(write_machine(tmp_path, spec, Layout())))
    assert "Readings do not move it" in motion.read(0, 0.1).problem
    z = motion.posture.T.translation[2]
    assert not motion.place(2, z + 0.01).problem
    assert abs(motion.posture.T.translation[2] - z - 0.01) < 1e-9
    assert "Readings do not give the pose" in motion.show(motion.posture.q).problem


@pytest.fixture(scope="module")
def result(example_run: Run) -> Subject:
    return open_source(example_run.output, example_run.folder)


@contextmanager
def served(source: Subject) -> Iterator[ViewServer]:
    server = ViewServer(source, Address("127.0.0.1", 0))
    try:
        yield server
    finally:
        server._server.server_close()


def move(server: ViewServer, slider: str, value: float) -> dict[str, Any]:
    posted = json.dumps({"slider": slider, "value": value}).encode()
    answer = server.answer("/move", {}, posted)
    assert answer is not None
    return answer


def test_nominal_and_calibrated_stand_at_the_same_readings(result: Subject) -> None:
    assert result.nominal is not None
    with served(result) as server:
        before = move(server, "pose", 2)["values"]
        answer = move(server, "q0", before["q0"] + 10.0)
        q = server.motion.posture.q
        assert answer["values"]["q0"] == pytest.approx(before["q0"] + 10.0, abs=0.011)
        assert [answer["values"][f"q{j}"] for j in range(1, 6)] == [
            pytest.approx(before[f"q{j}"], abs=1e-9) for j in range(1, 6)
        ]
        change = answer["scene"]
        assert change["legend"] == ("nominal", "calibrated")
        shown = [(np.array(model["A"][0]), np.array(model["B"][0])) for model in change["models"]]
        for (A, B), machine in zip(shown, (result.nominal, result.machine), strict=True):
            lengths = np.linalg.norm(B - A, axis=1)
            np.testing.assert_allclose(lengths, machine.lengths_at(q), atol=1e-6)
        assert 1e-4 < np.abs(np.subtract(shown[0], shown[1])).max() < 1e-2
        far = move(server, "q0", 1e4)
        assert any("q0" in problem or "leg1" in problem for problem in far["problems"])
        assert "At the end" not in " ".join(move(server, "home", 0.0)["problems"])


def test_photographs_come_with_their_outlines_and_say_where_they_are_missing(
    result: Subject, tmp_path: Path
) -> None:
    assert result.dataset is not None
    with served(result) as server:
        (shown,) = move(server, "pose", 2)["photographs"]
        kind, content = server.content(f"/{shown['file']}") or ("", b"")
        assert kind == "image/jpeg"
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert picture is not None
        assert picture.shape[1] / picture.shape[0] == pytest.approx(np.divide(*shown["size"]))
        used = [line for kind, line in shown["lines"] if kind == "measured"]
        assert len(used) >= 8
        size = np.array(shown["size"])
        assert np.all((np.array(used) >= -0.5) & (np.array(used) <= size))
        for path in ("/photographs/45", "/photographs/-1", "/photographs/../x", "/other"):
            assert server.content(path) is None
        for posted in (b"", b"{}", b'{"slider": "q9", "value": 1}', b'{"slider": "q0"}'):
            assert server.answer("/move", {}, posted) is None
    elsewhere = replace(result, dataset=replace(result.dataset, folder=tmp_path))
    (missing,) = Photographs(elsewhere).at(1)
    assert missing["file"] == ""
    assert "could not be read" in missing["caption"]


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
    words: list[str], said: str, tmp_path: Path
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        filled = [word.format(tmp=tmp_path, port=port) for word in words]
        outcome = run("view", *filled)
    assert outcome.code == 2
    assert said in outcome.err
    assert outcome.err.count("\n") == 1
