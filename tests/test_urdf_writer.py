"""The calibrated URDF is the nominal one with other numbers, and nothing else."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from lxml import etree
from mechanisms import LAYOUTS, SHIPPED_URDF, SHIPPED_YAML, Layout, geometry, moved, write_hexapod
from parameter_steps import with_joints
from scipy.spatial.transform import RigidTransform

from legcal.errors import DidNotConverge, ModelError, OutOfClass
from legcal.machine import (
    KinematicParameters,
    Machine,
    forward_kinematics,
    geometries,
    inverse_kinematics,
    load_mechanism,
)
from legcal.machine.model_writer import (
    check_closes,
    moved_origins,
    reload_and_check,
    write_calibrated_yaml,
    write_urdf,
)
from legcal.machine.urdf import UrdfPatch

ORIGIN = re.compile(rb"""(<origin\b[^>]*?\bxyz\s*=\s*["'])([^"']*)(["'])""")


def _distance(one: KinematicParameters, two: KinematicParameters) -> float:
    return max(
        float(np.abs(getattr(one, key) - getattr(two, key)).max())
        for key in ("base_joints", "platform_joints", "offsets")
    )


def _canonical(content: bytes) -> bytes:
    """Return a file with other quotes and white space in tags, and without numbers of origins."""
    tree = etree.fromstring(content).getroottree()
    return ORIGIN.sub(rb"\1\3", etree.tostring(tree, method="c14n"))


def _written(machine: Machine, parameters: KinematicParameters, folder: Path) -> Machine:
    write_urdf(machine, with_joints(geometries(machine), parameters), folder / "calibrated.urdf")
    write_calibrated_yaml(machine, folder / "calibrated.yaml", "calibrated.urdf")
    return reload_and_check(folder / "calibrated.yaml")


@pytest.mark.parametrize("name", LAYOUTS)
def test_what_is_written_is_what_is_read_again(name: str, tmp_path: Path) -> None:
    nominal = load_mechanism(write_hexapod(tmp_path / "nominal", LAYOUTS[name]))
    machine = moved(geometry())
    wanted = load_mechanism(write_hexapod(tmp_path / "wanted", Layout(), machine)).parameters
    assert _distance(nominal.parameters, wanted) > 1e-3
    written = _written(nominal, wanted, tmp_path)
    assert _distance(written.parameters, wanted) < 1e-12
    for T, T_nominal in (
        (written.T_base_Rb, nominal.T_base_Rb),
        (written.T_platform_Re, nominal.T_platform_Re),
    ):
        np.testing.assert_allclose(T.as_matrix(), T_nominal.as_matrix(), atol=1e-12)


def test_the_written_model_moves_as_the_wanted_one(tmp_path: Path) -> None:
    nominal = load_mechanism("hexapod")
    wanted = load_mechanism(write_hexapod(tmp_path / "wanted", Layout(), moved(geometry())))
    written = _written(nominal, wanted.parameters, tmp_path)
    q = inverse_kinematics(wanted, wanted.home) + np.linspace(-0.02, 0.03, 6)
    poses = [
        m.T_base_Rb.inv() * forward_kinematics(m, q) * m.T_platform_Re for m in (wanted, written)
    ]
    np.testing.assert_allclose(poses[0].as_matrix(), poses[1].as_matrix(), atol=1e-11)


def test_only_the_intended_numbers_differ(tmp_path: Path) -> None:
    nominal = load_mechanism(SHIPPED_YAML)
    wanted = load_mechanism(write_hexapod(tmp_path / "wanted", Layout(), moved(geometry())))
    _written(nominal, wanted.parameters, tmp_path)
    before, after = SHIPPED_URDF.read_bytes(), (tmp_path / "calibrated.urdf").read_bytes()
    assert _canonical(before) == _canonical(after)
    joints = set(moved_origins(nominal, with_joints(geometries(nominal), wanted.parameters)))
    assert len(joints) == 18
    for old, new in zip(*(etree.fromstring(x).iter("joint") for x in (before, after)), strict=True):
        name = old.get("name", "")
        changed = etree.tostring(old) != etree.tostring(new)
        # leg1 is the origin of both frames: it does not move
        assert name in joints if changed else name not in joints or "leg1_" in name


def test_nominal_parameters_leave_every_byte(tmp_path: Path) -> None:
    nominal = load_mechanism("hexapod")
    write_urdf(nominal, geometries(nominal), tmp_path / "same.urdf")
    assert (tmp_path / "same.urdf").read_bytes() == SHIPPED_URDF.read_bytes()


def test_comments_quotes_white_space_unknown_tags_and_line_ends_survive(tmp_path: Path) -> None:
    path = write_hexapod(tmp_path / "nominal")
    urdf = path.with_suffix(".urdf")
    text = urdf.read_text()
    text = text.replace(
        '<robot name="hexapod">',
        "<!-- é <joint name='leg1_prismatic'><origin xyz='9 9 9'/></joint> -->\n"
        '<robot  name = "hexapod" >\n<gazebo reference="base"><joint name="leg1_a1">'
        '<origin xyz="8 8 8"/></joint></gazebo>\n<transmission name="t"><type>a &gt; b</type>'
        "</transmission>",
    )
    text = re.sub(
        r'(name="leg2_prismatic".*?)<origin xyz="([^"]*)" rpy="([^"]*)"/>',
        r"\1<origin\n\t rpy = '\3'\n\t xyz = '  \2 '  />",
        text,
    )
    text = re.sub(r'(name="leg3_a1" [^>]*>)(.*?)(<origin [^>]*/>)', r"\1\3\2", text)
    urdf.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    nominal = load_mechanism(path)
    wanted = load_mechanism(write_hexapod(tmp_path / "wanted", Layout(), moved(geometry())))
    written = _written(nominal, wanted.parameters, tmp_path)
    assert _distance(written.parameters, wanted.parameters) < 1e-12
    before, after = urdf.read_bytes(), (tmp_path / "calibrated.urdf").read_bytes()
    assert after.count(b"\n") == after.count(b"\r\n")
    assert _canonical(before) == _canonical(after)
    for kept in (b"xyz='9 9 9'", b'xyz="8 8 8"', b"a &gt; b", "<!-- é".encode()):
        assert kept in after


def test_origins_are_added_and_changed_in_place() -> None:
    content = (
        b'<robot name="r"><joint name="a" type="fixed"><parent link="x &gt; y"/></joint>'
        b'<joint name="b" note="1 &gt; 0"><origin rpy="0 0 1"/></joint>'
        b'<joint name="c" type="fixed"><origin/></joint></robot>'
    )
    patch = UrdfPatch(content)
    assert patch.content() == content
    patch.set_origin("a", np.array([0.1, 0.2, 1 / 3]))
    patch.set_origin("b", np.zeros(3))
    patch.set_origin("c", rpy=np.array([0.5, 0.0, -1.0]))
    assert patch.content() == (
        b'<robot name="r"><joint name="a" type="fixed"><origin xyz="0.1 0.2 0.3333333333333333"/>'
        b'<parent link="x &gt; y"/></joint>'
        b'<joint name="b" note="1 &gt; 0"><origin rpy="0 0 1" xyz="0.0 0.0 0.0"/></joint>'
        b'<joint name="c" type="fixed"><origin rpy="0.5 0.0 -1.0"/></joint></robot>'
    )
    with pytest.raises(ModelError, match="found no joint 'd'"):
        patch.set_origin("d", np.zeros(3))


def test_a_platform_that_a_leg_carries_needs_a_link_of_its_own(tmp_path: Path) -> None:
    path = write_hexapod(tmp_path, Layout(hung="base", carried=True))
    urdf = path.with_suffix(".urdf")
    extra = (
        '<link name="camera"/><joint name="camera_mount" type="fixed">'
        '<parent link="CARRIER"/><child link="camera"/></joint></robot>'
    )
    carrier = load_mechanism(path).urdf.joints["platform_carried"].parent
    urdf.write_text(urdf.read_text().replace("</robot>", extra.replace("CARRIER", carrier)))
    nominal = load_mechanism(path)
    with pytest.raises(OutOfClass, match="leg 'leg1' could not be written: found that joint"):
        write_urdf(nominal, geometries(nominal), tmp_path / "calibrated.urdf")
    assert not (tmp_path / "calibrated.urdf").exists()


def test_a_closure_frame_that_carries_other_things_cannot_be_written(tmp_path: Path) -> None:
    path = write_hexapod(tmp_path)
    urdf = path.with_suffix(".urdf")
    extra = (
        '<link name="camera"/><joint name="camera_mount" type="fixed"><parent link="leg3_seat"/>'
        '<child link="camera"/></joint></robot>'
    )
    urdf.write_text(urdf.read_text().replace("</robot>", extra))
    nominal = load_mechanism(path)
    with pytest.raises(OutOfClass, match="'leg3_seat' on a link that carries other things"):
        write_urdf(nominal, geometries(nominal), tmp_path / "calibrated.urdf")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("  urdf: ../urdf/hexapod.urdf\n", "  urdf: calibrated.urdf\n"),
        ("  urdf: '../urdf/hexapod.urdf'  # here\n", "  urdf: calibrated.urdf  # here\n"),
        ("", ""),
    ],
)
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_the_yaml_changes_in_one_value_only(
    tmp_path: Path, mark: str, text: str, expected: str
) -> None:
    shipped = SHIPPED_YAML.read_text()
    line = "  urdf: ../urdf/hexapod.urdf\n"
    for name in ("models", "urdf"):
        (tmp_path / name).mkdir()
    (tmp_path / "urdf" / "hexapod.urdf").write_bytes(SHIPPED_URDF.read_bytes())
    path = tmp_path / "models" / "hexapod.yaml"
    comment = f"{mark}# ünïcode\r\n"
    path.write_bytes((comment + shipped.replace(line, text)).encode())
    write_calibrated_yaml(load_mechanism(path), tmp_path / "calibrated.yaml", "calibrated.urdf")
    written = (tmp_path / "calibrated.yaml").read_bytes().decode()
    if text:
        assert written == comment + shipped.replace(line, expected)
    else:
        added = "legcal:\n  urdf: calibrated.urdf\n  version: 1\n"
        assert written == comment + shipped.replace(line, "").replace(
            "legcal:\n  version: 1\n", added
        )


def test_a_mechanism_that_does_not_close_at_home_is_noticed() -> None:
    machine = load_mechanism("hexapod")
    check_closes(machine)
    mirror = RigidTransform.from_components(
        machine.home.translation * np.array([1.0, 1.0, -1.0]), machine.home.rotation
    )
    below = replace(machine, home=mirror)
    with pytest.raises(DidNotConverge, match="does not close at home"):
        check_closes(below)
