"""Joints that close no loop: held where the file draws them, so that only the mechanism moves.

A head turns on its base, a hand or an antenna moves on the platform, a robot floats in its world:
CAD exports contain the whole machine. A joint on no path of the tree between the two frames of a
closure does not move the loops.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from lxml import etree
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import OutOfClass, Problem
from legcal.geometry.rotations import roll_pitch_yaw
from legcal.machine.bodies import frame_link
from legcal.machine.spanning_tree import Source
from legcal.machine.urdf import Urdf, UrdfJoint, parse_robot, parse_urdf

_SHOWN = 6  # joints named in a note


def with_held_joints(source: Source) -> Source:
    """Return a mechanism whose joints outside all loops are fixed at their drawn values.

    Raises
    ------
    OutOfClass
        If a motor and a passive joint hang on a chain that ends in the air: a leg left open.
    """
    urdf, motors = source.urdf, source.file.name_mot
    held = open_joints(urdf, source.file.closed_loop)
    if source.file.legcal is not None:
        held.pop(source.file.legcal.platform_joint or "", None)
    if not held:
        return source
    _refuse_open_leg(urdf, held, motors, source)
    robot = parse_robot(urdf.path, urdf.content)
    for element in robot.findall("joint"):
        joint = held.get(element.get("name", ""))
        if joint is None:
            continue
        T = joint.T_parent_origin * _motion(joint, source.values.get(joint.name, 0.0))
        for tag in ("origin", "mimic", "limit", "axis"):
            for part in element.findall(tag):
                element.remove(part)
        element.set("type", "fixed")
        xyz, rpy = np.asarray(T.translation), roll_pitch_yaw(T.rotation.as_matrix())
        numbers = {"xyz": xyz, "rpy": rpy}
        etree.SubElement(
            element, "origin", {k: " ".join(repr(float(x)) for x in v) for k, v in numbers.items()}
        )
    content = etree.tostring(robot, xml_declaration=True, encoding="utf-8") + b"\n"
    # The travel of sliders was asked for, or not, when the file was read.
    fixed = parse_urdf(urdf.path, content, travel_needed=False)
    file = source.file.model_copy(update={"name_mot": [m for m in motors if m not in held]})
    return replace(
        source,
        file=file,
        urdf=replace(fixed, wording=urdf.wording),
        notes=(*source.notes, _note(list(held))),
        values={name: value for name, value in source.values.items() if name not in held},
    )


def open_joints(urdf: Urdf, closures: Iterable[Sequence[str]]) -> dict[str, UrdfJoint]:
    """Return the joints that can move and are in no loop, by name."""
    above = {joint.child: joint for joint in urdf.joints.values()}

    def to_root(link: str) -> set[str]:
        names = set[str]()
        while link in above:
            names.add(above[link].name)
            link = above[link].parent
        return names

    in_loops = set[str]()
    for first, second in closures:
        in_loops |= to_root(frame_link(urdf, first)) ^ to_root(frame_link(urdf, second))
    return {
        name: joint for name, joint in urdf.joints.items() if joint.moves and name not in in_loops
    }


def _motion(joint: UrdfJoint, value: float) -> RigidTransform:
    """Return the motion of a joint at a value [m or rad], none for a floating or planar one."""
    if joint.type == "prismatic":
        return RigidTransform.from_translation(value * joint.axis)
    if joint.type in ("revolute", "continuous"):
        return RigidTransform.from_rotation(Rotation.from_rotvec(value * joint.axis))
    return RigidTransform.identity()


def _refuse_open_leg(
    urdf: Urdf, held: Mapping[str, UrdfJoint], motors: Sequence[str], source: Source
) -> None:
    """Refuse a chain with a motor and a passive joint that ends without closing a loop."""
    children: dict[str, list[UrdfJoint]] = {}
    for joint in urdf.joints.values():
        children.setdefault(joint.parent, []).append(joint)

    def beyond(joint: UrdfJoint) -> list[UrdfJoint]:
        """Return a joint and all joints that it carries."""
        carried, pending = list[UrdfJoint](), [joint]
        while pending:
            carried.append(pending.pop())
            pending += children.get(carried[-1].child, [])
        return carried

    for joint in held.values():
        branch = [j for j in beyond(joint) if j.moves]
        if any(j.name not in held for j in branch):
            continue  # it carries the mechanism
        driven = [j.name for j in branch if j.name in motors]
        passive = [j.name for j in branch if j.name not in motors]
        if driven and passive:
            raise OutOfClass(
                Problem(
                    "this is not a platform on separate legs",
                    f"the motor '{driven[0]}' of a leg that starts with joint '{joint.name}', "
                    "on no chain from base to platform",
                    "a closed loop for each leg",
                    f"add the missing pair to {urdf.wording.closures}, or make joint "
                    f"'{passive[0]}' fixed if the chain is no leg",
                    str(source.path),
                )
            )


def _note(names: Sequence[str]) -> str:
    """Return the note on held joints."""
    shown = ", ".join(f"'{name}'" for name in names[:_SHOWN])
    more = f" and {len(names) - _SHOWN} more" * (len(names) > _SHOWN)
    if len(names) == 1:
        return f"the joint {shown} closes no loop and is held as drawn."
    return f"the joints {shown}{more} close no loop and are held as drawn."
