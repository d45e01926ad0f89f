"""Machines that the method does not cover are refused in one sentence with the true reason."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from layouts import Layout, MachineSpec, write_machine
from machines import MACHINES, of_types, planar
from scipy.spatial.transform import Rotation

from legcal.errors import LegcalError, OutOfClass
from legcal.geometry.types import Array
from legcal.machine import load_mechanism

Z = (0.0, 0.0, 1.0)
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
        self.legs: dict[str, str] = {}

    def chain(
        self, name: str, root: str, at: Array, joints: Sequence[Joint], *, end: Array, kind: str
    ) -> None:
        """Hang joints from a link whose origin is at a point; close on the platform at ``end``."""
        link, origin = root, at
        for i, (joint, point, axis) in enumerate(joints):
            child = f"{name}_{i}"
            self._add(child, joint, link, child, point - origin, axis)
            link, origin = child, point
        self._add(f"{name}_end", "fixed", link, f"{name}_end", end - origin, None)
        seat = end - [0.0, 0.0, HEIGHT]
        self._add(f"{name}_seat", "fixed", "platform", f"{name}_seat", seat, None)
        self.loops.append([f"{name}_end", f"{name}_seat"])
        self.kinds.append(kind)

    def _add(
        self, name: str, kind: str, parent: str, child: str, xyz: Array, axis: Array | None
    ) -> None:
        self.links.append(f'<link name="{child}"/>')
        moving = ""
        if axis is not None:
            words = " ".join(repr(float(x)) for x in axis)
            moving = (
                f'<axis xyz="{words}"/><limit lower="-0.3" upper="0.5" effort="1" velocity="1"/>'
            )
        words = " ".join(repr(float(x)) for x in xyz)
        self.joints.append(
            f'<joint name="j_{name}" type="{kind}"><parent link="{parent}"/>'
            f'<child link="{child}"/><origin xyz="{words}"/>{moving}</joint>'
        )

    def refusal(self, folder: Path, motors: Sequence[str], *, block: bool = True) -> str:
        """Write the files, load them, and return the one sentence of the refusal."""
        document: dict[str, object] = {
            "closed_loop": self.loops,
            "type": self.kinds,
            "name_mot": list(motors),
        }
        if block:
            document["legcal"] = {
                "version": 1, "base": "base", "platform": "platform", "platform_joint": "free",
                "home": {"xyz": [0, 0, HEIGHT], "quat_xyzw": [0, 0, 0, 1]}, "legs": self.legs,
            }  # fmt: skip
        (folder / "r.urdf").write_text(
            f'<robot name="r">{"".join(self.links)}{"".join(self.joints)}</robot>'
        )
        (folder / "r.yaml").write_text(yaml.safe_dump(document))
        return _refusal(folder / "r.yaml")


def _refusal(path: Path) -> str:
    with pytest.raises(OutOfClass) as refusal:
        load_mechanism(path)
    assert len(refusal.value.problems) == 1
    assert "\n" not in refusal.value.problems[0]
    return refusal.value.problems[0]


def _around(j: int, radius: float, height: float) -> tuple[Array, Array]:
    """Return a point of three around z, and the tangent there."""
    turn = Rotation.from_euler("z", 120.0 * j, degrees=True)
    return turn.apply([radius, 0.0, height]), turn.apply([0.0, 1.0, 0.0])


def _universal(u: Array, tangent: Array) -> list[Array]:
    inner = np.cross(tangent, u)
    return [tangent, inner / np.linalg.norm(inner)]


@pytest.mark.parametrize("block", [True, False])
def test_a_delta_whose_rods_hang_on_arms_is_refused(tmp_path: Path, block: bool) -> None:
    drawing = Drawing()
    for j in range(3):
        (pivot, axis), (elbow, _), (end, _) = (
            _around(j, 0.2, 0.0), _around(j, 0.35, 0.1), _around(j, 0.05, HEIGHT),
        )  # fmt: skip
        rod = [("revolute", elbow, a) for a in _universal(end - elbow, axis)]
        joints = [("revolute", pivot, axis), *rod]
        drawing.chain(f"arm{j}", "base", np.zeros(3), joints, end=end, kind="3d")
        drawing.legs[f"arm{j}"] = f"j_arm{j}_0"
    message = drawing.refusal(tmp_path, [f"j_arm{j}_0" for j in range(3)], block=block)
    assert "no slider and 3 joints in different places" in message
    assert "the joint at A moves" in message


@pytest.mark.parametrize("block", [True, False])
def test_a_delta_with_parallelograms_is_refused(tmp_path: Path, block: bool) -> None:
    drawing = Drawing()
    for j in range(3):
        (pivot, axis), (elbow, _), (end, _) = (
            _around(j, 0.2, 0.0), _around(j, 0.35, 0.1), _around(j, 0.05, HEIGHT),
        )  # fmt: skip
        drawing._add(f"arm{j}", "revolute", "base", f"arm{j}", pivot, axis)
        drawing.legs[f"leg{j}"] = f"j_arm{j}"
        for k, side in enumerate((-0.03, 0.03)):
            place = elbow + side * axis
            rod: list[Joint] = [("revolute", place, a) for a in _universal(end - elbow, axis)]
            drawing.chain(f"rod{j}{k}", f"arm{j}", pivot, rod, end=end + side * axis, kind="3d")
    message = drawing.refusal(tmp_path, [f"j_arm{j}" for j in range(3)], block=block)
    assert "carries 2 rods on the moving link 'arm0', so that the joints at A move" in message


def test_a_3_prs_whose_sliders_stand_on_the_base_is_refused(tmp_path: Path) -> None:
    drawing = Drawing()
    for j in range(3):
        (foot, axis), (end, _) = _around(j, 0.3, 0.0), _around(j, 0.2, HEIGHT)
        joints = [("prismatic", foot, np.array(Z)), ("revolute", foot, axis)]
        drawing.chain(f"leg{j}", "base", np.zeros(3), joints, end=end, kind="3d")
        drawing.legs[f"leg{j}"] = f"j_leg{j}_0"
    message = drawing.refusal(tmp_path, [f"j_leg{j}_0" for j in range(3)])
    assert "the slider 'j_leg0_0' on the base itself, so that the joint at A moves" in message


def _planar_arms(n_arms: int) -> Drawing:
    drawing = Drawing()
    for j in range(n_arms):
        (pivot, _), (elbow, _), (end, _) = (
            _around(j, 0.3, 0.0), _around(j, 0.35, 0.0), _around(j, 0.1, 0.0),
        )  # fmt: skip
        joints: list[Joint] = [("revolute", point, np.array(Z)) for point in (pivot, elbow, end)]
        drawing.chain(f"arm{j}", "base", np.zeros(3), joints, end=end, kind="6d")
        drawing.legs[f"arm{j}"] = f"j_arm{j}_0"
    return drawing


@pytest.mark.parametrize("n_arms", [2, 3])
def test_a_five_bar_and_a_3_rrr_are_refused(tmp_path: Path, n_arms: int) -> None:
    message = _planar_arms(n_arms).refusal(tmp_path, [f"j_arm{j}_0" for j in range(n_arms)])
    assert "no slider and 3 joints in different places" in message
    assert "the joint at A moves" in message


def test_legs_that_are_one_joint_are_refused(tmp_path: Path) -> None:
    drawing = Drawing()
    for j in range(3):
        point, axis = _around(j, 0.3, HEIGHT)
        drawing.chain(f"leg{j}", "base", np.zeros(3), [("revolute", point, axis)], end=point,
                      kind="6d")  # fmt: skip
        drawing.legs[f"leg{j}"] = f"j_leg{j}_0"
    assert "directly between base and platform" in drawing.refusal(tmp_path, [])


def test_two_mechanisms_in_one_file_are_refused(tmp_path: Path) -> None:
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
    path.write_text(yaml.safe_dump(document))
    assert "second mechanism on the base, with link 'second'" in _refusal(path)
    document.pop("legcal")
    path.write_text(yaml.safe_dump(document))
    assert "found 2 mechanisms" in _refusal(path)


@pytest.mark.parametrize(
    ("types", "message"),
    [
        (["US"], "found 1 leg in space, needed at least 3"),
        (["US", "US"], "found 2 legs in space, needed at least 3"),
        (["RR"], "needed at least 3"),
    ],
)
def test_too_few_legs_are_refused(types: list[str], message: str, tmp_path: Path) -> None:
    path = write_machine(tmp_path, of_types(types), Layout())
    assert message in _refusal(path)


def test_far_too_many_legs_are_refused_before_any_work(tmp_path: Path) -> None:
    machine = of_types(["US"] * 3)
    many = replace(machine, legs=machine.legs * 11)
    path = write_machine(tmp_path, many, Layout())
    assert "found 33 legs, needed at most 32" in _refusal(path)


def test_one_leg_in_a_plane_is_refused(tmp_path: Path) -> None:
    path = write_machine(tmp_path, planar(kinds=("actuated",)), Layout())
    assert "found 1 leg in a plane, needed at least 2" in _refusal(path)


def test_a_leg_that_is_fixed_to_the_platform_of_a_planar_machine_is_refused(
    tmp_path: Path,
) -> None:
    machine = planar()
    fixed = replace(machine.legs[2], type="R", platform_axis=None)
    path = write_machine(tmp_path, replace(machine, legs=(*machine.legs[:2], fixed)), Layout())
    assert "'leg3_slider' is outside the method: found it fixed to the platform" in _refusal(path)


def _moved(path: Path, leg: str, by: Array) -> Path:
    """Move the first joint behind the slider of a leg that hangs from the base."""
    urdf = path.with_suffix(".urdf")
    text = urdf.read_text()
    turn = Rotation.identity()
    for joint in ("a1", "a2", "slider"):
        if f'<joint name="{leg}_{joint}"' in text:
            turn = turn * _rotation_of(text, f"{leg}_{joint}")
    after = next(line for line in text.splitlines() if f'<parent link="{leg}_slider_link"' in line)
    numbers = after.split('<origin xyz="', 1)[1].split('"', 1)[0]
    moved = np.array([float(x) for x in numbers.split()]) + turn.inv().apply(by)
    words = " ".join(repr(float(x)) for x in moved)
    urdf.write_text(text.replace(after, after.replace(numbers, words, 1)))
    return path


def _across(types: str) -> tuple[MachineSpec, Array]:
    """Return a machine, and the direction across leg 2 in which its ends cannot move apart."""
    machine = planar() if types == "RR" else of_types([types] * 3)
    leg = machine.legs[1]
    v = np.array([0.3, 0.4, 0.5]) if leg.base_axis is None else leg.base_axis
    across = np.cross(leg.u, v)
    return machine, np.asarray(across / np.linalg.norm(across))


@pytest.mark.parametrize("types", ["US", "RS", "UU", "RR"])
def test_a_slider_that_misses_its_joint_is_refused_with_the_distance(
    types: str, tmp_path: Path
) -> None:
    machine, across = _across(types)
    message = _refusal(_moved(write_machine(tmp_path, machine, Layout()), "leg2", 0.002 * across))
    assert "leg of slider 'leg2_slider' is outside the method" in message
    assert "by 2 mm, needed at most 0.01 mm" in message


@pytest.mark.parametrize("types", ["US", "RS", "UU"])
def test_a_slider_that_misses_by_a_hair_is_accepted(types: str, tmp_path: Path) -> None:
    machine, across = _across(types)
    load_mechanism(_moved(write_machine(tmp_path, machine, Layout()), "leg2", 2e-6 * across))


def _turned(path: Path, joint: str, toward: Array, angle: float) -> Path:
    """Turn the axis of a joint whose axis is given in its own frame."""
    urdf = path.with_suffix(".urdf")
    head, tail = urdf.read_text().split(f'<joint name="{joint}"')
    before, rest = tail.split('<axis xyz="', 1)
    numbers, after = rest.split('"', 1)
    axis = np.array([float(x) for x in numbers.split()])
    turned = np.cos(angle) * axis + np.sin(angle) * toward
    words = " ".join(repr(float(x)) for x in turned)
    urdf.write_text(f'{head}<joint name="{joint}"{before}<axis xyz="{words}"{after}')
    return path


def test_a_revolute_axis_that_is_not_square_to_the_leg_is_refused(tmp_path: Path) -> None:
    machine = of_types(["RS"] * 3)
    leg = machine.legs[0]
    assert leg.base_axis is not None
    tilted = np.cos(0.1) * leg.base_axis + np.sin(0.1) * leg.u
    legs = (type(leg)("RS", leg.A, leg.B_home, "actuated", tilted), *machine.legs[1:])
    path = write_machine(tmp_path, type(machine)(legs, machine.home), Layout())
    message = _refusal(path)
    assert "found the axis of 'leg1_a1' 5.73 deg from perpendicular to the leg" in message


def test_an_inner_axis_that_is_not_square_to_a_leg_without_s_is_refused(tmp_path: Path) -> None:
    machine = of_types(["UU"] * 3)
    path = write_machine(tmp_path, machine, Layout())
    urdf = path.with_suffix(".urdf").read_text()
    # the second axis of leg 1 turns towards the leg about the first one: still a universal joint
    outer, u = machine.legs[0].base_axis, machine.legs[0].u
    assert outer is not None
    inner = np.cross(outer, u) / np.linalg.norm(np.cross(outer, u))
    turn = Rotation.from_rotvec(0.1 * outer)
    block = urdf[urdf.index('<joint name="leg1_a2"') :]
    parent = _rotation_of(urdf, "leg1_a1") * _rotation_of(urdf, "leg1_a2")
    numbers = block.split('<axis xyz="', 1)[1].split('"', 1)[0]
    np.testing.assert_allclose(
        np.abs(parent.apply([float(x) for x in numbers.split()]) @ inner), 1.0, atol=1e-9
    )
    words = " ".join(repr(float(x)) for x in parent.inv().apply(turn.apply(inner)))
    path.with_suffix(".urdf").write_text(urdf.replace(f'"{numbers}"', f'"{words}"'))
    message = _refusal(path)
    assert "from perpendicular to the leg, needed an inner axis of a U joint" in message


def _rotation_of(urdf: str, joint: str) -> Rotation:
    """Return the rotation of a joint's origin."""
    block = urdf[urdf.index(f'<joint name="{joint}"') :]
    rpy = block.split('rpy="', 1)[1].split('"', 1)[0]
    return Rotation.from_euler("xyz", [float(x) for x in rpy.split()])


