"""Trees with loops: models of other formats, converted to pairs of coincident frames; URDF loops.

All readers return a :class:`Source`; :class:`UrdfBuilder` writes the URDF of the tree. A joint that
closes a loop (:class:`Loop`) is converted to a pair of frames: a point to a ``3d`` pair, a weld to
a ``6d`` pair.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from math import pi
from pathlib import Path
from typing import NamedTuple

import numpy as np
from lxml import etree
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import ModelError, OutOfClass
from legcal.files.schema import closest
from legcal.geometry.motions import roll_pitch_yaw
from legcal.geometry.types import Array
from legcal.machine.chain import Closure, ClosureKind
from legcal.machine.files import MAX_LOOPS, LegcalBlock
from legcal.machine.urdf import (
    LOOP_TAGS,
    URDF_LOOPS,
    Urdf,
    UrdfJointType,
    XmlProblems,
    checked_tree,
    number_list,
    parse_robot,
)


@dataclass(frozen=True, eq=False)
class Source:
    """A mechanism as read from one of the formats."""

    path: Path  # file with the loops, for messages
    urdf: Urdf  # the tree
    closures: tuple[Closure, ...]  # in the order of the file
    motors: tuple[str, ...]  # joints that have an encoder
    block: LegcalBlock | None = None
    notes: tuple[str, ...] = ()  # notes on the conversion, one sentence each
    values: Mapping[str, float] = field(default_factory=dict)  # joint values [rad
    poses: Mapping[str, RigidTransform] | None = None
    is_drawn_open: bool = False  # the drawing is open (but has all travels) and was closed
    drawn: Mapping[str, float] = field(default_factory=dict)  # drawn values of motors [m, rad]
    base: str | None = None  # stated links of a file without a block
    platform: str | None = None
    leg_radius: float | None = None  # stated radius of legs without a cylinder [m]


FULL_TURN = 2.0 * pi
EYE = RigidTransform.identity()
ZERO, UNTURNED = np.zeros(3), np.eye(3)


@dataclass
class UrdfBuilder:
    """The lines of a URDF under construction."""

    links: dict[str, str] = field(default_factory=dict)  # lines of all links, by name
    joints: dict[str, str] = field(default_factory=dict)  # lines of all joints, by name
    taken: set[str] = field(default_factory=set)  # names of others

    def unused(self, name: str) -> str:
        """Return a name unused by links and joints: the given one, or it with a number."""
        taken = self.links.keys() | self.joints.keys() | self.taken
        number, unused = 1, name
        while unused in taken:
            number += 1
            unused = f"{name}_{number}"
        return unused

    def link(self, name: str, visuals: str = "") -> None:
        """Add or replace a link with its visuals."""
        inside = f">{visuals}</link>" if visuals else "/>"
        self.links[name] = f"  <link name={_quoted(name)}{inside}"

    def joint(
        self,
        name: str,
        kind: UrdfJointType,
        links: tuple[str, str],  # parent and child
        xyz: Array = ZERO,
        rotation: Array = UNTURNED,
        axis: Array | None = None,
        limits: tuple[float, float] | None = (-FULL_TURN, FULL_TURN),
    ) -> None:
        """Add a joint; ``limits`` [rad or m] apply to one with an axis."""
        parent, child = (_quoted(link) for link in links)
        moving = "" if axis is None else f'<axis xyz="{_numbers(axis)}"/>'
        if axis is not None and kind in ("revolute", "prismatic"):
            moving += _limit_xml(limits)
        self.joints[name] = (
            f'  <joint name={_quoted(name)} type="{kind}"><parent link={parent}/>'
            f"<child link={child}/>{origin_xml(xyz, rotation)}{moving}</joint>"
        )

    def turns(
        self,
        name: str,
        parent: str,
        child: str,
        T_parent_origin: RigidTransform,
        axes: Mapping[str, Array],
    ) -> None:
        """Add a ball or universal joint as revolutes, by their letters, with links between them."""
        last = [*axes][-1]
        for letter, axis in axes.items():
            after = child if letter == last else self.unused(f"{name}_{letter}_link")
            if after != child:
                self.link(after)
            joint = self.unused(f"{name}_{letter}")
            self.joint(joint, "revolute", (parent, after), *parts_of(T_parent_origin), axis)
            parent, T_parent_origin = after, EYE

    def elements(self) -> list[etree._Element]:
        """Return all links and joints, each on a line of its own."""
        elements = [
            etree.fromstring(line) for line in (*self.links.values(), *self.joints.values())
        ]
        for element in elements:
            element.tail = "\n"
        return elements

    def robot(self, name: str) -> bytes:
        """Return the whole URDF."""
        head = f'<?xml version="1.0" encoding="utf-8"?>\n<robot name={_quoted(name)}>\n'
        lines = "\n".join([*self.links.values(), *self.joints.values()])
        return f"{head}{lines}\n</robot>\n".encode()


def parts_of(T: RigidTransform) -> tuple[Array, Array]:
    """Return translation (3,) [m] and rotation matrix of a motion."""
    return np.asarray(T.translation), T.rotation.as_matrix()


def origin_xml(xyz: Array, rotation: Array) -> str:
    """Return the ``<origin>`` at a point [m] with a rotation matrix."""
    return f'<origin xyz="{_numbers(xyz)}" rpy="{_numbers(roll_pitch_yaw(rotation))}"/>'


def visual_xml(at: str, radius: float, length: float) -> str:
    """Return the ``<visual>`` of a cylinder at an ``<origin>``."""
    shape = f'<cylinder radius="{radius!r}" length="{length!r}"/>'
    return f"<visual>{at}<geometry>{shape}</geometry></visual>"


def mesh_xml(at: str, file: str, scale: Array) -> str:
    """Return the ``<visual>`` of a mesh file at an ``<origin>``."""
    shape = f'<mesh filename={_quoted(file)} scale="{_numbers(scale)}"/>'
    return f"<visual>{at}<geometry>{shape}</geometry></visual>"


def box_xml(at: str, sizes: Array) -> str:
    """Return the ``<visual>`` of a box (3,) [m] at an ``<origin>``."""
    return f'<visual>{at}<geometry><box size="{_numbers(sizes)}"/></geometry></visual>'


def _limit_xml(limits: tuple[float, float] | None) -> str:
    """Return the ``<limit>`` of a joint; a URDF must name an effort and a velocity too."""
    ends = ""
    if limits is not None:
        lower, upper = (float(x) for x in limits)
        ends = f'lower="{lower!r}" upper="{upper!r}" '
    return f'<limit {ends}effort="1000" velocity="1"/>'


def _numbers(values: Array) -> str:
    """Return numbers that are read back exactly, with rounding noise of zero as zero."""
    return " ".join(repr(float(x)) if abs(x) > 1e-15 else "0.0" for x in values)


def _quoted(text: str) -> str:
    return f'"{escape(text)}"'


def check_one_mechanism(source: Source) -> None:
    """Check that a file holds one mechanism: all loops share a body other than the ground."""
    groups = moving_groups(source.urdf, source.closures)
    closed = [links for links, is_closed in groups if is_closed]
    block = source.block  # a platform on the ground is refused later
    if len(closed) > 1 and (block is None or any(block.platform in links for links in closed)):
        names = ", ".join(f"'{links[0]}'" for links in closed[:4])
        raise OutOfClass(
            "the mechanism could not be read",
            f"{len(closed)} mechanisms, which have no moving body in common (with {names})",
            "one",
            "write each to its own file",
            source.path,
        )


def moving_groups(urdf: Urdf, closures: Iterable[Closure]) -> list[tuple[list[str], bool]]:
    """Return the groups of connected links, without those on the ground, and whether loops close.

    The links of each are in the order of the file.
    """
    fixed = [(j.parent, j.child) for j in urdf.joints.values() if not j.moves]
    on_ground = connected(urdf.links, fixed)[urdf.root]
    pairs = [(j.parent, j.child) for j in urdf.joints.values() if j.type != "floating" and j.moves]
    ends = [tuple(map(urdf.link_of, closure.frames)) for closure in closures]
    moving = [pair for pair in (*pairs, *ends) if on_ground.isdisjoint(pair)]
    groups = connected(urdf.links, [*fixed, *moving])
    closed = {link for pair in ends for link in pair}
    found = {id(groups[link]): groups[link] for link in urdf.links if link not in on_ground}
    return [
        ([link for link in urdf.links if link in links], not closed.isdisjoint(links))
        for links in found.values()
    ]


def connected(names: Iterable[str], pairs: Iterable[Sequence[str]]) -> dict[str, set[str]]:
    """Return for each name the set, the same for all of them, of those that pairs connect it to."""
    groups = {name: {name} for name in names}
    for first, second in pairs:
        group, joining = groups[first], groups[second]
        if group is not joining:
            group |= joining
            groups.update(dict.fromkeys(joining, group))
    return groups


LinkFrame = tuple[str, RigidTransform]  # a frame in a link


class Loop(NamedTuple):
    """A joint between two links that closes a loop of the tree."""

    name: str  # prefix of new links and joints
    kind: ClosureKind
    frames: tuple[LinkFrame, LinkFrame]  # of the joint in either link


def close_loops(loops: Sequence[Loop], text: UrdfBuilder, path: Path) -> tuple[Closure, ...]:
    """Add the frames of all loops to a tree, and return their closures."""
    if len(loops) > MAX_LOOPS:
        raise ModelError(
            "the loops could not be closed",
            f"{len(loops)} of them",
            f"at most {MAX_LOOPS}",
            "give one mechanism",
            path,
        )
    closures = []
    for loop in loops:
        ends = []
        for number, (link, T_link_frame) in enumerate(loop.frames, start=1):
            ends.append(text.unused(f"{loop.name}_{number}"))
            text.link(ends[-1])
            text.joint(
                text.unused(f"{ends[-1]}_frame"), "fixed", (link, ends[-1]), *parts_of(T_link_frame)
            )
        closures.append(Closure(loop.kind, (ends[0], ends[1])))
    return tuple(closures)


_CLOSING = re.compile(r"closing_(.+)_([12])")
KINDS: dict[str, ClosureKind] = {
    **dict.fromkeys(("spherical", "ball", "point"), "3d"),
    **dict.fromkeys(("fixed", "weld"), "6d"),
}


def closing_frames(robot: etree._Element, path: Path) -> tuple[Closure, ...]:
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
    return tuple(Closure("3d", (numbers["1"], numbers["2"])) for numbers in ends.values())


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
    text = UrdfBuilder(taken={*bare.links, *bare.joints})
    closures = close_loops(loops, text, path)
    robot.extend(text.elements())
    named = closing_frames(robot, path)
    if named:
        notes.append(
            f"The {len(named)} pairs of frames closing_..._1 and closing_..._2 were taken as ball "
            "joints."
        )
    urdf = replace(bare, wording=URDF_LOOPS).edited(robot)
    return Source(path, urdf, (*closures, *named), tuple(motors), notes=tuple(notes))


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
                "cut the loop at another joint, or close it in a mechanism YAML",
            )
            continue
        ends = _ends(element, urdf, problems)
        if len(problems) > n_before or ends is None:
            continue
        loops.append(Loop(name, KINDS[kind], ends))
    return loops


def _ends(
    element: etree._Element, urdf: Urdf, problems: XmlProblems
) -> tuple[LinkFrame, LinkFrame] | None:
    """Return the links of a loop and its frame in each, or None after noting problems."""
    sides = [part for part in element if part.tag in ("link1", "link2")]
    origins: list[etree._Element | None] = [
        part if part.find("origin") is None else part.find("origin") for part in sides
    ]
    if len(sides) != 2:
        problems.at(
            element,
            f"names {len(sides)} links, needed two",
            "write <link1 link=...> and <link2 link=...>",
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
    poses = []
    for origin in origins:
        parts = []
        for key in ("xyz", "rpy"):
            text = None if origin is None else origin.get(key)
            numbers = [0.0] * 3 if text is None else number_list(text, 3)
            if numbers is None:
                mistake = f"has {key}={str(text)[:60]!r}, needed 3 finite numbers"
                problems.at(element, mistake, "correct the value")
            parts.append(np.array(numbers or [0.0] * 3))
        rotation = Rotation.from_euler("xyz", parts[1])
        poses.append(RigidTransform.from_components(parts[0], rotation))
    if len(problems) > n_before:
        return None
    return (links[0], poses[0]), (links[1], poses[1])


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
