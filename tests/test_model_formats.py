"""One machine is one analysis, whatever format it is written in; MJCF means what MuJoCo means."""

import json
from dataclasses import replace
from functools import cache
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from edits import document
from model_formats import FORMATS, write_format
from scipy.spatial.transform import RigidTransform, Rotation

from legcal import LegcalError, Machine, load_mechanism
from legcal.errors import UsageError
from legcal.geometry.types import Array
from legcal.machine.chain import ClosedChain
from legcal.machine.mjcf import MjcfReader
from legcal.machine.model_writer import write_model
from legcal.machine.spanning_tree import close_loops
from legcal.machine.urdf import XmlProblems, parse_xml

machine_of = cache(load_mechanism)


def _difference(one: Array | float | None, two: Array | float | None) -> float:
    assert (one is None) == (two is None)
    if one is None or two is None:
        return 0.0
    return float(np.nanmax(np.abs(np.nan_to_num(one) - np.nan_to_num(two))))


def assert_same_analysis(found: Machine, expected: Machine) -> None:
    """Check that two machines are one, legs matched by where they stand."""
    for key in ("spatial", "mobility", "n_legs", "motors"):
        assert getattr(found, key) == getattr(expected, key), key
    for wanted in expected.legs:
        leg = min(found.legs, key=lambda leg: float(np.linalg.norm(leg.A - wanted.A)))
        assert (leg.type, leg.kind, leg.sign) == (wanted.type, wanted.kind, wanted.sign)
        assert (leg.prismatic, leg.travel) == (wanted.prismatic, wanted.travel)
        for key in ("A", "B", "q0", "base_axis", "platform_axis", "twist"):
            assert _difference(getattr(leg, key), getattr(wanted, key)) < 1e-9, key
        parts, others = (
            np.array([(c.radius, c.start, c.end) for c in one.cylinders]) for one in (leg, wanted)
        )
        np.testing.assert_allclose(parts, others, atol=1e-9)
    np.testing.assert_allclose(found.home.as_matrix(), expected.home.as_matrix(), atol=1e-9)


@pytest.mark.parametrize(
    ("name", "machine"),
    [(name, "tricept" if name == "isaac" else "3-upu") for name in FORMATS],
)
def test_every_format_gives_the_same_analysis(name: str, machine: str, tmp_path: Path) -> None:
    expected = machine_of(machine)
    found = load_mechanism(write_format(expected, name, tmp_path))
    if name != "mjcf":  # these have no pose where they are closed
        found = replace(found, home=expected.home)
    assert_same_analysis(found, expected)


def test_what_is_written_down_loads_with_an_equal_analysis(tmp_path: Path) -> None:
    found = load_mechanism(write_format(machine_of("3-upu"), "loop_joint", tmp_path / "from"))
    yaml_path, urdf_path = write_model(found, tmp_path / "to")
    assert (yaml_path.name, urdf_path.name) == ("machine.yaml", "machine.urdf")
    written = load_mechanism(yaml_path)
    assert_same_analysis(written, found)
    for key in ("leg_names", "frame_legs", "platform_joint"):
        assert getattr(written, key) == getattr(found, key)


@pytest.mark.parametrize(
    "stated",
    [
        {"tolerance": {"joints": "0.3 mm", "lengths": 1e-4, "zeros": "0.2 mm"}, "spline_teeth": 25},
        {"tolerance": {"travel": "0.02%"}},
    ],
)
def test_a_copied_model_says_how_well_the_machine_is_built(
    stated: dict[str, Any], tmp_path: Path
) -> None:
    path, _ = write_model(machine_of("hexapod"), tmp_path / "from")
    document(path.name, lambda content: content["legcal"].update(stated))(path.parent)
    machine = load_mechanism(path)
    copied = load_mechanism(write_model(machine, tmp_path / "to")[0])
    assert machine.tolerance != machine_of("hexapod").tolerance
    assert (copied.tolerance, copied.spline_teeth) == (machine.tolerance, machine.spline_teeth)


def test_a_urdf_that_needs_no_change_is_copied_and_nothing_written_over(tmp_path: Path) -> None:
    machine = machine_of("hexapod")
    _, urdf_path = write_model(machine, tmp_path)
    assert urdf_path.read_bytes() == machine.urdf_path.read_bytes()
    with pytest.raises(UsageError, match="already there, needed new files"):
        write_model(machine, tmp_path)


