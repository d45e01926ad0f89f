"""Equal mechanisms give equal legs, however their tree is written."""

import pickle
import re
from pathlib import Path

import numpy as np
import pytest
from mechanisms import (
    LAYOUTS,
    SHIPPED_URDF,
    SHIPPED_YAML,
    TRUTH_YAML,
    Geometry,
    Layout,
    geometry,
    poses_near_home,
    write_hexapod,
)
from scipy.spatial.transform import RigidTransform

from legcal.errors import LegcalError, ModelError, OutOfClass, UsageError
from legcal.geometry.types import Array
from legcal.machine import LegKind, forward_kinematics, inverse_kinematics, load_mechanism
from legcal.machine.mobility import mobility


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_layout_of_a_machine_gives_the_same_analysis(name: str, tmp_path: Path) -> None:
    description, layout = geometry(), LAYOUTS[name]
    machine = load_mechanism(write_hexapod(tmp_path, layout, description))
    np.testing.assert_allclose(machine.A_base, description.A, atol=1e-12)
    np.testing.assert_allclose(machine.B_platform, description.B, atol=1e-12)
    np.testing.assert_allclose(machine.q0, description.q0, atol=1e-12)
    assert list(machine.sign) == [layout.sign] * 6
    assert {leg.type for leg in machine.legs} == {name[:3]}
    assert machine.mobility == mobility(machine) == 6
    for leg in machine.legs:
        assert leg.kind is LegKind.ACTUATED
        spans: dict[str, Array] = {c.side: np.array(c.span(0.4)) for c in leg.cylinders}
        hung, far = ("base", "platform") if layout.hung == "base" else ("platform", "base")
        at_hung, at_far = ([0.0, 0.31], [0.1, 0.4]), ([0.09, 0.4], [0.0, 0.3])
        expected = at_hung if layout.hung == "base" else at_far
        np.testing.assert_allclose(spans[hung], expected[0], atol=1e-9)
        np.testing.assert_allclose(spans[far], expected[1], atol=1e-9)
    spins = [note for note in machine.diagnostics if "spin about themselves" in note]
    assert len(spins) == (name[:3] == "SPS")


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_layout_of_a_machine_has_the_same_poses(name: str, tmp_path: Path) -> None:
    description, layout = geometry(), LAYOUTS[name]
    machine = load_mechanism(write_hexapod(tmp_path, layout, description))
    for T in poses_near_home(description, 2):
        lengths = np.linalg.norm(T.apply(description.B) - description.A, axis=1)
        q = layout.sign * (lengths - description.q0)
        np.testing.assert_allclose(inverse_kinematics(machine, T), q, atol=1e-12)
        found = forward_kinematics(machine, q)
        np.testing.assert_allclose(found.as_matrix(), T.as_matrix(), atol=1e-9)


def test_the_shipped_hexapod_loads_by_name_by_yaml_and_by_urdf() -> None:
    found = [load_mechanism(model) for model in ("hexapod", SHIPPED_YAML, SHIPPED_URDF)]
    for machine in found:
        assert machine.name == "hexapod"
        assert machine.leg_names == tuple(f"leg{j}" for j in range(1, 7))
        assert {leg.type for leg in machine.legs} == {"SPU"}
        assert machine.frame_legs == (0, 2, 4)
        assert machine.diagnostics == ()
        np.testing.assert_allclose(machine.q0, 0.345, atol=1e-15)
        np.testing.assert_allclose(machine.legs[0].travel, (-0.004, 0.144))
        assert {c.radius for leg in machine.legs for c in leg.cylinders} == {0.01}


def test_parameters_are_zero_where_the_frames_make_them_zero() -> None:
    xi = load_mechanism(TRUTH_YAML).parameters
    for joints in (xi.base_joints, xi.platform_joints):
        assert np.all(joints[0] == 0.0)
        assert np.all(joints[2, 1:] == 0.0)
        assert joints[4, 2] == 0.0
    assert np.abs(xi.base_joints[1]).min() > 1e-6


def test_leg_order_follows_the_request() -> None:
    machine = load_mechanism("hexapod")
    names = ("leg3", "leg1", "leg2", "leg6", "leg5", "leg4")
    other = machine.with_leg_order(names)
    assert other.leg_names == names
    assert [names[j] for j in other.frame_legs] == ["leg1", "leg3", "leg5"]
    q = inverse_kinematics(machine, machine.home) + np.linspace(0.0, 0.02, 6)
    reordered = q[[machine.leg_names.index(name) for name in names]]
    np.testing.assert_allclose(
        forward_kinematics(other, reordered).as_matrix(),
        forward_kinematics(machine, q).as_matrix(),
        atol=1e-12,
    )
    with pytest.raises(UsageError, match="each of leg1"):
        machine.with_leg_order(["leg1"])


