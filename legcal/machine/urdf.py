"""URDF files: reading as a checked tree, and writing with other numbers."""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from lxml import etree
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.brief import brief
from legcal.errors import Code, ModelError, Problem, Problems
from legcal.files.schema import NAME_NEEDED, content_of, describe, is_name
from legcal.geometry.motions import matrix_of, roll_pitch_yaw
from legcal.geometry.types import Array

MAX_ELEMENTS = 50_000
MAX_LINKS = 1000
MAX_MOVING = 200


def parse_robot(path: Path, content: bytes) -> etree._Element:
    """Return the ``<robot>`` of a URDF, without comments, entities or the network."""
    robot = parse_xml(path, content, "URDF")
    name, problems, line = robot.get("name", ""), Problems(path), cast("int", robot.sourceline)
    refused = "the URDF could not be read"
    if robot.tag != "robot":
        element = f"<{robot.tag}> as its root element"
        problems.add(refused, element, "<robot>", "give the URDF of the mechanism", line)
    elif not name.isprintable():
        stated = f"<robot> with the name {describe(name)}"
        problems.add(refused, stated, "printable characters", "rename it", line)
    elif not name.strip():
        problems.add(refused, "<robot> without a name", "one", "write <robot name=...>", line)
    problems.raise_if_any()
    return robot


def parse_xml(path: Path, content: bytes, kind: str) -> etree._Element:
    """Return the root element of an XML file, without comments, entities or the network."""
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False,
        remove_comments=True, remove_pis=True,
    )  # fmt: skip
    try:
        root = etree.fromstring(content, parser)
    except etree.XMLSyntaxError as error:
        bad = Problem(
            f"the {kind} could not be read",
            str(error.msg),
            "well-formed XML",
            "mend that line, or copy the file again if it was cut off",
            str(path),
            line=error.lineno or 1,
            code=Code.BAD_SYNTAX,
        )
        raise ModelError(bad) from error
    problems, refused = Problems(path), f"the {kind} could not be read"
    if sum(1 for _ in root.iter()) > MAX_ELEMENTS:
        remedy = "give the file of one mechanism"
        problems.add(refused, f"more than {MAX_ELEMENTS} elements", "fewer", remedy)
    document: Any = root.getroottree().docinfo
    if document.doctype or document.internalDTD is not None:
        doctype = "a document type (<!DOCTYPE>), whose entities are never expanded"
        problems.add(refused, doctype, "plain XML", "remove it")
    try:
        content.decode("utf-8-sig")
    except UnicodeDecodeError:
        problems.add(refused, "text in another encoding", "UTF-8", "save it as UTF-8")
    problems.raise_if_any()
    return root


_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?\Z", re.ASCII)

MAX_NUMBER = 1e12  # largest plausible length, angle or limit; squares of larger numbers overflow

# element -> attribute -> number of values, and whether they must be positive
_NUMERIC: dict[str, dict[str, tuple[int, bool]]] = {
    "origin": {"xyz": (3, False), "rpy": (3, False)},
    "axis": {"xyz": (3, False)},
    "limit": dict.fromkeys(("lower", "upper", "effort", "velocity"), (1, False)),
    "mass": {"value": (1, False)},
    "inertia": dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), (1, False)),
    "cylinder": {"radius": (1, True), "length": (1, True)},
    "sphere": {"radius": (1, True)},
    "box": {"size": (3, False)},
    "mesh": {"scale": (3, False)},
    "dynamics": {"damping": (1, False), "friction": (1, False)},
}


class XmlProblems(Problems):
    """The problems of an XML file."""

    def at(self, element: etree._Element, mistake: str, remedy: str) -> None:
        """Add a problem of an element of the file."""
        name = f"{element.tag} '{element.get('name')}'" if element.get("name") else element.tag
        self.append(
            Problem(
                f"{name} could not be used: it {mistake}",
                remedy=remedy,
                file=self.file,
                line=cast("int", element.sourceline),
                name=name,
                code=Code.BAD_ELEMENT,
            )
        )

    def check_unique(self, elements: Iterable[etree._Element], key: str = "name") -> None:
        """Add a problem of each element with the name of an earlier one."""
        seen: set[str] = set()
        for element in elements:
            name = element.get(key)
            if name in seen:
                mistake = f"has the name '{name}', which another {element.tag} has"
                self.at(element, mistake, "give each its own name")
            seen |= {name} if name else set()