def test_a_universal_joint_off_square_is_refused_with_the_angle(tmp_path: Path) -> None:
    path = write_machine(tmp_path, of_types(["US"] * 3), Layout())
    urdf = path.with_suffix(".urdf").read_text()
    a2 = _rotation_of(urdf, "leg1_a2")
    block = urdf[urdf.index('<joint name="leg1_a1"') :]
    outer = [float(x) for x in block.split('<axis xyz="', 1)[1].split('"', 1)[0].split()]
    message = _refusal(_turned(path, "leg1_a2", a2.inv().apply(outer), 0.02))
    assert "the axes of 'leg1_a1' and 'leg1_a2' are 1.146 deg from perpendicular" in message


@pytest.mark.parametrize("machine", ["6-UPS", "3-RPR"])
def test_motors_that_turn_are_refused(machine: str, tmp_path: Path) -> None:
    path = write_machine(tmp_path, MACHINES[machine](), Layout())
    path.write_text(path.read_text().replace("- leg2_slider\n", "- leg2_a1\n", 1))
    assert "the motor 'leg2_a1' is outside the method: found a revolute joint" in _refusal(path)


def test_a_planar_virtual_joint_in_another_plane_is_refused(tmp_path: Path) -> None:
    path = write_machine(tmp_path, planar((0.0, 0.6, 0.8)), Layout(virtual="planar"))
    assert load_mechanism(path).spatial is False
    urdf = path.with_suffix(".urdf")
    text = urdf.read_text()
    start = text.index("<origin", text.index('name="platform_free"'))
    end = text.index("/>", start)
    urdf.write_text(text[:start] + '<origin xyz="0 0 0"' + text[end:])
    assert "from the plane in which the legs move" in _refusal(path)