def test_a_mechanism_survives_pickling() -> None:
    machine = load_mechanism("hexapod")
    copy = pickle.loads(pickle.dumps(machine))
    q = inverse_kinematics(machine, machine.home) + 0.01
    np.testing.assert_allclose(
        forward_kinematics(copy, q).as_matrix(),
        forward_kinematics(machine, q).as_matrix(),
        atol=1e-13,
    )


def test_a_file_without_home_gets_one_and_says_so(tmp_path: Path) -> None:
    path = write_hexapod(tmp_path)
    text = path.read_text()
    start, end = text.index("  home:"), text.index("  legs:")
    path.write_text(text[:start] + text[end:])
    machine = load_mechanism(path)
    assert any("legcal.home is not given" in note for note in machine.diagnostics)
    np.testing.assert_allclose(inverse_kinematics(machine, machine.home), [0.075] * 6, atol=1e-8)
    assert machine.home.translation[2] > 0.2
    assert machine.home.rotation.magnitude() < np.deg2rad(60.0)


def test_a_home_outside_the_travel_is_noted(tmp_path: Path) -> None:
    path = write_hexapod(tmp_path)
    path.write_text(path.read_text().replace("0.38274", "0.5"))
    notes = load_mechanism(path).diagnostics
    assert any("outside its travel" in note for note in notes)


def test_a_passive_slider_is_found_and_takes_a_motor_away(tmp_path: Path) -> None:
    path = write_hexapod(tmp_path)
    path.write_text(path.read_text().replace("- leg2_prismatic\n", "", 1))
    machine = load_mechanism(path)
    assert [leg.kind for leg in machine.legs].count(LegKind.PASSIVE) == 1
    assert machine.legs[1].kind is LegKind.PASSIVE
    assert machine.parameters.passive == (1,)
    assert any("mobility 6, motors 5" in note for note in machine.diagnostics)


def _with_rod(folder: Path, length: float) -> Path:
    """Write a hexapod whose leg 4 is a rod of some length, its motor gone."""
    path = write_hexapod(folder)
    path.write_text(path.read_text().replace("- leg4_prismatic\n", "", 1))
    urdf = path.with_suffix(".urdf")
    text = urdf.read_text().replace(
        '"leg4_prismatic" type="prismatic"', '"leg4_prismatic" type="fixed"'
    )
    q0 = repr(float(geometry().q0[3]))
    assert f'xyz="0.0 0.0 {q0}"' in text
    urdf.write_text(text.replace(f'xyz="0.0 0.0 {q0}"', f'xyz="0.0 0.0 {length!r}"'))
    return path


def test_a_rod_is_a_leg_of_constant_length_and_home_settles_on_it(tmp_path: Path) -> None:
    description = geometry()
    length = (
        float(np.linalg.norm(description.home.apply(description.B[3]) - description.A[3])) + 1e-5
    )
    machine = load_mechanism(_with_rod(tmp_path, length))
    rod = machine.legs[3]
    assert (rod.kind, rod.type, rod.travel) == (LegKind.CONSTANT, "SU", (0.0, 0.0))
    assert rod.q0 == pytest.approx(length, abs=1e-12)
    assert machine.mobility == len(machine.motors) == 5
    q = inverse_kinematics(machine, machine.home)
    q[[0, 1, 2, 4, 5]] += np.linspace(0.0, 0.01, 5)
    found = forward_kinematics(machine, q)
    np.testing.assert_allclose(inverse_kinematics(machine, found), q, atol=1e-12)
    with pytest.raises(UsageError, match="leg 'leg4' would be"):
        inverse_kinematics(machine, RigidTransform.from_translation([0.0, 0.0, 0.5]))


def test_a_rod_that_home_does_not_keep_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"leg 'leg4' .* off its constant length"):
        load_mechanism(_with_rod(tmp_path, 0.30))


def _refused(
    folder: Path, error: type[LegcalError], changes: dict[str, str], layout: Layout | None = None
) -> str:
    """Return why a hexapod with changes in its URDF or YAML does not load."""
    path = write_hexapod(folder, layout)
    for file in (path, path.with_suffix(".urdf")):
        text = file.read_text()
        for pattern, replacement in changes.items():
            text = re.sub(pattern, replacement, text)
        file.write_text(text)
    with pytest.raises(error) as refusal:
        load_mechanism(path)
    assert type(refusal.value) is error
    return str(refusal.value)