def number_list(text: str, count: int) -> list[float] | None:
    """Return ``count`` finite numbers of plausible size, separated by spaces, or None."""
    words = text.split()
    if len(words) != count or not all(_NUMBER.match(word) for word in words):
        return None
    numbers = [float(word) for word in words]
    return numbers if all(math.isfinite(x) and abs(x) < MAX_NUMBER for x in numbers) else None


def check_numbers(element: etree._Element, problems: XmlProblems) -> None:
    """Check every number of a link or a joint."""
    for part in element.iter(*_NUMERIC):
        for attribute, (count, positive) in _NUMERIC[str(part.tag)].items():
            text = part.get(attribute)
            if text is None:
                if part.tag == "cylinder":
                    problems.at(element, f"has a <cylinder> without {attribute}", "write it [m]")
                continue
            numbers, needed = number_list(text, count), "more than zero"
            if numbers is None:
                needed = "a finite number" if count == 1 else f"{count} finite numbers"
            if numbers is None or (positive and min(numbers) <= 0.0):
                problems.at(
                    element,
                    f'has <{part.tag} {attribute}="{_short(text)}">, needed {needed}',
                    "correct the value",
                )


def check_tree(
    links: list[etree._Element], joints: list[etree._Element], problems: XmlProblems
) -> str:
    """Check that links and joints are one tree, and return its root link."""
    for elements in (links, joints):
        _check_names(elements, problems)
    names = {e.get("name", "") for e in links}
    children: dict[str, list[str]] = {}
    parent_joint: dict[str, str] = {}
    for joint in joints:
        ends = {}
        for tag in ("parent", "child"):
            end = joint.find(tag)
            link = None if end is None else end.get("link")
            if link is None:
                problems.at(joint, f"has no <{tag} link=...>", "name the link")
            elif link not in names:
                problems.at(
                    joint, f"names the {tag} link '{link}', which is not in the file",
                    "correct the name",
                )  # fmt: skip
            else:
                ends[tag] = link
        if len(ends) < 2:
            continue
        child = ends["child"]
        if child in parent_joint:
            problems.at(
                joint,
                f"gives the link '{child}' a second parent (the first is by joint "
                f"'{parent_joint[child]}')",
                "a URDF is a tree: give the loop's end a link of its own and close the loop in "
                "closed_loop of the mechanism YAML",
            )
            continue
        parent_joint[child] = joint.get("name", "")
        children.setdefault(ends["parent"], []).append(child)
    if not links:
        problems.add(
            "the URDF could not be used",
            "no <link>",
            "the links of a mechanism",
            "expand it with xacro first if it is a xacro file",
        )
        return ""
    roots = [e.get("name", "") for e in links if e.get("name", "") not in parent_joint]
    if len(roots) > 1:
        problems.add(
            "the URDF could not be used",
            f"{len(roots)} links without a parent ({_quoted(roots)})",
            "one",
            "join them with joints, a platform by a floating one",
        )
    pending, reached = [*roots], set[str]()
    while pending:
        if (link := pending.pop()) not in reached:
            reached.add(link)
            pending.extend(children.get(link, ()))
    cyclic = [e.get("name", "") for e in links if e.get("name", "") not in reached]
    if cyclic:
        problems.add(
            "the URDF could not be used",
            f"the links {_quoted(cyclic)}, which hang from each other in a cycle",
            "a tree",
            "cut the loop and close it in closed_loop of the mechanism YAML",
        )
    return roots[0] if roots else ""


def _quoted(names: Sequence[str]) -> str:
    """Return the first names in words."""
    return ", ".join(f"'{name}'" for name in names[:6])


def _check_names(elements: list[etree._Element], problems: XmlProblems) -> None:
    """Check that every element has a name of its own."""
    for element in elements:
        name = element.get("name", "")
        if not name.strip():
            problems.at(element, "has no name", "name it")
        elif not is_name(name) and (element.tag == "joint" or not name.isprintable()):
            mistake = f"has a name that cannot be used, needed {NAME_NEEDED}"
            problems.at(element, mistake, "rename it")
    problems.check_unique(elements)


