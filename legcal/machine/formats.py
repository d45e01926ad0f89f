"""Reading a mechanism of any format: detecting the format and calling its reader.

A YAML with its URDF (ours, or Gepetto's, with stand-in joints), a URDF with its own loops, or MJCF
(:mod:`legcal.machine.mjcf`): all are converted to a :class:`Source`, a tree with pairs of
coincident frames. Without a block ``legcal`` the tree is closed near its drawn configuration.
"""

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
from lxml import etree
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import ModelError, OutOfClass, Problems, UsageError
from legcal.files.schema import closest, content_of
from legcal.geometry.types import Array
from legcal.machine.bodies import frame_link, rigid_bodies
from legcal.machine.drawn_state import completed, is_drawn_closed, with_held_joints
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
    Loop,
    LoopKind,
    Source,
    UrdfBuilder,
    check_one_mechanism,
    close_loops,
    moving_groups,
    reference_poses,
)
from legcal.machine.topology import find_chains, motors_on, propose_block
from legcal.machine.urdf import (
    BLOCK,
    LOOP_TAGS,
    NO_BLOCK,
    URDF_LOOPS,
    Urdf,
    XmlProblems,
    checked_tree,
    number_list,
    parse_robot,
    parse_urdf,
    parse_xml,
    read_urdf,
)

_CLOSING = re.compile(r"closing_(.+)_([12])")
_UNIVERSAL = re.compile(r"UJOINT_([XYZ])([XYZ])")
_AXES = dict(zip("XYZ", np.eye(3), strict=True))

KINDS: dict[str, LoopKind] = {
    **dict.fromkeys(("spherical", "ball", "point"), "point"),
    **dict.fromkeys(("fixed", "weld"), "weld"),
    **dict.fromkeys(("revolute", "continuous", "hinge"), "revolute"),
    "universal": "universal",
}


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
        is_drawn = source.file.legcal.home is None and is_drawn_closed(source)
        return completed(source) if is_drawn else source
    source = replace(source, base=base, platform=platform)
    if base is not None or platform is not None:
        source = with_held_joints(_of_stated(source))
    check_one_mechanism(source)
    if source.urdf.wording is URDF_LOOPS and not source.file.name_mot:
        source = _with_arms_as_motors(source)
    return completed(source)


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
        if any(frame_link(source.urdf, frame) in mine for frame in pair)
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


def closing_frames(robot: etree._Element, path: Path) -> list[list[str]]:
    """Return the pairs of links ``closing_NAME_1`` and ``closing_NAME_2`` of onshape-to-robot."""
    ends: dict[str, dict[str, str]] = {}
    for element in robot.findall("link"):
        match = _CLOSING.fullmatch(element.get("name", ""))
        if match:
            ends.setdefault(match[1], {})[match[2]] = match[0]
    for name, numbers in ends.items():
        if len(numbers) == 1:
            (number, link) = next(iter(numbers.items()))
            raise ModelError(
                "the loops could not be closed",
                f"the frame '{link}' and no 'closing_{name}_{3 - int(number)}'",
                "both ends of each loop",
                f"export the model again with both parts of the mate closing_{name}, or "
                f"remove '{link}'",
                path,
            )
    return [[numbers["1"], numbers["2"]] for numbers in ends.values()]


def read_loop_source(path: Path, content: bytes) -> Source:
    """Return the mechanism of a URDF with loops: elements of its own, or pairs of closing frames.

    Motors are the prismatic joints named in ``<transmission>`` or ``<ros2_control>``, or all
    prismatic joints if none is named.
    """
    robot = parse_robot(path, content)
    problems = XmlProblems(path)
    elements = [element for element in robot if element.tag in LOOP_TAGS]
    bare = checked_tree(robot, path, content, problems, travel_needed=False)
    loops = _loops(elements, bare, problems)
    motors, notes = _motors(robot, bare, problems)
    problems.raise_if_any()
    for element in elements:
        robot.remove(element)
    poses = reference_poses(bare)
    text = UrdfBuilder(dict.fromkeys(bare.links, ""), dict.fromkeys(bare.joints, ""))
    pairs, kinds = close_loops(loops, text, poses, path)
    for line in filter(None, text.body().split("\n")):
        robot.append(etree.fromstring(line))
        robot[-1].tail = "\n"
    named = closing_frames(robot, path)
    if named:
        kinds.extend("3d" for _ in named)
        notes.append(
            f"The {len(named)} pairs of frames closing_..._1 and closing_..._2 were taken as ball "
            "joints."
        )
    file = MechanismFile(
        closed_loop=[*pairs, *named],
        type=kinds,
        name_mot=motors,
    )
    return Source(path, file, replace(bare, wording=URDF_LOOPS).edited(robot), tuple(notes))