def test_a_slider_that_misses_the_joint_centre_is_refused_with_the_distance(
    tmp_path: Path,
) -> None:
    change = {r'(child link="leg2_end"/><origin xyz=")0.0 0.0 0.0': r"\g<1>0.0003 0.0004 0.0"}
    message = _refused(tmp_path, OutOfClass, change)
    assert "misses the base joint centre by 0.5 mm" in message
    assert "leg2_prismatic" in message


def test_axes_that_do_not_meet_are_no_universal_joint(tmp_path: Path) -> None:
    change = {r'(child link="leg3_a2_link"/><origin xyz=")0.0 0.0 0.0': r"\g<1>0.0 0.0 0.002"}
    message = _refused(tmp_path, OutOfClass, change)
    assert "'leg3_a1' and 'leg3_a2' miss each other by 2 mm" in message


def test_axes_that_are_not_perpendicular_are_no_universal_joint(tmp_path: Path) -> None:
    change = {r'(child link="leg3_a2_link"/>.*<axis xyz=")0 1 0': r"\g<1>0.1 1 0"}
    assert "from perpendicular" in _refused(tmp_path, OutOfClass, change)


def test_parallel_axes_are_no_universal_joint(tmp_path: Path) -> None:
    change = {
        r'(child link="leg3_a2_link"/><origin xyz=")0.0 0.0 0.0(.*<axis xyz=")0 1 0': (
            r"\g<1>0.0 0.002 0.0\g<2>1 0 0"
        )
    }
    assert "are parallel" in _refused(tmp_path, OutOfClass, change)


def test_three_axes_that_meet_in_two_points_are_no_spherical_joint(tmp_path: Path) -> None:
    change = {r'(child link="leg1_a3_link"/><origin xyz=")0.0 0.0 0.0': r"\g<1>0.0 0.004 0.0"}
    message = _refused(tmp_path, OutOfClass, change, Layout(first="S"))
    assert "meet in two points 4 mm apart" in message


def test_a_universal_joint_that_is_blocked_on_one_axis_is_a_revolute(tmp_path: Path) -> None:
    path = write_hexapod(tmp_path, Layout(welded=True))
    urdf = path.with_suffix(".urdf")
    old = 'name="leg4_a1" type="revolute"'
    urdf.write_text(urdf.read_text().replace(old, old.replace("revolute", "fixed")))
    machine = load_mechanism(path)
    assert machine.legs[3].type == "SPR"
    assert machine.legs[3].platform_axis is not None
    assert machine.mobility == 5


def test_a_motor_that_turns_is_outside_the_method(tmp_path: Path) -> None:
    path = write_hexapod(tmp_path)
    path.write_text(path.read_text().replace("- leg2_prismatic\n", "- leg2_a1\n", 1))
    with pytest.raises(OutOfClass, match=r"motor 'leg2_a1'.*revolute joint"):
        load_mechanism(path)


def test_legs_that_share_a_link_are_refused(tmp_path: Path) -> None:
    change = {r'<parent link="base"/>(<child link="leg1_seat"/>)': r'<parent link="leg2_tube"/>\1'}
    assert "another leg or branches" in _refused(tmp_path, OutOfClass, change)


def test_a_leg_that_ends_in_the_air_is_refused(tmp_path: Path) -> None:
    change = {r"- - leg6_end\n  - leg6_seat\n": "", r"(type:\n- 3d\n)- 3d\n": r"\1"}
    assert "on no chain from base to platform" in _refused(tmp_path, OutOfClass, change)


def test_a_leg_that_is_not_named_is_refused(tmp_path: Path) -> None:
    assert "found no name for the leg with joint 'leg6_prismatic'" in _refused(
        tmp_path, ModelError, {r"    leg6: leg6_prismatic\n": ""}
    )


def test_one_leg_under_two_names_is_refused(tmp_path: Path) -> None:
    assert "already named 'leg1'" in _refused(
        tmp_path, ModelError, {"leg2: leg2_prismatic": "leg2: leg1_a1"}
    )


def test_a_leg_named_by_a_joint_of_base_or_platform_is_refused(tmp_path: Path) -> None:
    assert "on no leg between base and platform" in _refused(
        tmp_path, ModelError, {"leg2: leg2_prismatic": "leg2: platform_free"}
    )