def _short(text: str) -> str:
    return text if len(text) <= 60 else f"{text[:57]}..."


@dataclass(frozen=True)
class Wording:
    """Nouns for parts of a file, and clauses of remedies, by the format of the file.

    A mechanism YAML with a block ``legcal`` states home, base, platform and legs; without the block
    they follow from the tree and its drawn pose. MJCF files and URDFs with loops have no place for
    a block: what they leave open is an option of ``legcal inspect``, which writes one.
    """

    closures: str = "closed_loop"
    root: str = "the root of the URDF"
    home: str = "legcal.home"
    no_home: str = "legcal.home is not given"
    state_home: str = "write legcal.home"
    correct_home: str = "correct legcal.home"
    state_readings: str = "write legcal.home_readings with the reading of each actuator at home"
    state_ends: str = "write legcal.base, legcal.platform and legcal.legs"
    correct_ends: str = "correct legcal.base or legcal.platform"


BLOCK = Wording()
NO_BLOCK = Wording(
    home="the pose that the file draws",
    no_home="the file draws no closed pose",
    state_home="add a block legcal with home",
    correct_home="add a block legcal with another home",
    state_readings="add a block legcal with home and home_readings",
    state_ends="add a block legcal with base, platform and legs",
    correct_ends="add a block legcal with another base or platform",
)
_NAMED_ENDS = (
    "name the links, with legcal inspect FILE --base LINK --platform LINK --write DIR, and use the "
    "model in DIR"
)
_DRAWING = replace(
    NO_BLOCK,
    state_home="draw the machine nearer to closed",
    correct_home="correct the pose that the file draws",
    state_readings="draw the machine closed",
    state_ends=_NAMED_ENDS,
    correct_ends=_NAMED_ENDS,
)
URDF_LOOPS = replace(_DRAWING, closures="<loop_joint> or <constraint>")
MJCF = replace(_DRAWING, closures="<equality>", root="<worldbody>")


UrdfJointType = Literal["fixed", "revolute", "continuous", "prismatic", "floating", "planar"]
JOINT_TYPES = ("fixed", "revolute", "continuous", "prismatic", "floating", "planar")
VIRTUAL = ("floating", "planar")  # joints that only say where the platform is
LOOP_TAGS = ("loop_joint", "constraint")


@dataclass(frozen=True, eq=False)
class UrdfJoint:
    """One joint of a URDF."""

    name: str
    type: UrdfJointType
    parent: str  # link
    child: str  # link
    T_parent_origin: RigidTransform  # the joint frame in the parent link, at joint value zero [m]
    axis: Array  # (3,) unit axis in the joint frame
    limits: tuple[float, float] | None  # lower and upper limit [rad] or [m]

    @property
    def moves(self) -> bool:
        """Whether the joint is not fixed."""
        return self.type != "fixed"


@brief
@dataclass(frozen=True, eq=False)
class Urdf:
    """A URDF whose tree, names and numbers have been checked."""

    path: Path  # the file
    content: bytes  # the file on disk, or the URDF converted from another format
    name: str  # the robot's name
    links: tuple[str, ...]  # link names in the order of the file
    joints: dict[str, UrdfJoint]  # joints by name in the order of the file
    root: str  # the link without a parent
    wording: Wording = BLOCK  # words for messages about the mechanism

    @property
    def text(self) -> str:
        """The XML as text."""
        return self.content.decode("utf-8-sig")

    @cached_property
    def above(self) -> dict[str, UrdfJoint]:
        """The joint above each link but the root."""
        return {joint.child: joint for joint in self.joints.values()}

    @cached_property
    def below(self) -> dict[str, list[UrdfJoint]]:
        """The joints below each link, in the order of the file."""
        below: dict[str, list[UrdfJoint]] = {link: [] for link in self.links}
        for joint in self.joints.values():
            below[joint.parent].append(joint)
        return below

    @cached_property
    def poses(self) -> dict[str, RigidTransform]:
        """The pose of every link in the root link, all joint values zero."""
        poses, pending = {self.root: RigidTransform.identity()}, [self.root]
        while pending:
            link = pending.pop()
            for joint in self.below[link]:
                poses[joint.child] = poses[link] * joint.T_parent_origin
                pending.append(joint.child)
        return poses

    def link_of(self, frame: str) -> str:
        """Return the link of a frame, named by a link or by the joint whose child it is."""
        return frame if frame in self.links else self.joints[frame].child

    def joints_above(self, link: str) -> list[UrdfJoint]:
        """Return the joints from a link up to the root."""
        joints = []
        while link in self.above:
            joints.append(self.above[link])
            link = joints[-1].parent
        return joints

    def joints_below(self, joint: UrdfJoint) -> list[UrdfJoint]:
        """Return a joint and all joints that it carries."""
        carried, pending = list[UrdfJoint](), [joint]
        while pending:
            carried.append(pending.pop())
            pending += self.below[carried[-1].child]
        return carried

    def robot(self) -> etree._Element:
        """Return the ``<robot>`` element, which may be changed for :meth:`edited`."""
        return parse_robot(self.path, self.content)

    def edited(self, robot: etree._Element, *, travel_needed: bool = False) -> "Urdf":
        """Return the tree of a changed ``<robot>``; messages keep their words."""
        changed = parse_urdf(self.path, written(robot), travel_needed=travel_needed)
        return replace(changed, wording=self.wording)