def _loops(elements: Sequence[etree._Element], urdf: Urdf, problems: XmlProblems) -> list[Loop]:
    """Return the valid loops of a URDF, and note the problems of the others."""
    loops = []
    problems.check_unique(elements)
    for i, element in enumerate(elements, start=1):
        n_before = len(problems)
        name = element.get("name", "").strip() or f"{element.tag}_{i}"
        kind = element.get("type", "").strip().lower()
        if kind not in KINDS:
            problems.at(
                element,
                f"closes a loop with the type '{element.get('type', '')}', needed one of "
                f"{', '.join(KINDS)}",
                "cut the loop at another joint",
            )
            continue
        ends = _ends(element, urdf, problems)
        axes = _axes(element, KINDS[kind], problems)
        if len(problems) > n_before or ends is None:
            continue
        (link_1, T_1), (link_2, T_2) = ends
        loops.append(Loop(name, KINDS[kind], (link_1, link_2), (T_1, T_2), axes))
    return loops


def _ends(
    element: etree._Element, urdf: Urdf, problems: XmlProblems
) -> tuple[tuple[str, RigidTransform], tuple[str, RigidTransform]] | None:
    """Return the links of a loop and its frame in each, or None after noting problems."""
    sides = [part for part in element if part.tag in ("link1", "link2")]
    origins: list[etree._Element | None] = [
        part if part.find("origin") is None else part.find("origin") for part in sides
    ]
    if not sides:
        sides = [part for tag in ("parent", "child") for part in element.findall(tag)]
        origins = [element.find(f"{part.tag}_origin") for part in sides]
    if len(sides) != 2:
        problems.at(
            element,
            f"names {len(sides)} links, needed two",
            "write <link1 link=...> and <link2 link=...>, or <parent ...> and <child ...>",
        )
        return None
    n_before = len(problems)
    links = [side.get("link", "") for side in sides]
    for link in links:
        if link not in urdf.links:
            problems.at(
                element, f"names the link '{link}', which is not in the file",
                closest(link, urdf.links).rstrip("."),
            )  # fmt: skip
    if links[0] == links[1]:
        problems.at(element, f"joins the link '{links[0]}' to itself", "name two links")
    poses = [_pose(element, origin, problems) for origin in origins]
    if len(problems) > n_before:
        return None
    return (links[0], poses[0]), (links[1], poses[1])


def _pose(
    element: etree._Element, origin: etree._Element | None, problems: XmlProblems
) -> RigidTransform:
    """Return the motion of ``xyz`` and ``rpy``, zero by default."""
    xyz, rpy = (_three(element, origin, key, problems) for key in ("xyz", "rpy"))
    return RigidTransform.from_components(xyz, Rotation.from_euler("xyz", rpy))


def _three(
    element: etree._Element, part: etree._Element | None, key: str, problems: XmlProblems
) -> Array:
    """Return three numbers of an element of a loop; zero by default."""
    text = None if part is None else part.get(key)
    numbers = [0.0] * 3 if text is None else number_list(text, 3)
    if numbers is None:
        problems.at(
            element, f"has {key}={str(text)[:60]!r}, needed 3 finite numbers", "correct the value"
        )
    return np.array(numbers or [0.0] * 3)


def _axes(element: etree._Element, kind: LoopKind, problems: XmlProblems) -> tuple[Array, Array]:
    """Return the unit axes of a loop in its two frames; the URDF default is x."""
    x = np.array([1.0, 0.0, 0.0])
    if kind not in ("revolute", "universal"):
        return x, x
    common = element.find("axis")
    if common is not None and common.get("frame") is not None:
        problems.at(
            element,
            f"gives its axis in the frame '{common.get('frame')}' alone, needed it in both",
            "give both frames with rpy so that the axis is the same in them",
        )
    parts = [element.find(f"{side}_axis") for side in ("parent", "child")]
    if kind == "universal" and None in parts:
        problems.at(
            element,
            "is universal and has not two axes",
            "write <parent_axis xyz=...> and <child_axis xyz=...>",
        )
    axes = []
    for part in parts:
        given = common if part is None else part
        axis = x if given is None else _three(element, given, "xyz", problems)
        norm = float(np.linalg.norm(axis))
        if norm < 1e-9 and not problems:
            problems.at(element, "has a zero axis, needed a direction", "correct its xyz")
        axes.append(axis / max(norm, 1e-9))
    return axes[0], axes[1]


def _motors(
    robot: etree._Element, urdf: Urdf, problems: XmlProblems
) -> tuple[list[str], list[str]]:
    """Return the joints with an encoder, and notes about them."""
    named = [e for e in robot.iterfind("transmission/joint") if e.get("name") is not None]
    named += [e for e in robot.iterfind("ros2_control/joint") if e.get("name") is not None]
    for element in named:
        if element.get("name") not in urdf.joints:
            problems.at(
                element,
                "names no joint of the file",
                closest(str(element.get("name")), urdf.joints).rstrip("."),
            )
    motors = list(dict.fromkeys(str(e.get("name")) for e in named))
    if motors:
        return motors, []
    sliders = [joint.name for joint in urdf.joints.values() if joint.type == "prismatic"]
    return sliders, [
        f"The file names no motors: all {len(sliders)} prismatic joints were taken as motors; "
        "name the motors in <transmission> elements if some are not."
    ] * bool(sliders)
