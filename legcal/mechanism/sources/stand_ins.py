"""Joints of a URDF that stand for others: ``joint_name`` and ``joint_type`` of a YAML.

Gepetto's ``robot.yaml`` names revolute joints of a URDF that mean a sphere (``SPHERICAL``), a
universal joint (``UJOINT_XY``: first about x, then about y of the joint frame) or none at all
(``FIXED``). They are replaced in the URDF by revolute joints with massless links.
"""

import re
from pathlib import Path

import numpy as np
from lxml import etree

from legcal.errors import ModelError
from legcal.files.schema import closest
from legcal.mechanism.schema import MechanismFile
from legcal.mechanism.sources.tree_text import TreeText
from legcal.mechanism.urdf import Urdf

_UNIVERSAL = re.compile(r"UJOINT_([XYZ])([XYZ])")
_AXES = dict(zip("XYZ", np.eye(3), strict=True))


def check_stand_ins(file: MechanismFile, urdf: Urdf, path: Path) -> None:
    """Check that each joint that stands for another is there once and means something known.

    Raises
    ------
    ModelError
        With one sentence for each that is not.
    """
    problems = []
    for i, (name, kind) in enumerate(zip(file.joint_name, file.joint_type, strict=True)):
        if name not in urdf.joints:
            problems.append(
                f"{path}: joint_name.{i} could not be used: found the joint '{name}', which is not "
                f"in {urdf.path.name}; {closest(name, sorted(urdf.joints))}"
            )
        elif file.joint_name.index(name) != i:
            problems.append(
                f"{path}: joint_name.{i} could not be used: found '{name}' twice, needed each "
                "joint once; remove one."
            )
        elif name in file.name_mot and kind != "FIXED":
            problems.append(
                f"{path}: name_mot could not be used: found '{name}', which stands for "
                f"{kind} (joint_name.{i}), needed a joint with one reading; remove it."
            )
        if axes_of(kind) is None:
            problems.append(
                f"{path}: joint_type.{i} could not be used: found '{kind}', needed SPHERICAL, "
                "FIXED, or UJOINT_ and two different letters of X, Y, Z; correct it."
            )
    if problems:
        raise ModelError(problems)


def axes_of(kind: str) -> str | None:
    """Return the letters of the axes that a joint type turns about, in order; None if unknown."""
    if kind in ("SPHERICAL", "FIXED"):
        return "XYZ" if kind == "SPHERICAL" else ""
    found = _UNIVERSAL.fullmatch(kind)
    return found[1] + found[2] if found and found[1] != found[2] else None


def replace_stand_ins(robot: etree._Element, file: MechanismFile, urdf: Urdf) -> dict[str, str]:
    """Replace the joints of a URDF that stand for others, and return what frames they carried.

    Parameters
    ----------
    robot : Element
        The URDF, changed in place.
    file : MechanismFile
        Names and types, checked.
    urdf : Urdf
        The same URDF as read.

    Returns
    -------
    dict of str to str
        The child link of every joint that was replaced: the frame that its name meant.
    """
    text = TreeText(dict.fromkeys(urdf.links, ""), dict.fromkeys(urdf.joints, ""))
    elements = {e.get("name"): e for e in robot if e.tag == "joint"}
    replaced = {}
    for name, kind in zip(file.joint_name, file.joint_type, strict=True):
        element, joint = elements[name], urdf.joints[name]
        if kind == "FIXED":
            element.set("type", "fixed")
            continue
        replaced[name] = joint.child
        letters = str(axes_of(kind))
        parent = joint.parent
        added = TreeText(dict(text.links), dict(text.joints))
        for i, letter in enumerate(letters):
            last = i == len(letters) - 1
            child = joint.child if last else added.unused(f"{name}_{letter}_link")
            if not last:
                added.link(child)
            T = joint.T_parent_origin if i == 0 else joint.T_parent_origin.identity()
            added.joint(
                added.unused(f"{name}_{letter}"), "revolute", parent, child, T, _AXES[letter]
            )
            parent = child
        at = robot.index(element)
        robot.remove(element)
        lines = [
            *(line for link, line in added.links.items() if link not in text.links),
            *(line for other, line in added.joints.items() if other not in text.joints),
        ]
        for line in reversed(lines):
            new = etree.fromstring(line)
            new.tail = "\n"
            robot.insert(at, new)
        text = added
    return replaced