def written(robot: etree._Element) -> bytes:
    """Return the file of a ``<robot>``."""
    return etree.tostring(robot, xml_declaration=True, encoding="utf-8") + b"\n"


def read_urdf(path: Path, *, travel_needed: bool = True) -> Urdf:
    """Return the tree of a URDF file."""
    return parse_urdf(path, content_of(path, "URDF", ModelError), travel_needed=travel_needed)


def parse_urdf(path: Path, content: bytes, *, travel_needed: bool = True) -> Urdf:
    """Return the tree of a URDF from its content."""
    robot = parse_robot(path, content)
    problems = XmlProblems(path)
    for element in robot:
        if element.tag in LOOP_TAGS:
            problems.at(
                element,
                f"closes a loop with <{element.tag}>, which is not read beside a mechanism YAML",
                "write the pair of frames in closed_loop of the mechanism YAML",
            )
    return checked_tree(robot, path, content, problems, travel_needed=travel_needed)


def checked_tree(
    robot: etree._Element,
    path: Path,
    content: bytes,
    problems: XmlProblems,
    *,
    travel_needed: bool = True,
) -> Urdf:
    """Return the tree of a ``<robot>``, ignoring other elements; see :func:`parse_urdf`."""
    links = [e for e in robot if e.tag == "link"]
    joints = [e for e in robot if e.tag == "joint"]
    n_moving = sum(e.get("type") != "fixed" for e in joints)
    for number, most, counted in (
        (len(links), MAX_LINKS, "links"),
        (len(joints), MAX_LINKS, "joints"),
        (n_moving, MAX_MOVING, "joints that move"),
    ):
        if number > most:
            raise ModelError(
                "the mechanism could not be read",
                f"{number} {counted}",
                f"at most {most}",
                "give one mechanism, with fixed joints where nothing moves",
                path,
            )
    for element in (*links, *joints):
        check_numbers(element, problems)
    root = check_tree(links, joints, problems)
    origins = RigidTransform(origins_of(joints), normalize=False, copy=False) if joints else ()
    tree = {
        joint.name: joint
        for element, T in zip(joints, origins, strict=True)
        if (joint := _joint(element, T, problems, travel_needed)) is not None
    }
    problems.raise_if_any()
    return Urdf(
        path=path,
        content=content,
        name=robot.get("name", path.stem),
        links=tuple(str(e.get("name")) for e in links),
        joints=tree,
        root=root,
    )


