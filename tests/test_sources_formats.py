"""One mechanism, whatever format it is written in, is one analysis."""

import os
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from mechanism_formats import FORMATS, mjcf, numbers, with_loops_at_joints, write_format
from parameter_steps import with_joints
from thinned import thinned

from legcal import load_mechanism
from legcal.cli import main
from legcal.errors import LegcalError, UsageError
from legcal.geometry.types import Array
from legcal.machine import Machine, geometries
from legcal.machine.written import reload_and_check, write_calibrated_yaml, write_model, write_urdf

MACHINES = ("hexapod", "3-upu", "3-rpr", "tricept", "hexapod-strut")

machine_of = cache(load_mechanism)


def _difference(one: Array | float | None, two: Array | float | None) -> float:
    assert (one is None) == (two is None)
    if one is None or two is None:
        return 0.0
    return float(np.nanmax(np.abs(np.nan_to_num(one) - np.nan_to_num(two))))


def assert_same_analysis(found: Machine, expected: Machine) -> None:
    """Check that two mechanisms are one, legs matched by where they stand."""
    assert (found.spatial, found.mobility, found.n_legs) == (
        expected.spatial,
        expected.mobility,
        expected.n_legs,
    )
    assert len(found.motors) == len(expected.motors)
    for wanted in expected.legs:
        leg = min(found.legs, key=lambda leg: float(np.linalg.norm(leg.A - wanted.A)))
        assert (leg.type, leg.kind, leg.sign) == (wanted.type, wanted.kind, wanted.sign)
        assert leg.prismatic == wanted.prismatic
        assert _difference(np.array(leg.travel), np.array(wanted.travel)) == 0.0
        for key in ("A", "B", "q0", "base_axis", "platform_axis", "twist"):
            assert _difference(getattr(leg, key), getattr(wanted, key)) < 1e-9, key
        radii = [[c.radius for c in one.cylinders] for one in (leg, wanted)]
        assert radii[0] == radii[1]
    off = found.home.inv() * expected.home
    assert np.abs(off.as_matrix() - np.eye(4)).max() < 1e-9


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("machine", thinned(MACHINES, ["3-upu", "3-rpr", "tricept"]))
def test_every_format_gives_the_same_analysis(machine: str, name: str, tmp_path: Path) -> None:
    expected = machine_of(machine)
    found = load_mechanism(write_format(expected, name, tmp_path))
    if not name.startswith("mjcf"):  # these have no pose where they are closed
        found = replace(found, home=expected.home)
    assert_same_analysis(found, expected)


def test_slides_and_a_ball_that_nothing_drives_carry_a_platform_freely(tmp_path: Path) -> None:
    expected = machine_of("hexapod")
    joints = "".join(
        f'<joint name="p{i}" type="slide" axis="{numbers(axis)}"/>'
        for i, axis in enumerate(np.eye(3))
    )
    text = mjcf(expected, "sites")
    path = tmp_path / "machine.xml"
    path.write_text(
        text.replace('<freejoint name="platform_free"/>', f'{joints}<joint type="ball"/>')
    )
    assert_same_analysis(load_mechanism(path), expected)


@pytest.mark.parametrize(
    ("machine", "tag"),
    [("3-rpr", "loop_joint"), ("3-rpr", "constraint"), ("3-upu", "constraint")],
)
def test_loops_are_closed_by_revolute_and_universal_joints(
    machine: str, tag: str, tmp_path: Path
) -> None:
    expected = machine_of(machine)
    path = tmp_path / "machine.urdf"
    path.write_text(with_loops_at_joints(expected, tag))
    found = load_mechanism(path)
    assert_same_analysis(replace(found, home=expected.home), expected)