def test_a_virtual_joint_that_is_not_named_is_refused(tmp_path: Path) -> None:
    message = _refused(tmp_path, OutOfClass, {"platform_joint: platform_free": ""})
    assert "floating joint 'platform_free'" in message


def test_a_planar_virtual_joint_is_refused_where_the_legs_move_in_space(tmp_path: Path) -> None:
    change = {'name="platform_free" type="floating">': 'name="platform_free" type="planar">'}
    assert "axis (1, 0, 0)" in _refused(tmp_path, OutOfClass, change)
    change = {
        'name="platform_free" type="floating">(.*?)</joint>': (
            r'name="platform_free" type="planar">\1<axis xyz="0 0 1"/></joint>'
        )
    }
    message = _refused(tmp_path, OutOfClass, change)
    assert "found a planar joint, needed a floating one" in message


def test_a_platform_fixed_to_the_base_is_refused(tmp_path: Path) -> None:
    changes = {'type="floating"': 'type="fixed"', "platform_joint: platform_free": ""}
    assert "fixed to the base" in _refused(tmp_path, OutOfClass, changes)


def test_frame_legs_on_one_line_are_refused(tmp_path: Path) -> None:
    description = geometry()
    description.A[[0, 2, 4]] = [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.2, 0.0, 0.0]]
    path = write_hexapod(tmp_path, None, description)
    with pytest.raises(ModelError, match="base joints of leg1, leg3, leg5 in one point or on one"):
        load_mechanism(path)


def test_lengths_in_millimetres_are_refused(tmp_path: Path) -> None:
    description = geometry()
    scaled = Geometry(
        1e3 * description.A,
        1e3 * description.B,
        1e3 * description.q0,
        RigidTransform.from_components(
            1e3 * np.asarray(description.home.translation), description.home.rotation
        ),
        (-5.0, 155.0),
    )
    path = write_hexapod(tmp_path, None, scaled)
    with pytest.raises(ModelError, match=r"m long at home, needed 1 mm to 20 m; write all lengths"):
        load_mechanism(path)


@pytest.mark.parametrize(("radius", "said"), [("1e11", "1e+14 mm"), ("0.25", "250 mm"),
                                              ("1e-5", "0.01 mm")])  # fmt: skip
def test_a_cylinder_too_thick_or_too_thin_for_its_leg_is_refused(
    radius: str, said: str, tmp_path: Path
) -> None:
    path = tmp_path / "hexapod.yaml"
    path.write_text(SHIPPED_YAML.read_text().replace("../urdf/", ""))
    text = SHIPPED_URDF.read_text().replace('radius="0.01"', f'radius="{radius}"', 1)
    (tmp_path / "hexapod.urdf").write_text(text)
    with pytest.raises(ModelError, match=r"<visual> cylinder of link 'leg\d_\w+'.*") as caught:
        load_mechanism(path)
    assert f"found a radius of {said} along leg" in str(caught.value)
    assert "needed 0.0002 to 0.5 of the length" in str(caught.value)


@pytest.mark.parametrize("scale", [1e11, 1e3, 1e-12])
def test_without_a_home_sizes_beyond_reason_are_asked_about_at_once(
    scale: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if scale > 1.0:  # no home is looked for
        monkeypatch.delattr("legcal.machine.loader.closed_home")
    description = geometry()
    A, B, q0 = scale * description.A, scale * description.B, scale * description.q0
    scaled = Geometry(A, B, q0, description.home, (0.0, 0.15 * scale))
    path = write_hexapod(tmp_path, None, scaled)
    text = path.read_text()
    path.write_text(text[: text.index("  home:")] + text[text.index("  legs:") :])
    with pytest.raises(ModelError, match=r"needed (at most|1 mm to) \d+ m; write all lengths"):
        load_mechanism(path)


def test_travel_in_millimetres_is_refused(tmp_path: Path) -> None:
    description = geometry()
    description = Geometry(
        description.A,
        description.B,
        description.q0,
        description.home,
        (-5.0, 155.0),
    )
    path = write_hexapod(tmp_path, None, description)
    with pytest.raises(ModelError, match=r"travel of leg 'leg1' .* -5 to 155 m, needed at most"):
        load_mechanism(path)


def test_a_rod_that_is_fixed_to_the_platform_shows_its_cylinder() -> None:
    centre = load_mechanism("tricept").legs[3]
    assert centre.type == "UP"
    assert {(c.side, c.radius) for c in centre.cylinders} == {("base", 0.04), ("platform", 0.03)}