def _joint(
    element: etree._Element, origin: RigidTransform, problems: XmlProblems, travel_needed: bool
) -> UrdfJoint | None:
    """Return a joint, or None after noting its problems."""
    n_before = len(problems)
    for tag in ("parent", "child", "origin", "axis", "limit"):
        if len(element.findall(tag)) > 1:
            problems.at(element, f"has more than one <{tag}>", "keep one")
    kind = element.get("type", "")
    if kind not in JOINT_TYPES:
        problems.at(
            element,
            f"has the type '{kind}', needed one of {', '.join(JOINT_TYPES)}",
            "write a spherical or universal joint as revolutes, or cut the loop there ('3d')",
        )
    if element.find("mimic") is not None:
        problems.at(
            element,
            "has <mimic>, which is not followed",
            "close the loop in the mechanism YAML, or make a joint beyond the legs fixed",
        )
    axis = _axis(element, kind, problems)
    limits = _limits(element, kind, problems, travel_needed)
    if len(problems) > n_before:
        return None
    ends = [element.find(tag) for tag in ("parent", "child")]
    parent, child = ("" if end is None else end.get("link", "") for end in ends)
    return UrdfJoint(
        name=element.get("name", ""),
        type=cast("UrdfJointType", kind),
        parent=parent,
        child=child,
        T_parent_origin=origin,
        axis=axis,
        limits=limits,
    )


def origins_of(elements: Sequence[etree._Element]) -> Array:
    """Return the poses (n, 4, 4) of the ``<origin>`` of joints or visuals."""
    origins = [element.find("origin") for element in elements]
    rpy, xyz = (
        np.array([_vector(origin, name, (0.0, 0.0, 0.0)) for origin in origins]).reshape(-1, 3)
        for name in ("rpy", "xyz")
    )
    return matrix_of(Rotation.from_euler("xyz", rpy).as_matrix(), xyz)


def _vector(
    element: etree._Element | None, attribute: str, default: tuple[float, float, float]
) -> Array:
    """Return three numbers of an attribute, or the default if missing or wrong."""
    text = None if element is None else element.get(attribute)
    numbers = None if text is None else number_list(text, 3)
    return np.array(default if numbers is None else numbers)


def _axis(element: etree._Element, kind: str, problems: XmlProblems) -> Array:
    """Return the unit axis; the URDF default is x."""
    part = element.find("axis")
    if part is not None and part.get("xyz") is None and kind not in ("fixed", "floating"):
        problems.at(element, "has an <axis> without xyz", "write its direction")
    axis = _vector(part, "xyz", (1.0, 0.0, 0.0))
    norm = float(np.linalg.norm(axis))
    if kind in ("revolute", "continuous", "prismatic", "planar") and norm < 1e-9:
        problems.at(element, "has a zero axis, needed a direction", "correct <axis xyz>")
        return axis
    if kind == "prismatic" and abs(norm - 1.0) > 1e-3:
        problems.at(
            element,
            f"has an axis of length {norm:.6g}, which leaves open how far one unit of the reading "
            "moves it, needed length 1",
            "normalise <axis xyz>",
        )
    return axis / max(norm, 1e-9)


def _limits(
    element: etree._Element, kind: str, problems: XmlProblems, travel_needed: bool
) -> tuple[float, float] | None:
    """Return the limits of a revolute or prismatic joint."""
    if kind not in ("revolute", "prismatic"):
        return None
    limit = element.find("limit")
    bounds_written = limit is not None and not {"lower", "upper"}.isdisjoint(limit.keys())
    if kind == "prismatic" and not travel_needed and not bounds_written:
        return None
    needed = ("lower", "upper", "effort", "velocity") if kind == "prismatic" else (
        "effort", "velocity")  # fmt: skip
    missing = [key for key in needed if limit is None or limit.get(key) is None]
    if missing or limit is None:
        problems.at(
            element,
            f"lacks {', '.join(missing)} in its <limit>",
            "give the travel of the joint" if kind == "prismatic" else "give its limits",
        )
        return None
    if not bounds_written:
        return None  # a revolute without limits, from onshape-to-robot, turns freely
    bounds = [number_list(limit.get(key, "0"), 1) for key in ("lower", "upper")]
    if bounds[0] is None or bounds[1] is None:
        return None
    lower, upper = bounds[0][0], bounds[1][0]
    stated = f"has the limits {lower:g} to {upper:g}"
    if lower > upper:
        problems.at(element, stated, "give the lower one first")
    elif kind == "prismatic" and lower == upper:
        remedy = "write the travel of its motor as lower and upper [m]"
        problems.at(element, f"{stated}, which leave it no travel", remedy)
    return lower, upper