@pytest.mark.parametrize("name", ["mjcf bodies", "mjcf sites", "loop_joint", "gepetto"])
def test_a_calibrated_model_of_any_format_is_complete(name: str, tmp_path: Path) -> None:
    nominal = load_mechanism(write_format(machine_of("hexapod"), name, tmp_path))
    rng = np.random.default_rng(3)
    known = nominal.parameters
    base, platform = known.base_joints.copy(), known.platform_joints.copy()
    moved = [j for j in range(6) if j not in nominal.frame_legs]
    base[moved] += rng.uniform(-1e-3, 1e-3, (3, 3))
    platform[moved] += rng.uniform(-1e-3, 1e-3, (3, 3))
    offsets = known.offsets + rng.uniform(-1e-3, 1e-3, 6)
    calibrated = replace(known, base_joints=base, platform_joints=platform, offsets=offsets)
    write_urdf(nominal, with_joints(geometries(nominal), calibrated), tmp_path / "calibrated.urdf")
    write_calibrated_yaml(nominal, tmp_path / "calibrated.yaml", "calibrated.urdf")
    written = reload_and_check(tmp_path / "calibrated.yaml")
    assert written.leg_names == nominal.leg_names
    assert np.abs(written.parameters.base_joints - base).max() < 1e-12
    assert np.abs(written.parameters.platform_joints - platform).max() < 1e-12
    assert np.abs(written.parameters.offsets - offsets).max() < 1e-12


def test_inspect_writes_a_model_down(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_format(machine_of("hexapod"), "mjcf sites", tmp_path)
    to = tmp_path / "to"
    monkeypatch.setattr("sys.argv", ["legcal", "inspect", str(path), "--write", str(to)])
    with pytest.raises(SystemExit) as done:
        main()
    assert done.value.code == 0
    assert f"Wrote {to / 'models' / 'machine.yaml'}." in capsys.readouterr().err
    assert load_mechanism(to / "models" / "machine.yaml").n_legs == 6
    with pytest.raises(SystemExit) as done:
        main()
    assert done.value.code == 2
    assert "already there" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["mjcf bodies", "loop_joint", "gepetto"])
@pytest.mark.parametrize("machine", ["hexapod", "3-upu"])
def test_what_is_written_down_loads_with_an_equal_analysis(
    machine: str, name: str, tmp_path: Path
) -> None:
    found = load_mechanism(write_format(machine_of(machine), name, tmp_path / "from"))
    yaml_path, urdf_path = write_model(found, tmp_path / "to")
    assert (yaml_path.name, urdf_path.name) == ("machine.yaml", "machine.urdf")
    written = load_mechanism(yaml_path)
    assert_same_analysis(written, found)
    assert written.leg_names == found.leg_names
    assert written.frame_legs == found.frame_legs
    assert written.platform_joint == found.platform_joint


def test_a_urdf_that_needs_no_change_is_copied_byte_for_byte(tmp_path: Path) -> None:
    machine = machine_of("hexapod")
    _, urdf_path = write_model(machine, tmp_path)
    assert urdf_path.read_bytes() == machine.urdf_path.read_bytes()


def test_nothing_is_written_over(tmp_path: Path) -> None:
    machine = machine_of("hexapod")
    write_model(machine, tmp_path)
    with pytest.raises(UsageError, match="already there, needed new files"):
        write_model(machine, tmp_path)


def _gepetto_robots() -> Path | None:
    checkout = os.environ.get("LEGCAL_GEPETTO")
    for robots in (checkout and Path(checkout) / "robots", checkout and Path(checkout)):
        if robots and (robots / "wl16_like").is_dir():
            return robots
    return None


def test_the_six_sps_leg_of_gepetto_is_understood() -> None:
    robots = _gepetto_robots()
    if robots is None:
        pytest.skip("set LEGCAL_GEPETTO to a checkout of Gepetto/example-parallel-robots")
    machine = load_mechanism(robots / "wl16_like")
    assert [leg.type for leg in machine.legs] == ["SPS"] * 6
    assert (machine.mobility, len(machine.motors)) == (6, 6)
    assert (machine.base, machine.platform) == ("hip_part", "foot_part")
    q0 = {leg.prismatic: leg.q0 for leg in machine.legs}
    assert q0["motor_6"] == pytest.approx(0.3582 + 0.198, abs=1e-12)
    assert q0["motor_1"] == pytest.approx(0.4878 + 0.099 + 0.099, abs=1e-12)
    assert any("6 legs have an S joint at both ends" in note for note in machine.diagnostics)


def test_the_other_robots_of_gepetto_are_refused_in_one_sentence() -> None:
    robots = _gepetto_robots()
    if robots is None:
        pytest.skip("set LEGCAL_GEPETTO to a checkout of Gepetto/example-parallel-robots")
    for yaml_path in sorted(robots.glob("*/robot.yaml")):
        if yaml_path.parent.name == "wl16_like":
            continue
        with pytest.raises(LegcalError) as refusal:
            load_mechanism(yaml_path.parent)
        assert "\n" not in refusal.value.problems[0]
