"""A mechanism as MuJoCo's MJCF writes it: bodies with joints, closed by equality constraints.

``<connect>`` makes a ``3d`` closure and ``<weld>`` a ``6d`` one; actuators and ``<jointpos>``
sensors on slides tell the motors. What only a simulation needs is left alone: cameras, lights,
inertias, plugins, adhesion, and geoms other than cylinders and capsules. An element of a body, a
constraint or a geom type that MJCF does not have is refused, since it may be a misspelt one.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from lxml import etree
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import ModelError, OutOfClass
from legcal.files.schema import closest
from legcal.mechanism.robot_xml import parse_xml
from legcal.mechanism.schema import MechanismFile
from legcal.mechanism.sources.components import moving_groups
from legcal.mechanism.sources.loops import Loop, LoopKind, close_loop
from legcal.mechanism.sources.mjcf_bodies import read_bodies
from legcal.mechanism.sources.mjcf_tree import WORLD, MjcfTree
from legcal.mechanism.sources.mjcf_values import Values, own_attributes
from legcal.mechanism.sources.source import DRAWING, Source
from legcal.mechanism.urdf import Urdf, parse_urdf
from legcal.mechanism.urdf_checks import Problems

MOST_PARTS = 5000
_COUPLINGS = ("joint", "tendon", "flex", "flexvert", "flexstrain")
_WORDS = (("closed_loop", "<equality>"), ("the root of the URDF", "<worldbody>"), *DRAWING)
_OTHER_DRIVES = ("tendon", "site", "refsite", "cranksite", "slidersite")


def read_mjcf_source(path: Path, content: bytes) -> Source:
    """Return the mechanism of an MJCF file.

    Raises
    ------
    ModelError
        With one sentence for each problem of the file.
    OutOfClass
        If nothing closes a loop, or there is another machine beside the mechanism.
    """
    root = parse_xml(path, content, "MJCF file")
    n_parts = sum(1 for _ in root.iter("body", "joint", "default", "frame"))
    if n_parts > MOST_PARTS:
        raise ModelError(
            f"{path}: the MJCF file could not be used: found {n_parts} bodies, joints, frames and "
            f"default classes, needed at most {MOST_PARTS}; give the mechanism alone."
        )
    problems = Problems(path)
    values = Values(root, problems)
    tree = read_bodies(root, values)
    loops = list(closing_joints(root, tree))
    motors = _motors(root, tree)
    problems.raise_if_any()
    if not loops:
        raise OutOfClass(
            f"{path}: this is not a parallel mechanism: found an MJCF file without <connect> or "
            "<weld> in <equality>, which is a tree without closed loops, needed the closures of "
            "its loops; add them."
        )
    pairs = [close_loop(loop, tree.text, tree.poses) for loop in loops]
    name = root.get("model", "").strip() or path.stem
    urdf = parse_urdf(path, tree.text.robot(name), travel_needed=False)
    frames = [ends for ends, _ in pairs]
    urdf, dropped = _without_loose_bodies(urdf, frames, tree, name)
    left_out = f"Free bodies that touch no loop were left out: {', '.join(dropped)}."
    values_there = {name: x for name, x in tree.references.items() if name in urdf.joints}
    file = MechanismFile(closed_loop=frames, type=[kind for _, kind in pairs], name_mot=motors)
    notes = (left_out,) * bool(dropped)
    return Source(path, file, urdf, True, notes, values_there, words=_WORDS)


def closing_joints(root: etree._Element, tree: MjcfTree) -> Iterator[Loop]:
    """Give the loops of all ``<equality>`` elements; problems are noted."""
    problems = tree.values.problems
    names: set[str] = set()
    for i, element in enumerate(root.iterfind("equality/*"), start=1):
        attributes = {**_equality_default(tree, element), **own_attributes(element)}
        if attributes.get("active", "true") == "false":
            continue
        if element.tag in _COUPLINGS:
            problems.add(
                element, f"couples <{element.tag}> coordinates, which is not followed",
                "close loops with <connect> and <weld> alone",
            )  # fmt: skip
        elif element.tag not in ("connect", "weld"):
            problems.add(
                element, "is no constraint that legcal knows",
                "close loops with <connect> and <weld> alone",
            )  # fmt: skip
        if element.tag not in ("connect", "weld"):
            continue
        name = str(attributes.get("name") or f"{element.tag}{i}")
        if name in names:
            problems.add(element, "has a name that another one has", "give each its own name")
        names.add(name)
        n_before = len(problems)
        by_site = "site1" in attributes or "site2" in attributes
        ends = _sites(element, tree) if by_site else _bodies(element, tree)
        if ends is None or len(problems) > n_before:
            continue
        (link_1, T_1), (link_2, T_2) = ends
        if link_1 == link_2:
            problems.add(element, f"joins the body '{link_1}' to itself", "name two bodies")
            continue
        scale = tree.values.numbers(element, attributes, "torquescale", (1,))
        is_point = element.tag == "connect" or (scale is not None and scale[0] == 0.0)
        kind: LoopKind = "point" if is_point else "weld"
        yield Loop(name, kind, (link_1, link_2), (T_1, T_2))


def _equality_default(tree: MjcfTree, element: etree._Element) -> dict[str, str]:
    """Return the default attributes of an equality constraint."""
    stand_in = etree.Element("equality")
    if element.get("class") is not None:
        stand_in.set("class", str(element.get("class")))
    return tree.values.attributes(stand_in, "main")


_Ends = tuple[tuple[str, RigidTransform], tuple[str, RigidTransform]]


def _sites(element: etree._Element, tree: MjcfTree) -> _Ends | None:
    """Return the two sites that a constraint holds together."""
    found = []
    for key in ("site1", "site2"):
        name = element.get(key, "")
        if name in tree.sites:
            found.append(tree.sites[name])
        else:
            tree.values.problems.add(
                element, f"names the site '{name}' as {key}, which is not in the file",
                closest(name, tree.sites).rstrip("."),
            )  # fmt: skip
    return (found[0], found[1]) if len(found) == 2 else None


def _bodies(element: etree._Element, tree: MjcfTree) -> _Ends | None:
    """Return the frames on two bodies that a constraint holds together."""
    values = tree.values
    names = []
    for key in ("body1", "body2"):
        name = element.get(key, WORLD if key == "body2" else "")
        names.append(name)
        if not name:
            values.problems.add(element, f"has no {key}", "name the body that it holds")
        elif name not in tree.poses:
            values.problems.add(
                element, f"names the body '{name}' as {key}, which is not in the file",
                closest(name, tree.poses).rstrip("."),
            )  # fmt: skip
    attributes = own_attributes(element)
    anchor = values.numbers(element, attributes, "anchor", (3,))
    if element.tag == "connect" and "anchor" not in attributes:
        values.problems.add(element, "has no anchor", "write the point in the frame of body1")
    if any(name not in tree.poses for name in names):
        return None
    T_one_two = tree.poses[names[0]].inv() * tree.poses[names[1]]
    at = np.zeros(3) if anchor is None else anchor
    if element.tag == "connect":  # the anchor stands in body1
        T_one = RigidTransform.from_translation(at)
        T_two = RigidTransform.from_translation(T_one_two.inv().apply(at))
        return (names[0], T_one), (names[1], T_two)
    relpose = values.numbers(element, attributes, "relpose", (7,))
    T_two = RigidTransform.from_translation(at)  # the anchor of a weld stands in body2
    if relpose is not None and relpose[3:].any():  # MuJoCo brings the anchor to this very place
        rotation = Rotation.from_quat(np.roll(relpose[3:], -1))
        T_one = RigidTransform.from_components(relpose[:3], rotation)
    else:  # the configuration of the file holds
        T_one = T_one_two * T_two
    return (names[0], T_one), (names[1], T_two)


def _motors(root: etree._Element, tree: MjcfTree) -> list[str]:
    """Return the joints that have an encoder: what is driven, and slides that are measured."""
    problems = tree.values.problems
    motors: dict[str, None] = {}
    for element in (*root.iterfind("actuator/*"), *root.iterfind("sensor/jointpos")):
        other = [key for key in _OTHER_DRIVES if element.get(key) is not None]
        name = element.get("joint", element.get("jointinparent"))
        if other and element.tag != "jointpos":
            problems.add(
                element, f"drives by {other[0]}, which is no joint with a reading",
                "drive the slide of each leg itself",
            )  # fmt: skip
        if name is None and not other and not _drives_no_leg(element):
            problems.add(
                element, "names no joint", "name the slide that it drives or measures as joint"
            )
        if name is None:
            continue
        kind = tree.joints.get(name)
        if kind is None:
            problems.add(
                element, f"names the joint '{name}', which is not in the file",
                closest(name, tree.joints).rstrip("."),
            )  # fmt: skip
        elif kind in ("ball", "free"):
            problems.add(
                element, f"drives or measures the {kind} joint '{name}', which has no one reading",
                "remove it",
            )  # fmt: skip
        elif kind == "slide" or element.tag != "jointpos":
            motors[name] = None
    return list(motors)


def _drives_no_leg(element: etree._Element) -> bool:
    """Say whether an actuator acts on something else than joints: suction of a body, a plugin."""
    return element.tag == "plugin" or element.get("body") is not None


def _without_loose_bodies(
    urdf: Urdf, frames: list[list[str]], tree: MjcfTree, name: str
) -> tuple[Urdf, list[str]]:
    """Return the tree without free bodies that no closure touches, and their names.

    Raises
    ------
    OutOfClass
        If joints move something beside the mechanism.
    """
    loose = {link for links, closed in moving_groups(urdf, frames) if not closed for link in links}
    if not loose:
        return urdf, []
    held = [j for j in urdf.joints.values() if j.child in loose]
    other = [j.name for j in held if j.moves and j.type != "floating"]
    if other:
        raise OutOfClass(
            f"{urdf.path}: the mechanism could not be read: found joints of something else beside "
            f"it ('{other[0]}'), needed one mechanism in the file; remove the other bodies."
        )
    for joint in held:
        del tree.text.joints[joint.name]
    for link in loose:
        del tree.text.links[link]
    freed = [f"'{j.child}'" for j in held if j.type == "floating"]
    return parse_urdf(urdf.path, tree.text.robot(name), travel_needed=False), freed
