"""What Pinocchio passes over in silence is refused, all problems of a file at once."""

from pathlib import Path

import numpy as np
import pytest
from mechanisms import SHIPPED_URDF, SHIPPED_YAML

from legcal.errors import ModelError
from legcal.machine import load_mechanism
from legcal.machine.urdf import read_urdf

SHIPPED = SHIPPED_URDF.read_text()
LIMIT = '<limit lower="-0.004" upper="0.144" effort="1000" velocity="1"/>'


def _problems(folder: Path, content: str | bytes) -> tuple[str, ...]:
    path = folder / "robot.urdf"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ModelError) as refusal:
        read_urdf(path)
    assert all(str(path) in problem for problem in refusal.value.problems)
    return refusal.value.problems


def _with(old: str, new: str) -> str:
    assert old in SHIPPED
    return SHIPPED.replace(old, new, 1)


def test_the_shipped_urdf_is_one_tree() -> None:
    urdf = read_urdf(SHIPPED_URDF)
    assert urdf.root == "base"
    assert len(urdf.links) == 32
    assert len(urdf.joints) == 31
    slider = urdf.joints["leg1_prismatic"]
    assert (slider.parent, slider.child, slider.type) == ("leg1_b2_link", "leg1_tube", "prismatic")
    assert slider.limits == (-0.004, 0.144)
    np.testing.assert_array_equal(slider.axis, [0.0, 0.0, 1.0])
    np.testing.assert_allclose(slider.T_parent_origin.translation, [0.0, 0.0, 0.345])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('xyz="0.0 0.195 0.0"', 'xyz="0.0 nan 0.0"', 'xyz="0.0 nan 0.0"'),
        ('xyz="0.0 0.195 0.0"', 'xyz="0.0 inf 0.0"', "needed 3 finite numbers"),
        ('xyz="0.0 0.195 0.0"', 'xyz="0.0 1e999 0.0"', "needed 3 finite numbers"),
        ('xyz="0.0 0.195 0.0"', 'xyz="0.0 0.195"', "needed 3 finite numbers"),
        ('xyz="0.0 0.195 0.0"', 'xyz="a b c"', "needed 3 finite numbers"),
        ('upper="0.144"', 'upper="NaN"', 'upper="NaN"'),
        ('axis xyz="0.0 0.0 1.0"', 'axis xyz="0.0 nan 1.0"', "joint 'leg1_prismatic'"),
        ('axis xyz="0.0 0.0 1.0"', 'axis xyz="0 0 0"', "zero axis"),
        ('axis xyz="1.0 0.0 0.0"', 'axis xyz="0 0 0"', "zero axis"),
        ('axis xyz="0.0 0.0 1.0"', 'axis xyz="0 0 2"', "axis of length 2"),
        ('radius="0.01"', 'radius="-0.01"', "needed more than zero"),
        ('radius="0.01" ', "", "<cylinder> without radius"),
        ('length="0.3105"', 'length="long"', "link 'leg1_b2_link'"),
        ('lower="-0.004"', 'lower="0.2"', "limits 0.2 to 0.144"),
        ('lower="-0.004" ', "", "lacks lower"),
        (LIMIT, "", "lacks lower, upper, effort, velocity"),
        ('type="floating"', 'type="spherical"', "has the type 'spherical'"),
        ('type="floating"', 'type="universal"', "has the type 'universal'"),
        (LIMIT, f'{LIMIT}<mimic joint="leg2_prismatic"/>', "has <mimic>"),
        (LIMIT, f'{LIMIT}<parent link="base"/>', "more than one <parent>"),
        ('<parent link="leg1_b2_link"/>', "", "has no <parent link=...>"),
        ('<child link="leg1_tube"/>', "", "has no <child link=...>"),
        ('<parent link="leg1_b2_link"/>', '<parent link="lost"/>', "names the parent link 'lost'"),
        ('<child link="leg1_seat"/>', '<child link="leg1_end"/>', "'leg1_end' a second parent"),
        ('<link name="leg1_seat"/>', '<link name="leg1_end"/>', "a name that 2 of them share"),
        ('joint name="leg2_b1"', 'joint name="leg1_b1"', "a name that 2 of them share"),
        ('<link name="leg1_seat"/>', "<link/>", "link could not be used: it has no name"),
        ('<link name="base"/>', '<link name="base"/><link name="loose"/>', "without a parent"),
        (
            "</robot>",
            '<loop_joint name="l" type="fixed"><link1 link="base"/></loop_joint></robot>',
            "<loop_joint>",
        ),
        ("</robot>", '<constraint name="l"/></robot>', "<constraint>"),
    ],
)
def test_what_a_tree_cannot_mean_is_refused(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    problems = _problems(tmp_path, _with(old, new))
    assert any(message in problem and ", line" in problem for problem in problems) or any(
        message in problem and "without a parent" in problem for problem in problems
    )


def test_links_in_a_cycle_are_refused(tmp_path: Path) -> None:
    text = (
        '<robot name="r"><link name="base"/><link name="a"/><link name="b"/>'
        '<joint name="ab" type="fixed"><parent link="a"/><child link="b"/></joint>'
        '<joint name="ba" type="fixed"><parent link="b"/><child link="a"/></joint></robot>'
    )
    assert "hang from each other in a cycle" in "\n".join(_problems(tmp_path, text))


def test_a_robot_without_links_is_refused(tmp_path: Path) -> None:
    text = '<robot name="r" xmlns:xacro="http://ros.org/wiki/xacro"><xacro:include/></robot>'
    assert "expand it with xacro" in "\n".join(_problems(tmp_path, text))


def test_all_problems_of_a_file_come_together_with_their_lines(tmp_path: Path) -> None:
    text = _with('xyz="0.0 0.195 0.0"', 'xyz="0.0 nan 0.0"').replace(
        'type="floating"', 'type="ball"', 1
    )
    problems = _problems(tmp_path, text)
    assert len(problems) == 2
    assert any(", line 35: joint 'platform_free'" in problem for problem in problems)
    assert all(problem.endswith(".") for problem in problems)


def test_a_cut_off_file_is_refused_with_the_line(tmp_path: Path) -> None:
    problems = _problems(tmp_path, SHIPPED[: len(SHIPPED) // 2])
    assert "copy the file again if it was cut off" in problems[0]
    assert ", line " in problems[0]


@pytest.mark.parametrize("content", ["", "not xml", "<a/>", "<?xml version='1.0'?>"])
def test_what_is_not_a_robot_is_refused(tmp_path: Path, content: str) -> None:
    assert "could not be read" in _problems(tmp_path, content)[0]


@pytest.mark.parametrize(
    "doctype",
    [
        '<!DOCTYPE robot [<!ENTITY a "0.1">]>',
        '<!DOCTYPE robot SYSTEM "http://localhost:9/robot.dtd">',
        '<!DOCTYPE robot [<!ENTITY a SYSTEM "file:///etc/hostname">]>',
        '<!DOCTYPE robot [<!ENTITY a "1"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>',
    ],
)
def test_entities_and_document_types_are_refused(tmp_path: Path, doctype: str) -> None:
    head, rest = SHIPPED.split("\n", 1)
    rest = rest.replace('<link name="base"/>', '<link name="base">&a;</link>')
    text = f"{head}\n{doctype}\n{rest}"
    assert "could not be read" in _problems(tmp_path, text)[0]
    plain = text.replace("&a;</link>", "</link>")
    assert "<!DOCTYPE>" in _problems(tmp_path, plain)[0]


def test_an_undeclared_entity_is_refused(tmp_path: Path) -> None:
    text = _with('<link name="base"/>', '<link name="base">&lost;</link>')
    assert "could not be read" in _problems(tmp_path, text)[0]


def test_utf16_is_refused(tmp_path: Path) -> None:
    text = SHIPPED.replace('encoding="utf-8"', 'encoding="utf-16"')
    assert "needed UTF-8" in _problems(tmp_path, text.encode("utf-16"))[0]


def test_a_robot_without_a_name_is_refused(tmp_path: Path) -> None:
    assert "<robot> without a name" in _problems(tmp_path, _with(' name="hexapod"', ""))[0]


def test_sizes_that_overflow_are_refused(tmp_path: Path) -> None:
    assert "1e300" in _problems(tmp_path, _with("0.195", "1e300"))[0]


@pytest.mark.parametrize(
    "part",
    [
        "<visual/>",
        "<visual><geometry/></visual>",
        '<visual><geometry><mesh filename="package://lost/lost.stl"/></geometry></visual>',
        '<visual><material name="m"><color rgba="a b"/></material></visual>',
    ],
)
def test_visuals_that_are_no_cylinder_do_no_harm(tmp_path: Path, part: str) -> None:
    for name in ("models", "urdf"):
        (tmp_path / name).mkdir()
    text = _with('<link name="leg1_tube">', f'<link name="leg1_tube">{part}')
    (tmp_path / "urdf" / "hexapod.urdf").write_text(text)
    (tmp_path / "models" / "hexapod.yaml").write_bytes(SHIPPED_YAML.read_bytes())
    machine = load_mechanism(tmp_path / "models" / "hexapod.yaml")
    assert [len(leg.cylinders) for leg in machine.legs] == [2] * 6


def test_a_folder_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="found no such file"):
        read_urdf(tmp_path / "none.urdf")
    with pytest.raises(ModelError, match="found a folder"):
        read_urdf(tmp_path)
