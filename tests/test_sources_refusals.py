"""Every malformed mechanism of another format is refused in one sentence that names its place."""

from pathlib import Path

import pytest
from mechanism_formats import mjcf, write_format

from legcal import load_mechanism
from legcal.errors import LegcalError, ModelError, OutOfClass
from legcal.machine.formats import read_source

HEXAPOD = load_mechanism("hexapod")
MJCF = mjcf(HEXAPOD, "bodies")
SITES = mjcf(HEXAPOD, "sites")
DEFAULTS = mjcf(HEXAPOD, "defaults")
CONNECT = '<connect body1="leg1_end" body2="leg1_seat" anchor="0 0 0"/>'
FREE = '<freejoint name="platform_free"/>'
SLIDE = '<joint name="leg1_prismatic" type="slide"'
MOTOR = '<position joint="leg1_prismatic"/>'


def _problems(path: Path, kind: type[LegcalError] = ModelError) -> list[str]:
    with pytest.raises(kind) as refusal:
        load_mechanism(path)
    for problem in refusal.value.problems:
        assert "\n" not in problem
        assert str(path) in problem
    return list(refusal.value.problems)


def _mjcf_problems(
    folder: Path, old: str, new: str, text: str = MJCF, kind: type[LegcalError] = ModelError
) -> list[str]:
    assert old in text
    path = folder / "machine.xml"
    path.write_text(text.replace(old, new, 1))
    return _problems(path, kind)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<worldbody>", '<worldbody><include file="x.xml"/>', "include could not be used"),
        ("<worldbody>", '<worldbody><body><composite type="cable"/></body>', "composite could not"),
        ("<worldbody>", '<worldbody><replicate count="2"/>', "replicate could not be used"),
        (CONNECT, '<connect body1="leg1_en" body2="leg1_seat" anchor="0 0 0"/>',
         "names the body 'leg1_en' as body1, which is not in the file; did you mean 'leg1_end'?"),
        (CONNECT, '<connect body2="leg1_seat" anchor="0 0 0"/>', "has no body1; name the body"),
        (CONNECT, '<connect body1="leg1_end" body2="leg1_seat"/>', "has no anchor"),
        (CONNECT, '<connect body1="leg1_end" body2="leg1_seat" anchor="0 0"/>',
         "has anchor='0 0', needed 3 finite numbers"),
        (CONNECT, '<connect body1="leg1_end" body2="leg1_seat" anchor="0 nan 0"/>', "='0 nan"),
        (CONNECT, '<connect body1="leg1_end" body2="leg1_end" anchor="0 0 0"/>', "to itself"),
        (CONNECT, '<connect site1="a" site2="b"/>', "names the site 'a' as site1, which is not"),
        (CONNECT, CONNECT + '<joint joint1="leg1_prismatic" joint2="leg2_prismatic"/>',
         "couples <joint> coordinates, which is not followed"),
        (CONNECT, CONNECT + '<conect body1="leg1_end"/>', "no constraint that legcal knows"),
        ("<worldbody>", '<worldbody><bdy name="x"/>', "is no element of a body"),
        ("<worldbody>", '<worldbody><geom type="cilinder"/>', "type 'cilinder', needed one of pla"),
        (MOTOR, MOTOR + "<motor/>", "names no joint; name the slide"),
        (MOTOR, '<position joint="leg1"/>', "names the joint 'leg1', which is not in the file"),
        (MOTOR, '<motor tendon="t"/>', "drives by tendon, which is no joint with a reading"),
        (MOTOR, '<motor joint="platform_free"/>', "measures the free joint 'platform_free'"),
        (SLIDE, '<joint name="leg1_prismatic" type="screw"', "has the type 'screw', needed free"),
        (SLIDE, '<joint name="leg2_prismatic" type="slide"', "which another joint has"),
        (SLIDE + ' axis="0.0 0.0 1.0"', SLIDE + ' axis="0 0 0"', "has a zero axis"),
        ('<body name="leg2_end"', '<body name="leg1_end"', "which another body has"),
        ('<body name="leg2_end"', '<body name="leg2_end" euler="0 0 1"', "needed one orientation"),
        ('quat="1.0 0.0 0.0 0.0"', 'quat="0 0 0 0"', "which gives no orientation"),
        ('pos="0.0 0.0 0.0"', 'pos="1e400 0 0"', "has pos='1e400 0 0', needed 3 finite numbers"),
        ("<worldbody>", '<compiler angle="grad"/><worldbody>', "has angle='grad', needed degree"),
        ("<worldbody>", '<compiler coordinate="global"/><worldbody>', "coordinate='global'"),
        ("<worldbody>", '<compiler eulerseq="xyw"/><worldbody>', "eulerseq='xyw', needed three"),
        ("<worldbody>", '<worldbody><body childclass="no"/>', "names the default class 'no'"),
        ("<worldbody>", "<default><default/></default><worldbody>", "a default class without a"),
        (FREE, FREE + '<joint name="x"/>', "frees a body that has other joints"),
        ('type="capsule" size="0.01"', 'type="capsule" size="0"', "without a radius and a length"),
        ("<mujoco", '<!DOCTYPE a [<!ENTITY b "c">]><mujoco', "document type"),
        ("</mujoco>", "", "needed well-formed XML"),
        ("</mujoco>", "</mujoco><mujoco/>", "needed well-formed XML"),
        ("<mujoco", "<sdf/><!--", "needed well-formed XML"),
    ],
)  # fmt: skip
def test_mjcf_that_is_malformed_or_not_covered(
    old: str, new: str, message: str, tmp_path: Path
) -> None:
    assert any(message in problem for problem in _mjcf_problems(tmp_path, old, new))


