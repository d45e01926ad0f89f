"""Reading a mechanism of any format: detecting the format and calling its reader.

A YAML with its URDF (ours, or Gepetto's, with stand-in joints), a URDF with its own loops, or MJCF
(:mod:`legcal.machine.mjcf`): all are converted to a :class:`Source`, a tree with pairs of
coincident frames.

CAD exports contain the whole machine: a head turns on its base, a hand or an antenna moves on the
platform, a robot floats in its world. A joint on no path of the tree between the two frames of a
closure does not move the loops; it is held where it is drawn, so that only the mechanism moves.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
from lxml import etree
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import ModelError, OutOfClass, Problems, UsageError
from legcal.files.schema import closest, content_of
from legcal.machine.chain import rigid_bodies
from legcal.machine.files import (
    FILE_KIND,
    MechanismFile,
    find_model,
    find_urdf,
    is_xml,
    read_mechanism_file,
    yaml_of_urdf,
)
from legcal.machine.mjcf import read_mjcf_source
from legcal.machine.spanning_tree import (
    Source,
    UrdfBuilder,
    check_one_mechanism,
    closing_frames,
    moving_groups,
    origin_xml,
    read_loop_source,
)
from legcal.machine.topology import find_chains, motors_on, propose_block
from legcal.machine.urdf import (
    BLOCK,
    LOOP_TAGS,
    NO_BLOCK,
    URDF_LOOPS,
    Urdf,
    UrdfJoint,
    parse_urdf,
    parse_xml,
    read_urdf,
)

_UNIVERSAL = re.compile(r"UJOINT_([XYZ])([XYZ])")
_AXES = dict(zip("XYZ", np.eye(3), strict=True))


def read_source(model: str | Path, base: str | None = None, platform: str | None = None) -> Source:
    """Return the tree and the closures of a mechanism; each file is checked in itself.

    The links *base* and *platform* are stated for a file without a block ``legcal``.
    """
    path = find_model(model)
    source = _read_xml(path) if is_xml(path) else read_yaml_source(path)
    _check_stated(source, base, platform)
    names = {*source.urdf.links, *source.urdf.joints}
    pairs = source.file.closed_loop
    if not all(a in names and b in names and a != b for a, b in pairs):
        return source  # refused later, with the location of the name
    source = with_held_joints(source)
    if source.file.legcal is not None:
        check_one_mechanism(source)
        return source
    source = replace(source, base=base, platform=platform)
    if base is not None or platform is not None:
        source = with_held_joints(_of_stated(source))
    check_one_mechanism(source)
    if source.urdf.wording is URDF_LOOPS and not source.file.name_mot:
        source = _with_arms_as_motors(source)
    return source


def _check_stated(source: Source, base: str | None, platform: str | None) -> None:
    """Refuse links stated for a file that names others itself, or has no such link."""
    problems = Problems(source.path)
    for option, link in (("--base", base), ("--platform", platform)):
        if link is not None and source.file.legcal is not None:
            problems.add(
                f"{option} could not be used",
                "a file with a block legcal, which names base and platform",
                "a file without it",
                f"write '{link}' in legcal.{option.removeprefix('--')}",
            )
        elif link is not None and link not in source.urdf.links:
            absent = f"the link '{link}', which is not in the file"
            remedy = closest(link, source.urdf.links)
            problems.add(f"{option} could not be used", absent, remedy=remedy)
    problems.raise_if_any(UsageError)


def _of_stated(source: Source) -> Source:
    """Return a file with the loops of that mechanism alone whose platform or base is stated."""
    loops, kinds = source.file.closed_loop, source.file.type
    groups = moving_groups(source.urdf, loops)
    stated = {source.base, source.platform}
    mine = {link for links, _ in groups if stated & {*links} for link in links}
    kept = [
        i
        for i, pair in enumerate(loops)
        if any(source.urdf.link_of(frame) in mine for frame in pair)
    ]
    if not kept:
        return source
    update = {"closed_loop": [loops[i] for i in kept], "type": [kinds[i] for i in kept]}
    return replace(source, file=source.file.model_copy(update=update))


def _with_arms_as_motors(source: Source) -> Source:
    """Return a mechanism without motors with those joints on its base as motors that move rods."""
    urdf, closures = source.urdf, source.closures
    with suppress(OutOfClass):
        propose_block(source, [])
        return source  # moved by hand
    with suppress(OutOfClass):
        block = propose_block(source, None)
        bodies = rigid_bodies(urdf, closures, block.platform_joint)
        turning = motors_on(bodies, bodies.body_of[block.base])
        chains = find_chains(bodies, urdf, block.base, block.platform, turning)
        moving = {chain.motor for chain in chains}
        motors = [name for name in turning if name in moving]
        note = (
            f"The file names no motors: the {len(motors)} joints on the base that move rods "
            f"({', '.join(motors)}) were taken as motors; name the motors in <transmission> "
            "elements if some are not."
        )
        return replace(
            source,
            file=source.file.model_copy(update={"name_mot": motors}),
            notes=(*source.notes, note),
        )
    return source


def _read_xml(path: Path) -> Source:
    """Return the mechanism of an XML file, by its root element."""
    beside = yaml_of_urdf(path)
    if beside is not None and path.suffix.lower() != ".mjcf":
        return read_yaml_source(beside)
    content = content_of(path, FILE_KIND, ModelError)
    root = parse_xml(path, content, "mechanism file")
    if root.tag == "mujoco":
        return read_mjcf_source(path, content)
    if root.tag != "robot":
        sdf = "an SDF file of Gazebo"
        problems = Problems(path)
        problems.add(
            "the mechanism could not be read",
            sdf if root.tag == "sdf" else f"<{root.tag}> as the root element",
            "<robot> (URDF) or <mujoco> (MJCF)",
            "export the model as one of them",
            cast("int", root.sourceline),
        )
        problems.raise_if_any()
    if any(element.tag in LOOP_TAGS for element in root) or closing_frames(root, path):
        return read_loop_source(path, content)
    parse_urdf(path, content, travel_needed=False)  # a link with two parents closes a loop as well
    raise OutOfClass(
        "this is not a parallel mechanism",
        "a URDF, which is a tree without closed loops, and no YAML that closes them",
        "",
        f"write {path.with_suffix('.yaml')} with closed_loop, type, name_mot and a legcal block",
        path,
    )


def read_yaml_source(path: Path) -> Source:
    """Return a mechanism from its YAML and the URDF named there.

    A file without the block ``legcal`` may leave the travel of sliders open, as Gepetto's do.
    """
    file = read_mechanism_file(path)
    block = file.legcal
    urdf = read_urdf(
        find_urdf(path, None if block is None else block.urdf), travel_needed=block is not None
    )
    check_stand_ins(file, urdf, path)
    if not file.joint_name:
        return Source(path, file, urdf if block else replace(urdf, wording=NO_BLOCK))
    return _converted(path, file, urdf)


def _converted(path: Path, file: MechanismFile, urdf: Urdf) -> Source:
    """Return a mechanism after replacing the stand-in joints of its URDF."""
    robot, block = urdf.robot(), file.legcal
    frames = replace_stand_ins(robot, file, urdf)
    changes = {
        "closed_loop": [[frames.get(name, name) for name in pair] for pair in file.closed_loop],
        "joint_name": [],
        "joint_type": [],
    }
    on_replaced = [joint for joint in (block.legs.values() if block else ()) if joint in frames]
    if on_replaced:
        raise ModelError(
            "legcal.legs could not be used",
            f"'{on_replaced[0]}', which stands for another joint (joint_name)",
            "another joint of that leg",
            "name its prismatic joint",
            path,
        )
    completed = urdf.edited(robot, travel_needed=block is not None)
    completed = replace(completed, wording=BLOCK if block else NO_BLOCK)
    return Source(path, file.model_copy(update=changes), completed)


def check_stand_ins(file: MechanismFile, urdf: Urdf, path: Path) -> None:
    """Check that each stand-in joint occurs once and has a known type."""
    problems = Problems(path)
    for i, (name, kind) in enumerate(zip(file.joint_name, file.joint_type, strict=True)):
        refused = f"joint_name.{i} could not be used"
        if name not in urdf.joints:
            absent = f"the joint '{name}', which is not in {urdf.path.name}"
            problems.add(refused, absent, remedy=closest(name, sorted(urdf.joints)))
        elif file.joint_name.index(name) != i:
            problems.add(refused, f"'{name}' twice", "each joint once", "remove one")
        elif name in file.name_mot and kind != "FIXED":
            stand_in = f"'{name}', which stands for {kind} (joint_name.{i})"
            refused = "name_mot could not be used"
            problems.add(refused, stand_in, "a joint with one reading", "remove it")
        if rotation_letters(kind) is None:
            needed = "SPHERICAL, FIXED, or UJOINT_ and two different letters of X, Y, Z"
            problems.add(f"joint_type.{i} could not be used", f"'{kind}'", needed, "correct it")
    problems.raise_if_any()


def rotation_letters(kind: str) -> str | None:
    """Return the rotation axes of a joint type as letters, in order; None if unknown."""
    if kind in ("SPHERICAL", "FIXED"):
        return "XYZ" if kind == "SPHERICAL" else ""
    match = _UNIVERSAL.fullmatch(kind)
    return match[1] + match[2] if match and match[1] != match[2] else None


def replace_stand_ins(robot: etree._Element, file: MechanismFile, urdf: Urdf) -> dict[str, str]:
    """Replace the stand-in joints of a URDF; return the frames that they carried."""
    text = UrdfBuilder(dict.fromkeys(urdf.links, ""), dict.fromkeys(urdf.joints, ""))
    elements = {e.get("name"): e for e in robot if e.tag == "joint"}
    replaced = {}
    for name, kind in zip(file.joint_name, file.joint_type, strict=True):
        element, joint = elements[name], urdf.joints[name]
        if kind == "FIXED":
            element.set("type", "fixed")
            continue
        replaced[name] = joint.child
        axes = {letter: _AXES[letter] for letter in str(rotation_letters(kind))}
        there = len(text.links), len(text.joints)
        text.turns(name, joint.parent, joint.child, joint.T_parent_origin, axes)
        at = robot.index(element)
        robot.remove(element)
        lines = [*text.links.values()][there[0] :] + [*text.joints.values()][there[1] :]
        for line in reversed(lines):
            new = etree.fromstring(line)
            new.tail = "\n"
            robot.insert(at, new)
    return replaced


_SHOWN = 6  # joints named in a note


def with_held_joints(source: Source) -> Source:
    """Return a mechanism whose joints outside all loops are fixed at their drawn values.

    A chain with a motor and a passive joint that ends in the air is refused: a leg left open.
    """
    urdf, motors = source.urdf, source.file.name_mot
    held = open_joints(urdf, source.file.closed_loop)
    if source.file.legcal is not None:
        held.pop(source.file.legcal.platform_joint or "", None)
    if not held:
        return source
    _refuse_open_leg(urdf, held, motors, source)
    robot = urdf.robot()
    for element in robot.findall("joint"):
        joint = held.get(element.get("name", ""))
        if joint is None:
            continue
        for tag in ("origin", "mimic", "limit", "axis"):
            for part in element.findall(tag):
                element.remove(part)
        element.set("type", "fixed")
        T = joint.T_parent_origin * _motion(joint, source.values.get(joint.name, 0.0))
        element.append(etree.fromstring(origin_xml(T)))
    file = source.file.model_copy(update={"name_mot": [m for m in motors if m not in held]})
    return replace(
        source,
        file=file,
        # The travel of sliders was asked for, or not, when the file was read.
        urdf=urdf.edited(robot),
        notes=(*source.notes, _note(list(held))),
        values={name: value for name, value in source.values.items() if name not in held},
    )


def open_joints(urdf: Urdf, closures: Iterable[Sequence[str]]) -> dict[str, UrdfJoint]:
    """Return the joints that can move and are in no loop, by name."""
    in_loops = set[str]()
    for pair in closures:
        first, second = (
            {joint.name for joint in urdf.joints_above(urdf.link_of(frame))} for frame in pair
        )
        in_loops |= first ^ second
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

    def beyond(joint: UrdfJoint) -> list[UrdfJoint]:
        """Return a joint and all joints that it carries."""
        carried, pending = list[UrdfJoint](), [joint]
        while pending:
            carried.append(pending.pop())
            pending += urdf.below[carried[-1].child]
        return carried

    for joint in held.values():
        branch = [j for j in beyond(joint) if j.moves]
        if any(j.name not in held for j in branch):
            continue  # it carries the mechanism
        driven = [j.name for j in branch if j.name in motors]
        passive = [j.name for j in branch if j.name not in motors]
        if driven and passive:
            raise OutOfClass(
                "this is not a platform on separate legs",
                f"the motor '{driven[0]}' of a leg that starts with joint '{joint.name}', "
                "on no chain from base to platform",
                "a closed loop for each leg",
                f"add the missing pair to {urdf.wording.closures}, or make joint "
                f"'{passive[0]}' fixed if the chain is no leg",
                source.path,
            )


def _note(names: Sequence[str]) -> str:
    shown = ", ".join(f"'{name}'" for name in names[:_SHOWN])
    more = f" and {len(names) - _SHOWN} more" * (len(names) > _SHOWN)
    if len(names) == 1:
        return f"the joint {shown} closes no loop and is held as drawn."
    return f"the joints {shown}{more} close no loop and are held as drawn."