class UrdfPatch:
    """A URDF with changed numbers; comments, order, unknown tags and line ends are kept.

    A file without changes is identical byte for byte. Numbers are read back exactly.
    """

    def __init__(self, content: bytes) -> None:
        parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False)
        self._content = content
        self._robot = etree.fromstring(content, parser)
        self._changed = False

    def set_origin(self, joint: str, xyz: Array | None = None, rpy: Array | None = None) -> None:
        """Write position [m] and angles about fixed x, y, z [rad] of a joint; None keeps them.

        Raises ModelError if the file has no such joint.
        """
        element = next((e for e in self._robot.findall("joint") if e.get("name") == joint), None)
        if element is None:
            raise ModelError(
                f"The URDF could not be changed: found no joint '{joint}', needed the joints of "
                "the mechanism; give the URDF that was loaded."
            )
        origin = element.find("origin")
        if origin is None:
            origin = etree.Element("origin")
            element.insert(0, origin)
        self._write(origin, xyz=xyz, rpy=rpy)

    def set_radius(self, link: str, number: int, radius: float) -> None:
        """Write the radius [m] of a visual cylinder of a link, by its index."""
        self._write(self._cylinders(link)[number][1], radius=np.array([radius]))

    def move_cylinder(self, link: str, size: tuple[float, float], T: RigidTransform) -> None:
        """Move the visual cylinder with a radius and a length [m] within its link."""
        visual = next(
            visual
            for visual, shape in self._cylinders(link)
            if size == (float(shape.get("radius", "")), float(shape.get("length", "")))
        )
        before = RigidTransform(origins_of([visual])[0], normalize=False, copy=False)
        origin, after = visual.find("origin"), T * before
        if origin is None:
            origin = etree.Element("origin")
            visual.insert(0, origin)
        rpy = roll_pitch_yaw(after.rotation.as_matrix())
        self._write(origin, xyz=np.asarray(after.translation), rpy=rpy)

    def _cylinders(self, link: str) -> list[tuple[etree._Element, etree._Element]]:
        return [
            (visual, shape)
            for element in self._robot.findall("link")
            if element.get("name") == link
            for visual in element.findall("visual")
            for geometry in visual.findall("geometry")
            for shape in geometry.findall("cylinder")
        ]

    def add_frame(self, parent: str, child: str, link: str, joint: str, T: RigidTransform) -> None:
        """Add a link with a fixed joint; it is the parent or the child of this joint."""
        robot = self._robot
        body = etree.SubElement(robot, "link", name=link)
        element = etree.SubElement(robot, "joint", name=joint, type="fixed")
        etree.SubElement(element, "parent", link=parent)
        etree.SubElement(element, "child", link=child)
        origin = etree.SubElement(element, "origin")
        self._write(
            origin, xyz=np.asarray(T.translation), rpy=roll_pitch_yaw(T.rotation.as_matrix())
        )
        before = body.getprevious()
        if before is not None:
            before.tail = "\n  "
        body.tail, element.tail = "\n  ", "\n"

    def add_link_below(self, joint: str, link: str, fixed: str) -> None:
        """Insert a link between a joint and its child, which is fixed to the new link."""
        element = next(e for e in self._robot.findall("joint") if e.get("name") == joint)
        for child in element.findall("child"):
            carried = str(child.get("link"))
            child.set("link", link)
            self.add_frame(link, carried, link, fixed, RigidTransform.identity())

    def content(self) -> bytes:
        """Return the content of the file with its changes."""
        if not self._changed:
            return self._content
        before = self._content
        tree = self._robot.getroottree()
        encoding = tree.docinfo.encoding or "utf-8"
        text = cast("bytes", etree.tostring(tree, encoding=encoding, xml_declaration=False))
        if before.removeprefix(b"\xef\xbb\xbf").startswith(b"<?xml"):
            text = before[: before.index(b"?>") + 2] + b"\n" + text
        if before.endswith(b"\n"):
            text += b"\n"
        has_crlf = before.count(b"\n") == before.count(b"\r\n") > 0
        return text.replace(b"\n", b"\r\n") if has_crlf else text

    def _write(self, element: etree._Element, **values: Array | None) -> None:
        """Write numbers as attributes of an element."""
        for name, numbers in values.items():
            if numbers is not None:
                element.set(name, " ".join(repr(float(x)) for x in numbers))
                self._changed = True
