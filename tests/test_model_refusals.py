"""What is wrong with a model is refused by file, place and amount, all problems at once.

These are the refusals beside those of the command line (refusal_table.py).
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, files
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml
from layouts import Layout, LegLayout, MachineSpec, write_machine
from machines import ROOT, SHIPPED_URDF, SHIPPED_YAML, of_types, planar
from model_formats import write_format
from scipy.spatial.transform import RigidTransform, Rotation

from legcal import load_mechanism
from legcal.errors import LegcalError, ModelError, OutOfClass
from legcal.geometry.types import Array

Z = np.array([0.0, 0.0, 1.0])


def refused(path: Path, kind: type[LegcalError] = ModelError) -> tuple[str, ...]:
    """Return why a model is refused: sentences of one line each that name its files."""
    with pytest.raises(LegcalError) as refusal:
        load_mechanism(path)
    assert type(refusal.value) is kind, refusal.value
    for problem in refusal.value.problems:
        assert "\n" not in problem
        assert str(path.with_suffix("")) in problem
    return refusal.value.problems


# --- the files of the shipped hexapod, with one thing wrong -------------------------------------

LIMIT = '<limit lower="-0.004" upper="0.144" effort="1000" velocity="1"/>'
FREE = 'name="platform_free" type="floating">'
SEAT = '<parent link="base"/><child link="leg1_seat"/>'
IN_FRAME = (
    '<child link="leg3_b2_link"/><origin xyz="0.0 0.0 0.0" rpy="0.0 0.0 0.0"/><axis xyz="{}"/>'
)
Y_AXIS = IN_FRAME.format("0.0 1.0 0.0")
END = "</robot>"
Rows = list[tuple[str, str, tuple[str, ...]]]  # text, what is put in its place, what is named

URDF: Rows = [
    ('xyz="0.0 0.195 0.0"', 'xyz="0.0 1e999 0.0"', ("line", "3 finite numbers")),
    ('xyz="0.0 0.195 0.0"', 'xyz="0.0 1e300 0.0"', ("line", "1e300")),
    ('xyz="0.0 0.195 0.0"', 'xyz="a b c"', ("line", "3 finite numbers")),
    ('upper="0.144"', 'upper="NaN"', ("line", 'upper="NaN"')),
    ('upper="0.144"', 'upper="-0.004"', ("line", "'leg1_prismatic'", "-0.004")),
    ('upper="0.144"', 'upper="144"', ("travel", "'leg1'", "144 m")),
    ('lower="-0.004" ', "", ("line", "lacks lower")),
    ('axis xyz="0.0 0.0 1.0"', 'axis xyz="0.0 nan 1.0"', ("line", "'leg1_prismatic'")),
    ('axis xyz="1.0 0.0 0.0"', 'axis xyz="0 0 0"', ("line", "zero axis")),
    ('axis xyz="0.0 0.0 1.0"', 'axis xyz="0.0 0.0 2.0"', ("line", "'leg1_prismatic'", "length 2")),
    ('radius="0.01"', 'radius="1e11"', ("<visual> cylinder", "1e+14 mm", "0.0002 to 0.5")),
    ('radius="0.01"', 'radius="0.25"', ("<visual> cylinder", "250 mm", "along leg")),
    ('type="floating"', 'type="universal"', ("line", "'universal'")),
    (LIMIT, f'{LIMIT}<parent link="base"/>', ("line", "more than one <parent>")),
    ('<child link="leg1_tube"/>', "", ("line", "no <child link=...>")),
    ('<link name="leg1_seat"/>', "<link/>", ("line", "no name")),
    (END, f'<loop_joint name="l" type="fixed"><link1 link="base"/></loop_joint>{END}',
     ("line", "<loop_joint>")),
    (END, f'<constraint name="l"/>{END}', ("line", "<constraint>")),
    ('<link name="base"/>', '<link name="base">&lost;</link>', ("could not be read",)),
    ('encoding="utf-8"', 'encoding="utf-16"', ("could not be read",)),
]  # fmt: skip
URDF_OUT_OF_CLASS: Rows = [
    ('<child link="leg3_b2_link"/><origin xyz="0.0 0.0 0.0"',
     '<child link="leg3_b2_link"/><origin xyz="0.0 0.0 0.002"', ("leg3_b1", "leg3_b2", "2 mm")),
    (Y_AXIS, IN_FRAME.format("0.1 1.0 0.0"), ("leg3_b1", "leg3_b2", "from perpendicular")),
    (Y_AXIS, IN_FRAME.format("1.0 0.0 0.0").replace("0.0 0.0 0.0", "0.0 0.002 0.0", 1),
     ("leg3_b1", "leg3_b2", "parallel")),
    (SEAT, SEAT.replace("base", "leg2_tube"), ("another leg or branches",)),
    (FREE, FREE.replace("floating", "planar"), ("platform_free", "axis (1, 0, 0)")),
    (FREE, FREE.replace("floating", "planar") + '<axis xyz="0 0 1"/>',
     ("platform_free", "a planar joint, needed a floating one")),
]  # fmt: skip
YAML: Rows = [
    ("  - leg1\n", "  - leg1\n  - leg2\n", ("legcal.base_frame",)),
    ("version: 1", "version: true", ("legcal.version", "true", "needed 1")),
    ("  version: 1\n", "", ("legcal.version",)),
    ("0.38274", ".inf", ("legcal.home.xyz.2", "finite")),
    ("joint_name: []", "name_mot: []", ("name_mot",)),
    ("- leg1_prismatic\n", "- leg2_prismatic\n", ("name_mot", "'leg2_prismatic'")),
    ("- 3d\n", "", ("closed_loop", "type", "6", "5")),
    ("    leg6: leg6_prismatic\n", "", ("no name", "'leg6_prismatic'")),
    ("leg2: leg2_prismatic", "leg2: leg1_b1", ("already named 'leg1'",)),
    ("leg2: leg2_prismatic", "leg2: platform_free", ("on no leg between base and platform",)),
]
YAML_OUT_OF_CLASS: Rows = [
    ("  platform_joint: platform_free\n", "", ("floating joint 'platform_free'",)),
    ("- - leg6_end\n  - leg6_seat\ntype:\n- 3d\n", "type:\n",
     ("on no chain from base to platform",)),
]  # fmt: skip


def write_hexapod(
    folder: Path, urdf: tuple[str, str] = ("", ""), text: tuple[str, str] = ("", "")
) -> Path:
    """Write the shipped hexapod with something replaced in its URDF, and in its YAML."""
    for source, (old, new) in ((SHIPPED_URDF, urdf), (SHIPPED_YAML, text)):
        content = source.read_text()
        assert old in content
        content = content.replace(old, new, 1).replace("../urdf/", "")
        (folder / source.name).write_text(content)
    return folder / "hexapod.yaml"


OF_FILE = [
    (file, kind, *row)
    for file, kind, rows in (
        ("urdf", ModelError, URDF),
        ("urdf", OutOfClass, URDF_OUT_OF_CLASS),
        ("text", ModelError, YAML),
        ("text", OutOfClass, YAML_OUT_OF_CLASS),
    )
    for row in rows
]


@pytest.mark.parametrize(("file", "kind", "old", "new", "named"), OF_FILE)
def test_what_a_urdf_or_its_yaml_cannot_mean(
    file: str, kind: type[LegcalError], old: str, new: str, named: tuple[str, ...], tmp_path: Path
) -> None:
    problems = refused(write_hexapod(tmp_path, **{file: (old, new)}), kind)
    assert any(all(word in problem for word in named) for problem in problems), problems


def test_all_problems_of_both_files_come_with_their_lines(tmp_path: Path) -> None:
    path = write_hexapod(tmp_path, ('xyz="0.0 0.195 0.0"', 'xyz="0.0 nan 0.0"'))
    urdf = path.with_suffix(".urdf")
    urdf.write_text(urdf.read_text().replace('type="floating"', 'type="ball"'))
    problems = refused(path)
    assert len(problems) == 2
    assert any(", line 35: joint 'platform_free'" in problem for problem in problems)
    path = write_hexapod(tmp_path, text=("0.38274", ".nan"))
    path.write_text(path.read_text().replace("version: 1", "version: 3"))
    assert len(refused(path)) == 2


def test_a_platform_fixed_to_the_base_is_refused(tmp_path: Path) -> None:
    free = ("  platform_joint: platform_free\n", "")
    path = write_hexapod(tmp_path, ('type="floating"', 'type="fixed"'), free)
    assert "fixed to the base" in refused(path, OutOfClass)[0]


@pytest.mark.parametrize(
    "doctype",
    [
        'SYSTEM "http://localhost:9/robot.dtd"',
        '[<!ENTITY a SYSTEM "file:///etc/hostname">]',
        '[<!ENTITY a "1"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]',
    ],
)
def test_entities_of_a_urdf_are_not_followed(tmp_path: Path, doctype: str) -> None:
    link = '<link name="base"/>'
    for text in (link, '<link name="base">&a;</link>'):
        path = write_hexapod(tmp_path, (link, text))
        urdf = path.with_suffix(".urdf")
        urdf.write_text(urdf.read_text().replace("<robot", f"<!DOCTYPE robot {doctype}><robot", 1))
        assert any("DOCTYPE" in p or "could not be read" in p for p in refused(path))


CYCLE = (
    '<robot name="r"><link name="base"/><link name="a"/><link name="b"/>'
    '<joint name="ab" type="fixed"><parent link="a"/><child link="b"/></joint>'
    '<joint name="ba" type="fixed"><parent link="b"/><child link="a"/></joint></robot>'
)
XACRO = '<robot name="r" xmlns:xacro="http://ros.org/wiki/xacro"><xacro:include/></robot>'


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (CYCLE.encode(), "in a cycle"),
        (XACRO.encode(), "xacro"),
        (b"", "could not be read"),
        (b"not xml", "could not be read"),
        (SHIPPED_URDF.read_text().replace("utf-8", "utf-16").encode("utf-16"), "UTF-8"),
    ],
    ids=["cycle", "xacro", "empty", "text", "utf-16"],
)
def test_what_is_no_tree_of_a_robot_is_refused(content: bytes, word: str, tmp_path: Path) -> None:
    path = write_hexapod(tmp_path)
    path.with_suffix(".urdf").write_bytes(content)
    assert word in refused(path)[0]


def test_yaml_is_read_safely(tmp_path: Path) -> None:
    trace = tmp_path / "trace"
    tag = f"x: !!python/object/apply:os.system ['touch {trace}']\ntype:"
    assert "python/object/apply" in refused(write_hexapod(tmp_path, text=("type:", tag)))[0]
    assert not trace.exists()


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
    link = '<link name="leg1_tube">'
    machine = load_mechanism(write_hexapod(tmp_path, (link, link + part)))
    assert [len(leg.cylinders) for leg in machine.legs] == [2] * 6


def test_what_is_no_model_says_what_takes_it(tmp_path: Path) -> None:
    (tmp_path / "dataset.yaml").write_text("model: hexapod\n")
    table = (ROOT / "models" / "tables" / "hexapod.yaml").read_text()
    (tmp_path / "table.csv").write_text(table)
    wrong: dict[str | Path, tuple[str, ...]] = {
        "octopod": ("one of", "hexapod"),
        tmp_path: ("a dataset", f"legcal calibrate {tmp_path} -o OUT"),
        tmp_path / "dataset.yaml": ("a dataset", f"legcal identify {tmp_path},"),
        tmp_path / "table.csv": ("table.csv", "legcal new", "-o DIR"),
    }
    for name, words in wrong.items():
        with pytest.raises(ModelError) as caught:
            load_mechanism(name)
        assert all(word in str(caught.value) for word in words)
        assert len(caught.value.problems) == 1


# --- other formats ------------------------------------------------------------------------------

CONNECT = '<connect body1="leg1_end" body2="leg1_seat" anchor="0 0 0"/>'
JOINT = '<freejoint name="platform_free"/>'
SLIDE = '<joint name="leg1_prismatic" type="slide"'
MOTOR = '<position joint="leg1_prismatic"/>'
WORLD = "<worldbody>"
MJCF: Rows = [
    (WORLD, f'{WORLD}<include file="x.xml"/>', ("include could not be used",)),
    (WORLD, f'{WORLD}<body><composite type="cable"/></body>', ("composite could not",)),
    (WORLD, f'{WORLD}<replicate count="2"/>', ("replicate could not be used",)),
    (CONNECT, CONNECT.replace("1_end", "1_en"), ("'leg1_en' as body1", "mean 'leg1_end'?")),
    (CONNECT, CONNECT.replace('body1="leg1_end"', ""), ("no body1",)),
    (CONNECT, CONNECT.replace('anchor="0 0 0"', ""), ("no anchor",)),
    (CONNECT, CONNECT.replace("0 0 0", "0 0"), ("anchor='0 0'", "3 finite numbers")),
    (CONNECT, CONNECT.replace("0 0 0", "0 nan 0"), ("anchor='0 nan 0'",)),
    (CONNECT, CONNECT.replace("seat", "end"), ("to itself",)),
    (CONNECT, '<connect site1="a" site2="b"/>', ("the site 'a' as site1",)),
    (CONNECT, CONNECT + '<joint joint1="leg1_prismatic" joint2="leg2_prismatic"/>',
     ("couples <joint> coordinates",)),
    (CONNECT, CONNECT + '<conect body1="leg1_end"/>', ("no constraint",)),
    (WORLD, f'{WORLD}<bdy name="x"/>', ("no element of a body",)),
    (WORLD, f'{WORLD}<geom type="cilinder"/>', ("'cilinder'",)),
    (MOTOR, MOTOR + "<motor/>", ("names no joint",)),
    (MOTOR, '<position joint="leg1"/>', ("'leg1'", "not in the file")),
    (MOTOR, '<motor tendon="t"/>', ("tendon",)),
    (MOTOR, '<motor joint="platform_free"/>', ("free joint 'platform_free'",)),
    (SLIDE, SLIDE.replace("slide", "screw"), ("'screw'", "needed free")),
    (SLIDE, SLIDE.replace("leg1", "leg2"), ("which another joint has",)),
    (SLIDE + ' axis="0.0 0.0 1.0"', SLIDE + ' axis="0 0 0"', ("zero axis",)),
    ('<body name="leg2_end"', '<body name="leg1_end"', ("which another body has",)),
    ('<body name="leg2_end"', '<body name="leg2_end" euler="0 0 1"', ("one orientation",)),
    ('quat="1.0 0.0 0.0 0.0"', 'quat="0 0 0 0"', ("no orientation",)),
    ('pos="0.0 0.0 0.0"', 'pos="1e400 0 0"', ("pos='1e400 0 0'", "3 finite numbers")),
    ('range="-0.004 0.144"', 'range="1 -1"', (", line 9: joint 'leg1_prismatic'", "1 to -1")),
    (WORLD, f'<compiler angle="grad"/>{WORLD}', ("angle='grad'", "degree")),
    (WORLD, f'<compiler coordinate="global"/>{WORLD}', ("coordinate='global'",)),
    (WORLD, f'<compiler eulerseq="xyw"/>{WORLD}', ("eulerseq='xyw'",)),
    (WORLD, f'{WORLD}<body childclass="no"/>', ("default class 'no'",)),
    (WORLD, f"<default><default/></default>{WORLD}", ("default class without a",)),
    (JOINT, JOINT + '<joint name="x"/>', ("a body that has other joints",)),
    ('type="capsule" size="0.01"', 'type="capsule" size="0"', ("without a radius",)),
    ("</mujoco>", "</mujoco><mujoco/>", ("well-formed XML",)),
    ("<mujoco", "<sdf/><!--", ("well-formed XML",)),
    ("</worldbody>", "<body/>" * 6000 + "</worldbody>", ("at most 5000",)),
]  # fmt: skip
MJCF_OUT_OF_CLASS: Rows = [
    (CONNECT, CONNECT.replace("leg1_seat", "leg2_tube"),
     ("check <equality>", "root of the tree is the base")),
    ("</worldbody>", '<body name="arm"><joint name="elbow"/></body></worldbody>',
     ("joints of something else", "'elbow'")),
]  # fmt: skip
LINK1 = '<link1 link="leg1_tube"'
LOOPS: Rows = [
    ('type="spherical"', 'type="prismatic"', ("line", "'prismatic'")),
    ('type="spherical"', "", ("line", "the type ''")),
    ('name="loop1"', 'name="loop0"', ("line", "a name that another one has")),
    (LINK1, LINK1.replace("tube", "tub"), ("line", "mean 'leg1_tube'")),
    (LINK1, LINK1.replace("leg1_tube", "base"), ("line", "joins the link 'base' to")),
    (LINK1, LINK1.replace("link1", "link9"), ("line", "names 1 links")),
    (LINK1[1:] + ' xyz="0.0 0.0 0.0"', LINK1[1:] + ' xyz="0 0"', ("line", "xyz='0 0'")),
    ('<joint name="leg1_prismatic"/>', '<joint name="leg"/>', ("line", "is a motor of no")),
]
CONSTRAINTS: Rows = [
    ('type="spherical"', 'type="universal"', ("line", "two axes")),
    ('type="spherical"', 'type="planar"', ("line", "'planar'", "needed one of")),
    ('<child link="base"/>', "", ("line", "names 1 links, needed two")),
    ('type="spherical">', 'type="revolute"><axis xyz="0 0 0"/>', ("line", "zero axis")),
    ('type="spherical">', 'type="revolute"><axis xyz="0 0 1" frame="parent"/>',
     ("line", "frame 'parent' alone")),
]  # fmt: skip
GEPETTO: Rows = [
    ("joint_type:\n- UJOINT_XY", "joint_type:\n- UJOINT_XX", ("'UJOINT_XX'", "SPHERICAL")),
    ("joint_type:\n- UJOINT_XY", "joint_type:\n- BALL", ("'BALL'", "SPHERICAL")),
    ("joint_name:\n- leg1_b1", "joint_name:\n- leg1_b", ("mean 'leg1_b1'",)),
    ("joint_name:\n- leg1_b1", "joint_name:\n- leg2_b1", ("'leg2_b1' twice",)),
    ("name_mot:\n- leg1_prismatic", "name_mot:\n- leg1_b1", ("stands for UJOINT_XY",)),
    ("type:\n- 3D", "type:\n- 4D", ("'4d'", "'3d'")),
]
OF_FORMAT = [
    *[("mjcf bodies", ModelError, *row) for row in MJCF],
    *[("mjcf bodies", OutOfClass, *row) for row in MJCF_OUT_OF_CLASS],
    *[("loop_joint", ModelError, *row) for row in LOOPS],
    *[("constraint", ModelError, *row) for row in CONSTRAINTS],
    *[("gepetto", ModelError, *row) for row in GEPETTO],
    ("gepetto", OutOfClass, "- leg1_seat\n", "- leg2_tube\n", ("add a block legcal with",)),
]


@cache
def hexapod_text(style: str, folder: Path) -> tuple[str, bytes]:
    """Return the name and text of the shipped hexapod in a format, and what stands beside it."""
    path = write_format(load_mechanism("hexapod"), style, folder / style)
    if path.is_dir():
        return (path / "robot.yaml").read_text(), (path / "robot.urdf").read_bytes()
    return path.read_text(), b""


@pytest.fixture(scope="module")
def formats(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("formats")


def written(style: str, formats: Path, folder: Path, edit: Callable[[str], str]) -> Path:
    """Write the shipped hexapod in a format with its text changed."""
    text, urdf = hexapod_text(style, formats)
    suffix = "xml" if style.startswith("mjcf") else "yaml" if urdf else "urdf"
    path = folder / f"robot.{suffix}"
    path.write_text(edit(text))
    if urdf:
        path.with_suffix(".urdf").write_bytes(urdf)
    return path


@pytest.mark.parametrize(("style", "kind", "old", "new", "named"), OF_FORMAT)
def test_what_another_format_cannot_mean(
    style: str,
    kind: type[LegcalError],
    old: str,
    new: str,
    named: tuple[str, ...],
    formats: Path,
    tmp_path: Path,
) -> None:
    assert old in hexapod_text(style, formats)[0]
    path = written(style, formats, tmp_path, lambda text: text.replace(old, new, 1))
    problems = refused(path, kind)
    assert any(all(word in problem for word in named) for problem in problems), problems


def test_all_problems_of_an_mjcf_file_come_at_once(formats: Path, tmp_path: Path) -> None:
    def edit(text: str) -> str:
        text = text.replace(MOTOR, '<position joint="leg1"/>')
        return text.replace(CONNECT, '<connect body1="x" body2="y" anchor="0 0 0"/>')

    assert len(refused(written("mjcf bodies", formats, tmp_path, edit))) == 3


def test_mjcf_without_closures_is_no_parallel_mechanism(formats: Path, tmp_path: Path) -> None:
    for edit in (
        lambda text: text[: text.index("<equality>")] + "</mujoco>",
        lambda text: text.replace("<connect ", '<connect active="false" '),
    ):
        path = written("mjcf bodies", formats, tmp_path, edit)
        assert "without <connect> or <weld>" in refused(path, OutOfClass)[0]


def test_two_mechanisms_in_one_mjcf_file_are_refused(formats: Path, tmp_path: Path) -> None:
    def edit(text: str) -> str:
        second = text.replace('="leg', '="second_leg').replace('"platform', '"second_platform')
        second = second.replace('"base"', '"second_base"')
        body = second[second.index("<body") : second.index("</worldbody>")]
        tail = second[second.index("<equality>") : second.index("</mujoco>")]
        text = text.replace("</worldbody>", f"{body}</worldbody>")
        return text.replace("</mujoco>", f"{tail}</mujoco>")

    (problem,) = refused(written("mjcf bodies", formats, tmp_path, edit), OutOfClass)
    assert "found 2 mechanisms, which have no moving body in common" in problem


def test_what_closes_no_loop_is_left_out_of_an_mjcf_scene(formats: Path, tmp_path: Path) -> None:
    scene = (
        '<light pos="0 0 1"/><geom type="plane" size="1 1 1"/><geom type="mesh" mesh="m"/>'
        '<camera name="c"/><!-- x --><body name="ball"><freejoint/><geom size="1"/></body>'
    )

    def edit(text: str) -> str:
        text = text.replace(MOTOR, f'{MOTOR}<adhesion body="platform"/>')
        text = text.replace('range="-0.004 0.144"', "", 3)  # and the other ranges are no limits
        text = text.replace(WORLD, f'<compiler autolimits="false"/>{WORLD}')
        return text.replace("</worldbody>", f"{scene}</worldbody>")

    machine = load_mechanism(written("mjcf bodies", formats, tmp_path, edit))
    assert machine.leg_names == tuple(f"leg{j}" for j in range(1, 7))
    notes = " ".join(machine.diagnostics)
    assert "Free bodies that touch no loop were left out: 'ball'" in notes
    assert "gives no travel for 6 sliders" in notes
    assert max(leg.travel[1] - leg.travel[0] for leg in machine.legs) < 0.1


def test_a_urdf_with_both_a_yaml_and_loops_says_so(formats: Path, tmp_path: Path) -> None:
    path = written("loop_joint", formats, tmp_path, str)
    text = SHIPPED_YAML.read_text().replace("../urdf/hexapod.urdf", path.name)
    path.with_suffix(".yaml").write_text(text)
    assert "which is not read beside a mechanism YAML" in refused(path)[0]


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


# --- sizes and places ---------------------------------------------------------------------------


def _scaled(machine: MachineSpec, scale: float) -> MachineSpec:
    legs = tuple(replace(leg, A=scale * leg.A, B_home=scale * leg.B_home) for leg in machine.legs)
    home = RigidTransform.from_components(
        scale * np.asarray(machine.home.translation), machine.home.rotation
    )
    return MachineSpec(legs, home)


@pytest.mark.parametrize(("scale", "home"), [(1e3, True), (1e3, False), (1e-4, True)])
def test_lengths_beyond_reason_are_refused_with_or_without_a_home(
    scale: float, home: bool, tmp_path: Path
) -> None:
    path = write_machine(tmp_path, _scaled(of_types(["US"] * 6), scale), Layout(home=home))
    (problem,) = refused(path)
    assert "write all lengths" in problem


def test_frame_legs_on_one_line_are_refused(tmp_path: Path) -> None:
    machine = of_types(["US"] * 6)
    legs = [replace(leg, A=np.array([0.1 * j, 0.0, 0.0])) for j, leg in enumerate(machine.legs[:3])]
    path = write_machine(tmp_path, replace(machine, legs=(*legs, *machine.legs[3:])), Layout())
    (problem,) = refused(path)
    assert "base joints of leg1, leg2, leg3" in problem


# --- machines that the method does not cover ----------------------------------------------------

Joint = tuple[str, Array, Array]  # type, point and axis in the base link
HEIGHT = 0.5


class Drawing:
    """A URDF with chains that hang from the base and are closed on the platform."""

    def __init__(self) -> None:
        self.links = ['<link name="base"/>', '<link name="platform"/>']
        self.joints = [
            '<joint name="free" type="floating"><parent link="base"/>'
            '<child link="platform"/></joint>'
        ]
        self.loops: list[list[str]] = []
        self.kinds: list[str] = []
        self.legs: dict[str, str] = {}  # name and first joint
        self.motors: list[str] = []  # where they are not those first joints

    def chain(
        self,
        name: str,
        root: str,
        at: Array,
        joints: Sequence[Joint],
        *,
        end: Array,
        kind: str,
        on: tuple[str, Array] = ("platform", HEIGHT * Z),
    ) -> None:
        """Hang joints from a link whose origin is at a point; close at ``end``, on the platform."""
        link, origin = root, at
        for i, (joint, point, axis) in enumerate(joints):
            child = f"{name}_{i}"
            self.add(child, joint, link, point - origin, axis)
            link, origin = child, point
        self.add(f"{name}_end", "fixed", link, end - origin)
        self.add(f"{name}_seat", "fixed", on[0], end - on[1])
        self.loops.append([f"{name}_end", f"{name}_seat"])
        self.kinds.append(kind)

    def add(self, name: str, kind: str, parent: str, xyz: Array, axis: Array | None = None) -> None:
        """Add a link and the joint that carries it."""
        self.links.append(f'<link name="{name}"/>')
        moving = ""
        if axis is not None:
            words = " ".join(repr(float(x)) for x in axis)
            moving = (
                f'<axis xyz="{words}"/><limit lower="-0.3" upper="0.5" effort="1" velocity="1"/>'
            )
        words = " ".join(repr(float(x)) for x in xyz)
        self.joints.append(
            f'<joint name="j_{name}" type="{kind}"><parent link="{parent}"/>'
            f'<child link="{name}"/><origin xyz="{words}"/>{moving}</joint>'
        )

    def write(self, folder: Path, *, block: bool = True, driven: bool = True) -> Path:
        """Write the files, with or without a block legcal, and with motors if they are driven."""
        document: dict[str, object] = {
            "closed_loop": self.loops, "type": self.kinds,
            "name_mot": (self.motors or list(self.legs.values())) if driven else [],
        }  # fmt: skip
        if block:
            document["legcal"] = {
                "version": 1, "base": "base", "platform": "platform", "platform_joint": "free",
                "home": {"xyz": [0, 0, HEIGHT], "quat_xyzw": [0, 0, 0, 1]}, "legs": self.legs,
            }  # fmt: skip
        text = f'<robot name="r">{"".join(self.links)}{"".join(self.joints)}</robot>'
        (folder / "r.urdf").write_text(text)
        (folder / "r.yaml").write_text(yaml.safe_dump(document))
        return folder / "r.yaml"


def _around(j: int, radius: float, height: float) -> tuple[Array, Array]:
    """Return a point of three around z, and the tangent there."""
    turn = Rotation.from_euler("z", 120.0 * j, degrees=True)
    return turn.apply([radius, 0.0, height]), turn.apply([0.0, 1.0, 0.0])


def _rod(at: Array, end: Array, tangent: Array) -> list[Joint]:
    """Return the universal joint of a rod."""
    inner = np.cross(tangent, end - at)
    return [("revolute", at, tangent), ("revolute", at, inner / np.linalg.norm(inner))]


def _delta(*, parallelograms: bool, elbows: int = 1) -> Drawing:
    drawing = Drawing()
    for j in range(3):
        (pivot, axis), (elbow, _) = _around(j, 0.2, 0.0), _around(j, 0.35, 0.1)
        end = _around(j, 0.05, HEIGHT)[0]
        if not parallelograms:
            serial: list[Joint] = [("revolute", 0.9 * elbow, axis)] * (elbows - 1)
            joints = [("revolute", pivot, axis), *serial, *_rod(elbow, end, axis)]
            drawing.chain(f"arm{j}", "base", np.zeros(3), joints, end=end, kind="3d")
            drawing.legs[f"arm{j}"] = f"j_arm{j}_0"
            continue
        root = "base"
        for i in range(elbows - 1):
            drawing.add(f"lower{j}_{i}", "revolute", root, -0.05 * Z, axis)
            root = f"lower{j}_{i}"
            drawing.motors.append(f"j_{root}")
        drawing.add(f"arm{j}", "revolute", root, pivot + 0.05 * (elbows - 1) * Z, axis)
        drawing.motors.append(f"j_arm{j}")
        drawing.legs[f"leg{j}"] = f"j_arm{j}"
        for k, out in enumerate((-0.03 * axis, 0.03 * axis)):
            rod = _rod(elbow + out, end + out, axis)
            drawing.chain(f"rod{j}{k}", f"arm{j}", pivot, rod, end=end + out, kind="3d")
    return drawing


def _couplers() -> Drawing:
    """Return a Delta whose parallelograms end on bars that turn on the platform."""
    drawing = Drawing()
    for j in range(3):
        (pivot, axis), (elbow, _) = _around(j, 0.2, 0.0), _around(j, 0.35, 0.1)
        end = _around(j, 0.05, HEIGHT)[0]
        drawing.add(f"arm{j}", "revolute", "base", pivot, axis)
        drawing.add(f"bar{j}", "revolute", "platform", end - HEIGHT * Z, axis)
        drawing.motors.append(f"j_arm{j}")
        for k, out in enumerate((-0.03 * axis, 0.03 * axis)):
            rod, name = _rod(elbow + out, end + out, axis), f"rod{j}{k}"
            on = f"bar{j}", end
            drawing.chain(name, f"arm{j}", pivot, rod, end=end + out, kind="3d", on=on)
            drawing.legs[name] = f"j_{name}_0"
    return drawing


def _bars(joint: str, n_bars: int) -> Drawing:
    """Return four arms whose rods end on the platform, or on bars that a joint connects to it.

    With two hinges they are those of an H4, with one guide those of an I4.
    """
    drawing = Drawing()
    for i in range(n_bars):
        drawing.add(f"bar{i}", joint, "platform", np.array([0.0, 0.1 * i - 0.05, 0.0]), Z)
    for j in range(4):
        turn = Rotation.from_euler("z", 90.0 * j + 45.0, degrees=True)
        pivot, elbow, end = turn.apply([[0.2, 0, 0], [0.35, 0, 0.1], [0.05, 0, HEIGHT]])
        axis = turn.apply([0.0, 1.0, 0.0])
        drawing.add(f"arm{j}", "revolute", "base", pivot, axis)
        drawing.motors.append(f"j_arm{j}")
        i = j // 2
        on = (f"bar{i}", np.array([0.0, 0.1 * i - 0.05, HEIGHT])) if i < n_bars else None
        for k, out in enumerate((-0.03 * axis, 0.03 * axis)):
            rod, name = _rod(elbow + out, end + out, axis), f"rod{j}{k}"
            at = ("platform", HEIGHT * Z) if on is None else on
            drawing.chain(name, f"arm{j}", pivot, rod, end=end + out, kind="3d", on=at)
            drawing.legs[name] = f"j_{name}_0"
    return drawing


def _prs() -> Drawing:
    drawing = Drawing()
    for j in range(3):
        (foot, axis), (end, _) = _around(j, 0.3, 0.0), _around(j, 0.2, HEIGHT)
        joints = [("prismatic", foot, Z), ("revolute", foot, axis)]
        drawing.chain(f"leg{j}", "base", np.zeros(3), joints, end=end, kind="3d")
        drawing.legs[f"leg{j}"] = f"j_leg{j}_0"
    return drawing


def _planar_arms(n_arms: int) -> Drawing:
    drawing = Drawing()
    for j in range(n_arms):
        points = [_around(j, radius, 0.0)[0] for radius in (0.3, 0.35, 0.1)]
        joints: list[Joint] = [("revolute", point, Z) for point in points]
        drawing.chain(f"arm{j}", "base", np.zeros(3), joints, end=points[-1], kind="6d")
        drawing.legs[f"arm{j}"] = f"j_arm{j}_0"
    return drawing


def _hinges() -> Drawing:
    drawing = Drawing()
    for j in range(3):
        point, axis = _around(j, 0.3, HEIGHT)
        hinge: list[Joint] = [("revolute", point, axis)]
        drawing.chain(f"leg{j}", "base", np.zeros(3), hinge, end=point, kind="6d")
        drawing.legs[f"leg{j}"] = f"j_leg{j}_0"
    return drawing


ARMS = ("no slider and 3 joints in different places", "the joint at A moves")
RODS = ("carries 2 rods on the moving link 'arm0'", "the joints at A move")
DRAWN: dict[str, tuple[Callable[[], Drawing], bool, tuple[str, ...]]] = {
    "delta, rods on arms": (lambda: _delta(parallelograms=False), True, ARMS),
    "the same without a block": (lambda: _delta(parallelograms=False), False, ARMS),
    "delta, parallelograms": (lambda: _delta(parallelograms=True), True, RODS),
    "the same without a block ": (lambda: _delta(parallelograms=True), False, RODS),
    "3-PRS": (_prs, True, ("the slider 'j_leg0_0' on the base itself", "the joint at A moves")),
    "five-bar": (lambda: _planar_arms(2), True, ARMS),
    "3-RRR": (lambda: _planar_arms(3), True, ARMS),
    "hinges": (_hinges, True, ("directly between base and platform",)),
}


LOOP = ("a loop inside the leg", "'j_arm0'", "as a leg of its own")
SEVERAL = ("a platform of several bodies", "H4 or I4", "legs end on link 'bar", "joint 'j_bar0'")
DRIVEN: dict[str, tuple[Callable[[], Drawing], bool, tuple[str, ...]]] = {
    "H4": (lambda: _bars("revolute", 2), True, SEVERAL),
    "H4 without a block": (lambda: _bars("revolute", 2), False, SEVERAL),
    "I4": (lambda: _bars("prismatic", 1), True, SEVERAL),
    "a Delta with a fourth arm": (lambda: _bars("revolute", 0), True, (
        "overconstrained (1 of the 4", "joints at A that move")),
    "a Delta with couplers": (_couplers, True, LOOP),
    "arm on arm": (lambda: _delta(parallelograms=False, elbows=2), True, (
        "the leg of motor 'j_arm0_0'", "no slider and 3 joints in different places", "a rod of")),
    "parallelograms of arm on arm": (lambda: _delta(parallelograms=True, elbows=2), True, (
        "the motor 'j_arm0' of 2 rods", "'j_lower0_0'", "arms on arms")),
    "3-RRR": (lambda: _planar_arms(3), True, ("a planar machine whose joints at A move",)),
}  # fmt: skip


@pytest.mark.parametrize("name", DRIVEN)
def test_machines_of_arms_outside_the_method_are_refused_by_name(name: str, tmp_path: Path) -> None:
    draw, block, named = DRIVEN[name]
    (problem,) = refused(draw().write(tmp_path, block=block), OutOfClass)
    assert all(word in problem for word in named), problem


def test_a_platform_named_beside_the_middle_of_an_h4_is_refused(tmp_path: Path) -> None:
    path = _bars("revolute", 2).write(tmp_path)
    path.write_text(path.read_text().replace("platform: platform\n", "platform: bar1\n"))
    text = path.with_suffix(".urdf").read_text()
    free = '<joint name="free" type="floating"><parent link="base"/>'
    text = text.replace(f'{free}<child link="platform"/></joint>', "")
    path.with_suffix(".urdf").write_text(
        text.replace(
            '<parent link="platform"/><child link="bar1"/>',
            '<parent link="bar1"/><child link="platform"/>',
        ).replace(END, f'{free}<child link="bar1"/></joint>{END}')
    )
    assert "legs end on link 'bar0'" in refused(path, OutOfClass)[0]


@pytest.mark.parametrize("name", DRAWN)
def test_machines_outside_the_method_are_refused_with_the_true_reason(
    name: str, tmp_path: Path
) -> None:
    draw, block, named = DRAWN[name]
    (problem,) = refused(draw().write(tmp_path, block=block, driven=False), OutOfClass)
    assert all(word in problem for word in named), problem


def test_chains_without_a_platform_on_legs_are_refused(tmp_path: Path) -> None:
    arm = _planar_arms(1).write(tmp_path).with_suffix(".urdf")
    arm.with_suffix(".yaml").unlink()
    assert "not a parallel mechanism: found a URDF" in refused(arm, OutOfClass)[0]
    links = "".join(f'<link name="{name}"/>' for name in ("base", *"abcde", "end"))
    joints = "".join(
        f'<joint name="j{i}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0.{i + 1} 0.{i * i} 0"/><axis xyz="0 0 1"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
        for i, (parent, child) in enumerate(pairwise(["base", *"abcde"]))
    )
    joints += '<joint name="seat" type="fixed"><parent link="e"/><child link="end"/></joint>'
    (tmp_path / "r.urdf").write_text(f'<robot name="r">{links}{joints}</robot>')
    (tmp_path / "r.yaml").write_text("closed_loop: [[end, base]]\ntype: ['6d']\nname_mot: []\n")
    (problem,) = refused(tmp_path / "r.yaml", OutOfClass)
    assert "one closed chain in which no link is a platform on legs" in problem


def _with_leg(machine: MachineSpec, j: int, **changes: object) -> MachineSpec:
    leg = replace(machine.legs[j], **changes)  # type: ignore[arg-type]
    return replace(machine, legs=(*machine.legs[:j], leg, *machine.legs[j + 1 :]))


def _missing(types: str, by: float) -> MachineSpec:
    """Return a machine whose second slider does not point at its joint, by so much [m]."""
    machine = planar() if types == "RR" else of_types([types] * 3)
    leg = machine.legs[1]
    across = np.cross(leg.u, np.array([0.3, 0.4, 0.5]) if leg.base_axis is None else leg.base_axis)
    moved = leg.B_home + by * across / np.linalg.norm(across)
    return _with_leg(machine, 1, B_home=moved, slides=leg.u)


def _axis_off(types: str, angle: float) -> MachineSpec:
    """Return a machine whose first leg has a base axis (of R) or inner axis (of U) off square."""
    machine = of_types([types] * 3)
    leg = machine.legs[0]
    assert leg.base_axis is not None
    if types == "RS":
        return _with_leg(
            machine, 0, base_axis=np.cos(angle) * leg.base_axis + np.sin(angle) * leg.u
        )
    inner = np.cross(leg.base_axis, leg.u)
    inner /= np.linalg.norm(inner)
    towards = leg.base_axis if types == "US" else np.cross(leg.base_axis, inner)
    return _with_leg(machine, 0, base_inner=np.cos(angle) * inner + np.sin(angle) * towards)


OFF_AXIS = "from perpendicular to the leg"
SPECIFIED: dict[str, tuple[Callable[[], MachineSpec], tuple[str, ...]]] = {
    **{
        f"slider off, {types}": (
            partial(_missing, types, 0.002),
            ("'leg2_slider'", "by 2 mm", "needed at most 0.01"),
        )
        for types in ("US", "RS", "UU", "RR")
    },
    "R off": (lambda: _axis_off("RS", 0.1), ("'leg1_a1'", f"5.73 deg {OFF_AXIS}")),
    "inner axis off": (lambda: _axis_off("UU", 0.1), ("'leg1_a2'", OFF_AXIS, "inner axis of a U")),
    "U off": (lambda: _axis_off("US", 0.02), ("'leg1_a1' and 'leg1_a2'", "1.146 deg")),
    "one leg": (lambda: of_types(["US"]), ("1 leg in space", "at least 3")),
    "two legs": (lambda: of_types(["US"] * 2), ("2 legs in space", "at least 3")),
    "one leg, RR": (lambda: of_types(["RR"]), ("at least 3",)),
    "one leg in a plane": (lambda: planar(kinds=("actuated",)), ("1 leg in a plane", "at least 2")),
    "too many": (
        lambda: replace(of_types(["US"] * 3), legs=of_types(["US"] * 3).legs * 11),
        ("33 legs", "at most 32"),
    ),
    "fixed in a plane": (
        lambda: _with_leg(planar(), 2, type="R", platform_axis=None),
        ("'leg3_slider'", "fixed to the platform"),
    ),
}


@pytest.mark.parametrize("name", SPECIFIED)
def test_legs_outside_the_method_are_refused_with_the_amount(name: str, tmp_path: Path) -> None:
    machine, named = SPECIFIED[name]
    (problem,) = refused(write_machine(tmp_path, machine(), Layout()), OutOfClass)
    assert all(word in problem for word in named), problem


@pytest.mark.parametrize(("types", "scale"), [("US", 1.0), ("RS", 0.1), ("UU", 25.0)])
def test_by_how_much_a_slider_may_miss_its_joint_grows_with_the_machine(
    types: str, scale: float, tmp_path: Path
) -> None:
    near = load_mechanism(write_machine(tmp_path, _scaled(_missing(types, 4e-6), scale), Layout()))
    assert near.home.translation[2] == pytest.approx(0.6 * scale, rel=1e-4)
    path = write_machine(tmp_path, _scaled(_missing(types, 4e-5), scale), Layout())
    (problem,) = refused(path, OutOfClass)
    assert f"by {0.04 * scale:.4g} mm" in problem


def test_three_axes_that_meet_in_two_points_are_no_spherical_joint(tmp_path: Path) -> None:
    text = (ROOT / "urdf" / "6-sps.urdf").read_text()
    old = '<child link="leg1_a3_link"/><origin xyz="0.0 0.0 0.0"'
    assert old in text
    (tmp_path / "6-sps.urdf").write_text(
        text.replace(old, old.replace("0.0 0.0 0.0", "0.0 0.004 0.0"))
    )
    path = tmp_path / "6-sps.yaml"
    path.write_text((ROOT / "models" / path.name).read_text().replace("../urdf/", ""))
    (problem,) = refused(path, OutOfClass)
    assert "meet in two points 4 mm apart" in problem


@pytest.mark.parametrize("drawn", ["RR", "R"])
def test_a_revolute_along_a_leg_between_revolutes_is_refused(drawn: str, tmp_path: Path) -> None:
    path = write_machine(tmp_path, of_types([drawn] * 3), Layout((LegLayout(spin="base"),)))
    (problem,) = refused(path, OutOfClass)
    assert "'leg1_spin' along the leg, and no S joint" in problem


def test_motors_that_turn_are_refused(tmp_path: Path) -> None:
    path = write_machine(tmp_path, planar(), Layout())
    path.write_text(path.read_text().replace("- leg2_slider\n", "- leg2_a1\n", 1))
    (problem,) = refused(path, OutOfClass)
    assert "found the slider 'leg2_slider' beyond the motor 'leg2_a1' on the base" in problem


def test_planar_machines_whose_joints_at_A_move_are_refused(tmp_path: Path) -> None:
    (problem,) = refused(_planar_arms(3).write(tmp_path), OutOfClass)
    assert "found a planar machine whose joints at A move" in problem


@pytest.mark.parametrize("virtual", ["floating", "planar"])
def test_a_planar_loop_that_is_open_across_its_plane_is_refused(
    virtual: str, tmp_path: Path
) -> None:
    path = write_machine(tmp_path, planar(), Layout(virtual=virtual))
    urdf = path.with_suffix(".urdf")
    head, tail = urdf.read_text().split('<child link="leg2_seat"/><origin xyz="')
    (x, y, z), rest = tail.split('"', 1)[0].split(), tail.split('"', 1)[1]
    moved = f"{x} {y} {float(z) + 1e-3}"
    urdf.write_text(f'{head}<child link="leg2_seat"/><origin xyz="{moved}"{rest}')
    (problem,) = refused(path, OutOfClass)
    assert "'leg2_end' and 'leg2_seat' 1 mm and 0.000 deg apart" in problem


def test_a_planar_virtual_joint_in_another_plane_is_refused(tmp_path: Path) -> None:
    path = write_machine(tmp_path, planar((0.0, 0.6, 0.8)), Layout(virtual="planar"))
    urdf = path.with_suffix(".urdf")
    text = urdf.read_text()
    start = text.index("<origin", text.index('name="platform_free"'))
    urdf.write_text(text[:start] + '<origin xyz="0 0 0"' + text[text.index("/>", start) :])
    assert "from the plane in which the legs move" in refused(path, OutOfClass)[0]


def test_a_virtual_joint_that_carries_another_link_is_refused(tmp_path: Path) -> None:
    path = write_machine(tmp_path, of_types(["US"] * 3), Layout())
    urdf = path.with_suffix(".urdf")
    text = urdf.read_text()
    extra = '<link name="plate"/><joint name="p" type="floating"><parent link="base"/>'
    extra += '<child link="plate"/></joint></robot>'
    urdf.write_text(text.replace("</robot>", extra))
    path.write_text(path.read_text().replace("platform_joint: platform_free", "platform_joint: p"))
    assert "floating joint 'platform_free' inside it" in refused(path, OutOfClass)[0]
    text = text.replace('name="platform_free" type="floating"', 'name="free" type="fixed"')
    below = '<parent link="base"/><child link="{}"/>'
    text = text.replace(below.format("platform"), below.format("spare"), 1)
    extra = extra.replace("plate", "platform").replace('<link name="platform"/>', "")
    extra = extra.replace('<parent link="base"/>', '<parent link="leg1_a1_link"/>')
    urdf.write_text(text.replace("</robot>", f'<link name="spare"/>{extra}'))
    assert "found it between the parent 'leg1_a1_link'" in refused(path, OutOfClass)[0]


def test_two_mechanisms_in_one_urdf_are_refused(tmp_path: Path) -> None:
    path = write_machine(tmp_path, of_types(["US"] * 3), Layout())
    text = path.with_suffix(".urdf").read_text()
    body = text[text.index("  <link") : text.index("</robot>")]
    second = body.replace('"leg', '"other').replace('"platform', '"second')
    second = second.replace('  <link name="base"></link>\n', "")
    path.with_suffix(".urdf").write_text(text.replace("</robot>", f"{second}</robot>"))
    document = yaml.safe_load(path.read_text())
    for pair in list(document["closed_loop"]):
        document["closed_loop"].append([name.replace("leg", "other") for name in pair])
        document["type"].append("3d")
    for word in ("second mechanism on the base, with link 'second'", "found 2 mechanisms"):
        path.write_text(yaml.safe_dump(document))
        (problem,) = refused(path, OutOfClass)
        assert word in problem
        document.pop("legcal", None)