def test_ranges_are_given_from_their_lower_end(tmp_path: Path) -> None:
    problems = _mjcf_problems(tmp_path, 'range="-0.004 0.144"', 'range="1 -1"')
    assert "has the range 1 to -1; give the lower end first" in problems[0]
    assert ", line 9: joint 'leg1_prismatic' could not be used" in problems[0]


def test_all_problems_of_an_mjcf_file_are_told_at_once(tmp_path: Path) -> None:
    text = MJCF.replace(MOTOR, '<position joint="leg1"/>')
    new = '<connect body1="x" body2="y" anchor="0 0 0"/>'
    assert len(_mjcf_problems(tmp_path, CONNECT, new, text)) == 3


def test_mjcf_without_closures_is_no_parallel_mechanism(tmp_path: Path) -> None:
    text = MJCF[: MJCF.index("<equality>")] + "</mujoco>"
    path = tmp_path / "machine.xml"
    path.write_text(text)
    assert "an MJCF file without <connect> or <weld>" in _problems(path, OutOfClass)[0]
    path.write_text(MJCF.replace("<connect ", '<connect active="false" '))
    assert "without <connect> or <weld>" in _problems(path, OutOfClass)[0]


def test_messages_name_what_the_format_has(tmp_path: Path) -> None:
    between = '<connect body1="leg1_end" body2="leg2_tube"'
    old = '<connect body1="leg1_end" body2="leg1_seat"'
    (problem,) = _mjcf_problems(tmp_path, old, between, kind=OutOfClass)
    assert problem.endswith("; check <equality> and that the root is the base.")
    source = read_source(write_format(HEXAPOD, "gepetto", tmp_path / "gepetto"))
    for key in ("write legcal.home.", "correct legcal.base or legcal.platform."):
        assert "add a block legcal with" in source.in_its_words(key)
    assert read_source("hexapod").in_its_words("write legcal.home.") == "write legcal.home."


def test_two_mechanisms_in_one_file_are_refused(tmp_path: Path) -> None:
    second = MJCF.replace('="leg', '="second_leg').replace('"platform', '"second_platform')
    second = second.replace('"base"', '"second_base"')
    body = second[second.index("<body") : second.index("</worldbody>")]
    tail = second[second.index("<equality>") : second.index("</mujoco>")]
    text = MJCF.replace("</worldbody>", f"{body}</worldbody>").replace(
        "</mujoco>", tail + "</mujoco>"
    )
    path = tmp_path / "machine.xml"
    path.write_text(text)
    assert (
        "found 2 mechanisms, which have no moving body in common" in _problems(path, OutOfClass)[0]
    )


def test_another_machine_beside_the_mechanism_is_refused(tmp_path: Path) -> None:
    arm = '<body name="arm"><joint name="elbow"/></body></worldbody>'
    problems = _mjcf_problems(tmp_path, "</worldbody>", arm, kind=OutOfClass)
    assert "joints of something else beside it ('elbow')" in problems[0]


def test_free_bodies_lights_and_meshes_of_a_scene_are_left_out(tmp_path: Path) -> None:
    scene = (
        '<light pos="0 0 1"/><geom type="plane" size="1 1 1"/><geom type="mesh" mesh="m"/>'
        '<body name="ball"><freejoint/><geom size="1"/></body></worldbody>'
    )
    path = tmp_path / "machine.xml"
    path.write_text(MJCF.replace("</worldbody>", scene))
    machine = load_mechanism(path)
    assert machine.n_legs == 6
    assert any("Free bodies that touch no loop were left out: 'ball'" in note
               for note in machine.diagnostics)  # fmt: skip


def test_what_moves_no_joint_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "machine.xml"
    more = '<worldbody><camera name="c"/><light/><geom type="box" size="1 1 1"/><!-- x -->'
    text = MJCF.replace("<worldbody>", more)
    path.write_text(text.replace(MOTOR, f'{MOTOR}<adhesion body="platform"/>'))
    assert load_mechanism(path).leg_names == HEXAPOD.leg_names


