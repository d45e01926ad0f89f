"""Machines as CAD exports draw them: whole robots of meshes, with loops between named frames."""

import re
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

import numpy as np
import pytest
import trimesh
from cad_exports import LENGTH, RADIUS, ROD, SHAFT, write_ankle, write_head_mjcf, write_head_urdf
from machines import written_with

from legcal import load_mechanism, plan
from legcal.errors import ModelError
from legcal.machine.home import home_of_legs
from legcal.machine.model import Machine, readings_at
from legcal.machine.model_writer import write_model
from legcal.machine.parameters import (
    geometries,
    moved_legs,
    parametrization_of,
    reframed,
    vector_of,
)
from legcal.machine.shapes import cylinder_about_z
from legcal.machine.topology import level_rotation


def _check(machine: Machine, radius: float = RADIUS, length: float = LENGTH) -> None:
    """Check the kind of the machine, its rods, and the drawn pose as home."""
    assert [leg.type for leg in machine.legs] == ["RSS"] * 6
    assert machine.mobility == len(machine.motors) == machine.motor_rank == 6
    np.testing.assert_allclose([leg.q0 for leg in machine.legs], length, rtol=0, atol=1e-5)
    assert all(len(leg.cylinders) == 1 for leg in machine.legs)
    seen = [leg.cylinders[0] for leg in machine.legs]
    np.testing.assert_allclose([c.radius for c in seen], radius, rtol=2e-3)
    np.testing.assert_allclose(readings_at(machine, machine.home), 0.0, atol=1e-4)
    level = level_rotation(machine.A_at(np.zeros(6)), machine.B_platform)
    assert (level.inv() * machine.home.rotation).magnitude() < np.radians(0.1)


@pytest.mark.parametrize("write", [write_head_urdf, write_head_mjcf])
def test_a_robot_of_a_cad_export_loads_as_it_is(write: object, tmp_path: Path) -> None:
    machine = load_mechanism(write(tmp_path / "from"))  # type: ignore[operator]
    _check(machine)
    # The longest shaft between eye and collar, seen inside both.
    part = machine.legs[0].cylinders[0]
    assert SHAFT[0] < part.start < part.end < SHAFT[1] + 1e-3
    assert part.end - part.start == pytest.approx(0.063, abs=0.002)
    assert machine.base == "body"
    assert machine.platform == "head"
    said = " ".join(machine.diagnostics)
    assert "'yaw'" in said
    assert "'antenna' close no loop and are held as drawn" in said
    assert "rod.stl" in said
    # Written down it needs nothing that was inferred, and what hides parts still does.
    written = load_mechanism(write_model(machine, tmp_path / "to")[0])
    _check(written)
    assert len(written.occluders) == len(machine.occluders) == 6
    assert written.leg_names == machine.leg_names


def test_another_export_of_a_mesh_is_read_again(tmp_path: Path) -> None:
    path = write_head_urdf(tmp_path)
    _check(load_mechanism(path))
    file = tmp_path / "assets" / "rod.stl"
    thicker = trimesh.load_mesh(file)
    thicker.apply_transform(np.diag([1.0, 1.5, 1.5, 1.0]))
    thicker.export(file)
    _check(load_mechanism(path), radius=1.5 * RADIUS)


def test_an_ankle_of_two_cranks_and_a_universal_joint_loads_and_is_written(tmp_path: Path) -> None:
    machine = load_mechanism(write_ankle(tmp_path / "from"))
    assert [leg.type for leg in machine.legs] == ["RSS", "RSS", "U"]
    assert machine.mobility == len(machine.motors) == machine.motor_rank == 2
    np.testing.assert_allclose([leg.q0 for leg in machine.legs[:2]], ROD, atol=1e-12)
    np.testing.assert_allclose(machine.legs[2].A, 0.0, atol=1e-12)
    # Other numbers of all legs, with those of the universal joint, are in the files.
    parametrization = parametrization_of(machine, twists=True)
    steps = 1e-3 * np.random.default_rng(2).uniform(-1.0, 1.0, len(parametrization))
    wanted = moved_legs(geometries(machine), parametrization.place, steps)
    wanted = reframed(wanted, machine.frame_legs)
    written = written_with(machine, wanted, tmp_path, home_of_legs(machine, wanted, 0.05))
    values = [
        vector_of(parametrization, legs, geometries(machine))
        for legs in (geometries(written), wanted)
    ]
    unwritten = ("gain", "pitch.platform_axis")
    kept = [not any(word in name for word in unwritten) for name in parametrization.names]
    np.testing.assert_allclose(values[0][kept], values[1][kept], rtol=0, atol=1e-9)


def test_a_loop_that_lacks_one_of_its_frames_is_named(tmp_path: Path) -> None:
    path = write_head_urdf(tmp_path)
    text = re.sub(r'<joint name="closing_3_2_frame".*?</joint>', "", path.read_text(), flags=re.S)
    path.write_text(text.replace('<link name="closing_3_2"/>', ""))
    with pytest.raises(ModelError, match="found the frame 'closing_3_1' and"):
        load_mechanism(path)


def test_a_leg_without_a_round_part_gets_a_stated_radius(tmp_path: Path) -> None:
    path = write_head_urdf(tmp_path / "from", mesh=False)
    machine = load_mechanism(path)
    assert not any(leg.cylinders for leg in machine.legs)
    assert "--leg-radius" in " ".join(machine.diagnostics)
    with pytest.raises(ModelError, match="no leg with a visible cylinder"):
        plan(machine)
    _check(load_mechanism(path, leg_radius=0.002), radius=0.002)
    # A square bar is no rod, and a stated radius overrides that of a mesh.
    assert cylinder_about_z(*_bar(4)) is None
    found = cylinder_about_z(*_bar(32))
    assert found is not None
    np.testing.assert_allclose(found, (0.003, 0.0, 0.09), atol=1e-3)
    _check(load_mechanism(write_head_urdf(tmp_path), leg_radius=0.002), radius=0.002)


def _bar(sides: int) -> tuple[np.ndarray, np.ndarray]:
    """Return corners and triangles of a prism of 3 mm radius along z."""
    bar = trimesh.creation.cylinder(0.003, height=0.09, sections=sides)
    return np.add(bar.vertices, [0.0, 0.0, 0.045]), np.asarray(bar.faces)


@pytest.fixture(scope="module")
def reachy_mini() -> Path:
    """The descriptions of the robot Reachy Mini, as its package has them."""
    try:
        found = files("reachy_mini") or []
    except PackageNotFoundError:
        pytest.skip("reachy_mini is not installed: pip install --no-deps reachy_mini")
    (urdf,) = [Path(str(f.locate())) for f in found if f.match("urdf/robot.urdf")]
    return urdf.parents[1]


@pytest.mark.corpus
@pytest.mark.parametrize("name", ["urdf/robot.urdf", "mjcf/reachy_mini.xml"])
def test_a_robot_that_people_have_loads_unedited(reachy_mini: Path, name: str) -> None:
    machine = load_mechanism(reachy_mini / name)
    _check(machine, radius=0.0025, length=0.085)
    said = " ".join(machine.diagnostics)
    assert "'yaw_body'" in said
    assert "close no loop and are held as drawn" in said
    assert "joints of the platform are level over those of the base" in said