def test_what_closes_no_loop_is_left_out_of_an_mjcf_scene(tmp_path: Path) -> None:
    scene = (
        '<light pos="0 0 1"/><geom type="plane" size="1 1 1"/><geom type="mesh" mesh="m"/>'
        '<camera name="c"/><!-- x --><body name="ball"><freejoint/><geom size="1"/></body>'
    )

    motor, world = "<actuator>", "<worldbody>"
    path = write_format(load_mechanism("hexapod"), "mjcf", tmp_path)
    text = path.read_text()
    text = text.replace(motor, f'{motor}<adhesion body="platform"/>')
    text = text.replace('range="-0.004 0.144"', "", 3)  # and the other ranges are no limits
    text = text.replace(world, f'<compiler autolimits="false"/>{world}')
    path.write_text(text.replace("</worldbody>", f"{scene}</worldbody>"))
    machine = load_mechanism(path)
    assert machine.leg_names == tuple(f"leg{j}" for j in range(1, 7))
    notes = " ".join(machine.diagnostics)
    assert "Free bodies that touch no loop were left out: 'ball'" in notes
    assert "gives no travel for 6 sliders" in notes
    assert max(leg.travel[1] - leg.travel[0] for leg in machine.legs) < 0.1


@pytest.mark.corpus
def test_every_robot_of_the_corpus_is_refused_in_one_sentence() -> None:
    try:
        found = files("example-robot-data") or []
    except PackageNotFoundError:
        pytest.skip("example-robot-data is not installed: pip install 'legcal[corpus]'")
    robots = sorted(Path(str(f.locate())) for f in found if f.suffix == ".urdf")
    assert robots, "the distribution lists no URDF"
    for robot in robots:
        with pytest.raises(LegcalError) as refusal:
            load_mechanism(robot)
        for problem in refusal.value.problems:
            assert "\n" not in problem, robot.name
            assert robot.name in problem, robot.name


# --- numbers that MuJoCo has for a model with all conventions at once ---------------------------

MUJOCO = Path(__file__).parent / "data" / "mujoco"


def _rotation(quaternion: list[float]) -> Rotation:
    """Return the rotation of a quaternion w, x, y, z."""
    return Rotation.from_quat(np.roll(quaternion, -1))


def test_bodies_sites_and_closures_are_where_mujoco_has_them() -> None:
    path, values = MUJOCO / "model.xml", json.loads((MUJOCO / "values.json").read_text())
    root, problems = parse_xml(path, path.read_bytes(), "MJCF file"), XmlProblems(path)
    reader = MjcfReader(root, problems)
    reader.read_bodies()
    closures = close_loops(list(reader.loops()), reader.tree, path)
    problems.raise_if_any()
    chain = ClosedChain(reader.tree.robot("machine").decode(), [])
    q = chain.neutral()
    for name, value in values["q"].items():
        if len(value) == 1:
            q[chain.q_index(name)] = value[0]
        elif len(value) == 4:  # a ball is three revolutes
            for letter, angle in zip("xyz", _rotation(value).as_euler("XYZ"), strict=True):
                q[chain.q_index(f"{name}_{letter}")] = angle
        else:
            T = RigidTransform.from_components(value[:3], _rotation(value[3:]))
            moved = reader.poses["f"].inv() * T
            at = chain.q_index(name)
            q[at : at + 7] = [*moved.translation, *moved.rotation.as_quat()]

    for name, (position, quaternion) in values["bodies"].items():
        T = chain.pose(q, "world", name)
        np.testing.assert_allclose(T.translation, position, atol=1e-12)
        R = _rotation(quaternion).as_matrix()
        np.testing.assert_allclose(T.rotation.as_matrix(), R, atol=1e-12)
    for name, (position, matrix) in values["sites"].items():
        body, T_body_site = reader.sites[name]
        T = chain.pose(q, "world", body) * T_body_site
        np.testing.assert_allclose(T.translation, position, atol=1e-12)
        np.testing.assert_allclose(T.rotation.as_matrix().ravel(), matrix, atol=1e-12)
    for closure, off in zip(closures, values["closures"], strict=True):
        one, two = (chain.pose(q, "world", frame).translation for frame in closure.frames)
        np.testing.assert_allclose(one - two, off, atol=1e-12)