def test_slides_without_a_range_are_noted(tmp_path: Path) -> None:
    path = tmp_path / "machine.xml"
    path.write_text(MJCF.replace('range="-0.004 0.144"', ""))
    machine = load_mechanism(path)
    assert any("gives no travel for 6 sliders" in note for note in machine.diagnostics)
    reach = [leg.travel[1] - leg.travel[0] for leg in machine.legs]
    assert max(reach) < 0.1


@pytest.mark.parametrize("content", [b"", b"   ", b"\x00\x01", b"<a/>", b"\xff\xfe<\x00"])
def test_files_that_are_no_mechanism(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "machine.xml"
    path.write_bytes(content)
    assert len(_problems(path)) == 1


def test_a_huge_file_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "machine.xml"
    path.write_bytes(b"<mujoco>" + b" " * 5_000_000 + b"</mujoco>")
    assert "needed at most 4000000" in _problems(path)[0]


def test_a_file_with_thousands_of_bodies_is_not_followed(tmp_path: Path) -> None:
    problems = _mjcf_problems(tmp_path, "</worldbody>", "<body/>" * 6000 + "</worldbody>")
    assert "needed at most 5000" in problems[0]


def test_a_folder_without_robot_yaml(tmp_path: Path) -> None:
    assert "found a folder without robot.yaml" in _problems(tmp_path)[0]


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("loop_joint", 'type="spherical"', 'type="prismatic"', "closes a loop with the type 'pris"),
        ("loop_joint", 'type="spherical"', "", "closes a loop with the type ''"),
        ("loop_joint", 'name="loop1"', 'name="loop0"', "has a name that another one has"),
        ("loop_joint", '<link1 link="leg1_tube"', '<link1 link="leg1_tub"', "mean 'leg1_tube'"),
        ("loop_joint", '<link1 link="leg1_tube"', '<link1 link="base"', "joins the link 'base' to"),
        ("loop_joint", '<link1 link="leg1_tube"', '<link9 link="leg1_tube"', "names 1 links"),
        ("loop_joint", 'link1 link="leg1_tube" xyz="0.0 0.0 0.0"',
         'link1 link="leg1_tube" xyz="0 0"', "has xyz='0 0', needed 3 finite numbers"),
        ("loop_joint", '<joint name="leg1_prismatic"/>', '<joint name="leg"/>', "is a motor of no"),
        ("constraint", 'type="spherical"', 'type="universal"', "has not two axes"),
        ("constraint", 'type="spherical"', 'type="planar"', "type 'planar', needed one of"),
        ("constraint", '<child link="base"/>', "", "names 1 links, needed two"),
        ("constraint", 'type="spherical">', 'type="revolute"><axis xyz="0 0 0"/>', "a zero axis"),
        ("constraint", 'type="spherical">', 'type="revolute"><axis xyz="0 0 1" frame="parent"/>',
         "gives its axis in the frame 'parent' alone"),
    ],
)  # fmt: skip
def test_loops_that_are_malformed_or_not_covered(
    name: str, old: str, new: str, message: str, tmp_path: Path
) -> None:
    path = write_format(HEXAPOD, name, tmp_path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    problems = _problems(path)
    assert any(message in problem for problem in problems)
    assert ", line " in problems[0]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("joint_type:\n- UJOINT_XY", "joint_type:\n- UJOINT_XX", "found 'UJOINT_XX', needed SPHER"),
        (
            "joint_type:\n- UJOINT_XY",
            "joint_type:\n- BALL",
            "found 'BALL', needed SPHERICAL",
        ),
        ("joint_name:\n- leg1_b1", "joint_name:\n- leg1_b", "did you mean 'leg1_b1'"),
        ("joint_name:\n- leg1_b1", "joint_name:\n- leg2_b1", "found 'leg2_b1' twice"),
        ("name_mot:\n- leg1_prismatic", "name_mot:\n- leg1_b1", "which stands for UJOINT_XY"),
        ("type:\n- 3D", "type:\n- 4D", "found '4d', needed '3d'"),
    ],
)
def test_stand_ins_that_are_malformed(old: str, new: str, message: str, tmp_path: Path) -> None:
    path = write_format(HEXAPOD, "gepetto", tmp_path) / "robot.yaml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    assert any(message in problem for problem in _problems(path))


def test_a_urdf_with_both_a_yaml_and_loops_says_so(tmp_path: Path) -> None:
    path = write_format(HEXAPOD, "loop_joint", tmp_path)
    path.with_suffix(".yaml").write_bytes(HEXAPOD.yaml_path.read_bytes())
    yaml_text = path.with_suffix(".yaml").read_text()
    path.with_suffix(".yaml").write_text(yaml_text.replace("../urdf/hexapod.urdf", path.name))
    assert "which is not read beside a mechanism YAML" in _problems(path)[0]
