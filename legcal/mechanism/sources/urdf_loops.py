"""A URDF that closes its loops itself, by ``<loop_joint>`` or ``<constraint>`` elements.

``<loop_joint>`` is Drake's (two links with ``xyz`` and ``rpy``, an axis) and Isaac Sim's (the same
with ``spherical``, both links often called ``link1``). ``<constraint>`` is what is proposed for
urdfdom (ros/urdfdom#264): parent and child with an origin and an axis each.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from lxml import etree
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.files.schema import closest
from legcal.geometry.types import Array
from legcal.mechanism.robot_xml import parse_robot
from legcal.mechanism.schema import MechanismFile
from legcal.mechanism.sources.loops import Loop, LoopKind, close_loop
from legcal.mechanism.sources.reference import reference_poses
from legcal.mechanism.sources.source import DRAWING, Source
from legcal.mechanism.sources.tree_text import TreeText
from legcal.mechanism.urdf import LOOP_TAGS, Urdf, checked_tree, parse_urdf
from legcal.mechanism.urdf_checks import Problems, number_list

KINDS: dict[str, LoopKind] = {
    **dict.fromkeys(("spherical", "ball", "point"), "point"),
    **dict.fromkeys(("fixed", "weld"), "weld"),
    **dict.fromkeys(("revolute", "continuous", "hinge"), "revolute"),
    "universal": "universal",
}
_WORDS = (("closed_loop", "<loop_joint> or <constraint>"), *DRAWING)


def has_loops(robot: etree._Element) -> bool:
    """Say whether a ``<robot>`` closes loops."""
    return any(element.tag in LOOP_TAGS for element in robot)


def read_loop_source(path: Path, content: bytes) -> Source:
    """Return the mechanism of a URDF with loops.

    Motors are the prismatic joints that a ``<transmission>`` or ``<ros2_control>`` names, or all
    prismatic joints where none is named.

    Raises
    ------
    ModelError
        With one sentence for each problem of the file.
    """
    robot = parse_robot(path, content)
    problems = Problems(path)
    elements = [element for element in robot if element.tag in LOOP_TAGS]
    bare = checked_tree(robot, path, content, problems, travel_needed=False)
    loops = _loops(elements, bare, problems)
    motors, notes = _motors(robot, bare, problems)
    problems.raise_if_any()
    for element in elements:
        robot.remove(element)
    poses = reference_poses(bare)
    text = TreeText(dict.fromkeys(bare.links, ""), dict.fromkeys(bare.joints, ""))
    pairs = [close_loop(loop, text, poses) for loop in loops]
    for line in [*text.links.values(), *text.joints.values()]:
        if line:
            robot.append(etree.fromstring(line))
            robot[-1].tail = "\n"
    written = etree.tostring(robot, xml_declaration=True, encoding="utf-8") + b"\n"
    file = MechanismFile(
        closed_loop=[frames for frames, _ in pairs],
        type=[kind for _, kind in pairs],
        name_mot=motors,
    )
    urdf = parse_urdf(path, written, travel_needed=False)
    return Source(path, file, urdf, True, tuple(notes), words=_WORDS)


def _loops(elements: Sequence[etree._Element], urdf: Urdf, problems: Problems) -> list[Loop]:
    """Return the loops of a URDF, the problems of others noted."""
    found = []
    seen: set[str] = set()
    for i, element in enumerate(elements, start=1):
        n_before = len(problems)
        name = element.get("name", "").strip() or f"{element.tag}_{i}"
        if name in seen:
            problems.add(element, "has a name that another one has", "give each its own name")
        seen.add(name)
        kind = element.get("type", "").strip().lower()
        if kind not in KINDS:
            problems.add(
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
        found.append(Loop(name, KINDS[kind], (link_1, link_2), (T_1, T_2), axes))
    return found


def _ends(
    element: etree._Element, urdf: Urdf, problems: Problems
) -> tuple[tuple[str, RigidTransform], tuple[str, RigidTransform]] | None:
    """Return the links of a loop and its frame in each, or None with its problems noted."""
    sides = [part for part in element if part.tag in ("link1", "link2")]
    origins: list[etree._Element | None] = [
        part if part.find("origin") is None else part.find("origin") for part in sides
    ]
    if not sides:
        sides = [part for tag in ("parent", "child") for part in element.findall(tag)]
        origins = [element.find(f"{part.tag}_origin") for part in sides]
    if len(sides) != 2:
        problems.add(
            element,
            f"names {len(sides)} links, needed two",
            "write <link1 link=...> and <link2 link=...>, or <parent ...> and <child ...>",
        )
        return None
    n_before = len(problems)
    links = [side.get("link", "") for side in sides]
    for link in links:
        if link not in urdf.links:
            problems.add(
                element, f"names the link '{link}', which is not in the file",
                closest(link, urdf.links).rstrip("."),
            )  # fmt: skip
    if links[0] == links[1]:
        problems.add(element, f"joins the link '{links[0]}' to itself", "name two links")
    poses = [_pose(element, origin, problems) for origin in origins]
    if len(problems) > n_before:
        return None
    return (links[0], poses[0]), (links[1], poses[1])


def _pose(
    element: etree._Element, origin: etree._Element | None, problems: Problems
) -> RigidTransform:
    """Return the motion that ``xyz`` and ``rpy`` describe, zero where they are not written."""
    xyz, rpy = (_three(element, origin, key, problems) for key in ("xyz", "rpy"))
    return RigidTransform.from_components(xyz, Rotation.from_euler("xyz", rpy))


def _three(
    element: etree._Element, part: etree._Element | None, key: str, problems: Problems
) -> Array:
    """Return three numbers of a part of a loop; zero where they are missing."""
    text = None if part is None else part.get(key)
    numbers = [0.0] * 3 if text is None else number_list(text, 3)
    if numbers is None:
        problems.add(
            element, f"has {key}={str(text)[:60]!r}, needed 3 finite numbers", "correct the value"
        )
    return np.array(numbers or [0.0] * 3)


def _axes(element: etree._Element, kind: LoopKind, problems: Problems) -> tuple[Array, Array]:
    """Return the unit axes of a loop in its two frames; the URDF default is x."""
    x = np.array([1.0, 0.0, 0.0])
    if kind not in ("revolute", "universal"):
        return x, x
    common = element.find("axis")
    if common is not None and common.get("frame") is not None:
        problems.add(
            element,
            f"gives its axis in the frame '{common.get('frame')}' alone, needed it in both",
            "give both frames with rpy so that the axis is the same in them",
        )
    parts = [element.find(f"{side}_axis") for side in ("parent", "child")]
    if kind == "universal" and None in parts:
        problems.add(
            element,
            "is universal and has not two axes",
            "write <parent_axis xyz=...> and <child_axis xyz=...>",
        )
    axes = []
    for part in parts:
        given = common if part is None else part
        axis = x if given is None else _three(element, given, "xyz", problems)
        norm = float(np.linalg.norm(axis))
        if norm < 1e-9 and not problems.sentences:
            problems.add(element, "has a zero axis, needed a direction", "correct its xyz")
        axes.append(axis / max(norm, 1e-9))
    return axes[0], axes[1]


def _motors(robot: etree._Element, urdf: Urdf, problems: Problems) -> tuple[list[str], list[str]]:
    """Return the joints that have an encoder, and what the reader should know of that."""
    named = [e for e in robot.iterfind("transmission/joint") if e.get("name") is not None]
    named += [e for e in robot.iterfind("ros2_control/joint") if e.get("name") is not None]
    for element in named:
        if element.get("name") not in urdf.joints:
            problems.add(
                element,
                "is a motor of no joint of the file",
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
