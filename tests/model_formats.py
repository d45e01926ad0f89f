"""One machine written in every format that is read, for tests."""

import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from layouts import origin
from lxml import etree

from legcal import Machine, export
from legcal.exports.subject import Subject

FORMATS = "mjcf", "loop_joint", "isaac", "gepetto"


def write_format(machine: Machine, name: str, folder: Path) -> Path:
    """Write a machine in a format and return the path that means it."""
    folder.mkdir(parents=True, exist_ok=True)
    if name == "mjcf":
        return _mjcf(machine, folder / "machine.xml")
    if name == "gepetto":
        return _gepetto(machine, folder / "machine")
    path = folder / "machine.urdf"
    path.write_text(_with_loops(machine, name))
    return path


def _mjcf(machine: Machine, path: Path) -> Path:
    """Write what is exported, which MuJoCo itself reads in test_exports.py, with capsules."""
    export(Subject(machine, "machine"), "mjcf", path)

    def capsule(found: re.Match[str]) -> str:
        half, middle = float(found[2]), float(found[3])
        ends = f"0 0 {middle - half!r} 0 0 {middle + half!r}"
        return f'type="capsule" size="{found[1]}" fromto="{ends}"'

    cylinder = r'type="cylinder" size="(\S+) (\S+)"[^>]* pos="0.0 0.0 (\S+)" quat="[^"]*"'
    path.write_text(re.sub(cylinder, capsule, path.read_text()))
    return path


def _with_loops(machine: Machine, style: str) -> str:
    """Return the URDF of a machine with its closures in it, on the links under the frames."""
    robot = etree.fromstring(machine.urdf.content)
    below = {j.child: j for j in machine.urdf.joints.values() if not j.moves}
    for i, closure in enumerate(machine.chain.closures):
        kind = "spherical" if closure.kind == "3d" else "fixed"
        ends = [below[frame] for frame in closure.frames]
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
        "closed_loop": [[*c.frames] for c in machine.chain.closures],
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