def test_a_virtual_joint_that_carries_another_link_is_refused(tmp_path: Path) -> None:
    path = write_machine(tmp_path, of_types(["US"] * 3), Layout())
    urdf = path.with_suffix(".urdf")
    text = urdf.read_text()
    joint = '<joint name="platform_free" type="floating"><parent link="base"/><child link="'
    assert joint in text
    extra = '<link name="plate"/><joint name="p" type="floating"><parent link="base"/>'
    extra += '<child link="plate"/></joint></robot>'
    urdf.write_text(text.replace("</robot>", extra))
    path.write_text(path.read_text().replace("platform_joint: platform_free", "platform_joint: p"))
    assert "floating joint 'platform_free' inside it" in _refusal(path)
    text = text.replace('name="platform_free" type="floating"', 'name="free" type="fixed"')
    text = text.replace('<parent link="base"/><child link="platform"/>', (
        '<parent link="base"/><child link="spare"/>'), 1)  # fmt: skip
    extra = extra.replace("plate", "platform").replace('<link name="platform"/>', "")
    extra = extra.replace('<parent link="base"/>', '<parent link="leg1_a1_link"/>')
    urdf.write_text(text.replace("</robot>", f'<link name="spare"/>{extra}'))
    assert "found it between the parent 'leg1_a1_link'" in _refusal(path)


def test_a_serial_arm_is_refused(tmp_path: Path) -> None:
    drawing = _planar_arms(1)
    (tmp_path / "arm.urdf").write_text(
        f'<robot name="arm">{"".join(drawing.links)}{"".join(drawing.joints)}</robot>'
    )
    with pytest.raises(LegcalError, match="this is not a parallel mechanism: found a URDF"):
        load_mechanism(tmp_path / "arm.urdf")
