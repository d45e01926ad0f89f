"""One machine written in every format that is read, for tests."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from layouts import numbers, origin
from lxml import etree
from scipy.spatial.transform import RigidTransform

from legcal.machine.model import Machine

FORMATS = (
    "mjcf",
    "loop_joint",
    "isaac",
    "gepetto",
)


def write_format(machine: Machine, name: str, folder: Path) -> Path:
    """Write a machine in a format and return the path that means it."""
    folder.mkdir(parents=True, exist_ok=True)
    if name == "mjcf":
        path = folder / "machine.xml"
        path.write_text(mjcf(machine))
        return path
    if name == "gepetto":
        return _gepetto(machine, folder / "machine")
    path = folder / "machine.urdf"
    path.write_text(_with_loops(machine, name))
    return path


def _pose(T: RigidTransform) -> str:
    quat = np.roll(T.rotation.as_quat(), 1)
    return f'pos="{numbers(T.translation)}" quat="{numbers(quat)}"'


def _cylinders(machine: Machine) -> dict[str, list[tuple[RigidTransform, str, str]]]:
    """Return the visual cylinders of every link: pose, radius and length as text."""
    robot = etree.fromstring(machine.urdf.content)
    found: dict[str, list[tuple[RigidTransform, str, str]]] = {}
    for visual in robot.iterfind("link/visual"):
        place, cylinder = visual.find("origin"), visual.find("geometry/cylinder")
        assert place is not None
        assert cylinder is not None
        assert place.get("rpy") == "0 0 0"
        T = RigidTransform.from_translation([float(x) for x in place.get("xyz", "").split()])
        link = str(visual.getparent().get("name"))  # type: ignore[union-attr]
        entry = T, cylinder.get("radius", ""), cylinder.get("length", "")
        found.setdefault(link, []).append(entry)
    return found


def mjcf(machine: Machine) -> str:
    """Return a machine as MJCF, closed between bodies, in its home configuration."""
    chain, configuration = machine.chain, machine.home_configuration
    urdf, cylinders = machine.urdf, _cylinders(machine)

    def joint(entry: Any) -> str:
        if entry.type in ("floating", "planar"):
            return f'<freejoint name="{entry.name}"/>'
        value = float(configuration[chain.q_index(entry.name)])
        axis = f'axis="{numbers(entry.axis)}"'
        if entry.type == "prismatic":
            limits = f'range="{numbers(np.array(entry.limits))}"'
            return f'<joint name="{entry.name}" type="slide" {axis} ref="{value!r}" {limits}/>'
        degrees = float(np.degrees(value))
        return f'<joint name="{entry.name}" type="hinge" {axis} ref="{degrees!r}"/>'

    def geoms(link: str) -> str:
        text = ""
        for T, radius, length in cylinders.get(link, []):
            half = 0.5 * float(length)
            ends = numbers([T.apply([0, 0, -half]), T.apply([0, 0, half])])
            text += f'<geom type="capsule" size="{radius}" fromto="{ends}"/>'
        return text

    def body(link: str, parent: str | None) -> str:
        T = RigidTransform.identity()
        above = ""
        if parent is not None:
            T = chain.pose(configuration, parent, link)
            entry = next(j for j in urdf.joints.values() if j.child == link)
            above = joint(entry) if entry.moves else ""
        children = [j for j in urdf.joints.values() if j.parent == link]
        held = [j.child for j in children if j.type not in ("floating", "planar")]
        free = [j.child for j in children if j.type in ("floating", "planar")]
        inside = above + geoms(link) + "".join(body(child, link) for child in held)
        beside = "".join(body(child, link) for child in free)
        return f'<body name="{link}" {_pose(T)}>{inside}</body>\n{beside}'

    equalities = ""
    for closure in chain.closures:
        tag = "connect" if closure.kind == "3d" else "weld"
        ends = f'body1="{closure.frame_1}" body2="{closure.frame_2}"'
        ends += ' anchor="0 0 0"' * (tag == "connect")
        equalities += f"<{tag} {ends}/>\n"
    motors = "".join(f'<position joint="{machine.legs[j].prismatic}"/>' for j in machine.motors)
    return (
        f'<mujoco model="machine">\n<worldbody>{body(urdf.root, None)}</worldbody>\n'
        f"<equality>{equalities}</equality>\n<actuator>{motors}</actuator></mujoco>\n"
    )


def _with_loops(machine: Machine, style: str) -> str:
    """Return the URDF of a machine with its closures in it, on the links under the frames."""
    robot = etree.fromstring(machine.urdf.content)
    below = {j.child: j for j in machine.urdf.joints.values() if not j.moves}
    for i, closure in enumerate(machine.chain.closures):
        kind = "spherical" if closure.kind == "3d" else "fixed"
        ends = [below[frame] for frame in (closure.frame_1, closure.frame_2)]
        places = [etree.fromstring(origin(end.T_parent_origin)) for end in ends]
        for end in ends:
            _remove(robot, end)
        attributes = [f'xyz="{p.get("xyz")}" rpy="{p.get("rpy")}"' for p in places]
        second = "link1" if style == "isaac" else "link2"
        text = (
            f'<loop_joint name="loop{i}" type="{kind}">'
            f'<link1 link="{ends[0].parent}" {attributes[0]}/>'
            f'<{second} link="{ends[1].parent}" {attributes[1]}/></loop_joint>'
        )
        robot.append(etree.fromstring(text))
    for j in machine.motors:
        motor = machine.legs[j].prismatic
        text = f'<transmission name="t{j}"><joint name="{motor}"/></transmission>'
        robot.append(etree.fromstring(text))
    return etree.tostring(robot, encoding="unicode")


def _remove(robot: etree._Element, joint: Any) -> None:
    for element in list(robot):
        if (element.tag, element.get("name")) in (("joint", joint.name), ("link", joint.child)):
            robot.remove(element)


def _gepetto(machine: Machine, folder: Path) -> Path:
    """Write a folder as Gepetto has them: one joint stands for two or three at one point."""
    folder.mkdir(parents=True)
    robot = etree.fromstring(machine.urdf.content)
    elements = {(e.tag, e.get("name")): e for e in robot}
    names, types, gone = [], [], set[str]()
    for first in machine.urdf.joints.values():
        group = _group(machine, first)
        if first.name in gone or len(group) < 2:
            continue
        names.append(first.name)
        letters = "".join(str(_letter(joint)) for joint in group)
        types.append(f"UJOINT_{letters}" if len(group) == 2 else "SPHERICAL")
        child = elements["joint", first.name].find("child")
        assert child is not None
        child.set("link", group[-1].child)
        gone |= {joint.name for joint in group}
        for before, joint in pairwise(group):
            robot.remove(elements["link", before.child])
            robot.remove(elements["joint", joint.name])
    document = {
        "closed_loop": [[c.frame_1, c.frame_2] for c in machine.chain.closures],
        "type": [c.kind.upper() for c in machine.chain.closures],
        "name_mot": [str(machine.legs[j].prismatic) for j in machine.motors],
        "joint_name": names,
        "joint_type": types,
    }
    (folder / "robot.urdf").write_bytes(etree.tostring(robot))
    (folder / "robot.yaml").write_text(yaml.safe_dump(document))
    return folder


def _group(machine: Machine, first: Any) -> list[Any]:
    """Return the revolutes about x, y or z that follow each other at one point."""
    group = [first]
    while True:
        after = [j for j in machine.urdf.joints.values() if j.parent == group[-1].child]
        found = [
            joint
            for joint in after
            if joint.type == first.type == "revolute"
            and np.allclose(joint.T_parent_origin.as_matrix(), np.eye(4))
            and _letter(joint) is not None
        ]
        if not found or _letter(first) is None:
            return group
        group.append(found[0])


def _letter(joint: Any) -> str | None:
    axes = dict(zip("XYZ", np.eye(3), strict=True))
    return next((k for k, axis in axes.items() if np.allclose(axis, joint.axis)), None)
