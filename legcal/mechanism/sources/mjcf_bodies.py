"""The bodies of an MJCF file, written as the links and joints of a URDF."""

from dataclasses import dataclass, field

import numpy as np
from lxml import etree
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array
from legcal.mechanism.sources.mjcf_joints import is_free, write_joint
from legcal.mechanism.sources.mjcf_tree import WORLD, MjcfTree, Place, unused
from legcal.mechanism.sources.mjcf_values import Values, own_attributes, z_onto
from legcal.mechanism.sources.tree_text import EYE, TextCylinder

_LEFT_ALONE = ("inertial", "camera", "light", "plugin", "site")
_GEOMS = ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh", "sdf")
_NOT_READ = ("include", "composite", "flexcomp", "attach", "replicate")


def read_bodies(root: etree._Element, values: Values) -> MjcfTree:
    """Return the bodies of a ``<mujoco>`` as links and joints, problems noted in ``values``.

    The configuration of the file, where all joints are at their ``ref``, closes its loops.

    Parameters
    ----------
    root : Element
        The ``<mujoco>``.
    values : Values
        Its defaults and options.
    """
    named = (*root.iterfind("actuator/*"), *root.iterfind("sensor/jointpos"))
    tree = MjcfTree(values, driven=frozenset(str(element.get("joint")) for element in named))
    for element in root.iter(*_NOT_READ):
        values.problems.add(
            element, "is not expanded", "save the compiled model with MuJoCo and give that file"
        )
    for element in root.iterfind("worldbody//*[@name]"):
        if element.tag in ("body", "joint", "freejoint"):
            tree.taken.add(str(element.get("name")))
    tree.poses[WORLD] = EYE
    worlds = root.findall("worldbody")
    visuals: list[TextCylinder] = []
    bodies: list[tuple[etree._Element, Place]] = []
    for world in worlds:
        inside = _contents(tree, world, Place(WORLD, EYE, world.get("childclass", "main")))
        visuals += inside.cylinders
        bodies += inside.bodies
    tree.text.link(WORLD, tuple(visuals))
    while bodies:
        element, place = bodies.pop(0)
        bodies = _body(tree, element, place) + bodies
    return tree


@dataclass
class _Contents:
    """What stands directly in a body, also within its ``<frame>`` elements."""

    joints: list[tuple[etree._Element, Place]] = field(default_factory=list)
    bodies: list[tuple[etree._Element, Place]] = field(default_factory=list)
    cylinders: list[TextCylinder] = field(default_factory=list)


def _contents(tree: MjcfTree, element: etree._Element, place: Place) -> _Contents:
    """Return the joints, bodies and cylinders of a body and note its sites."""
    found = _Contents()
    pending = [(part, place) for part in element]
    while pending:
        part, where = pending.pop(0)
        if part.tag == "frame":
            T = where.T_body_frame * tree.values.pose(part, own_attributes(part))
            inner = Place(where.body, T, _class_within(tree, part, where.childclass))
            pending = [(inside, inner) for inside in part] + pending
        elif part.tag == "body":
            found.bodies.append((part, where))
        elif part.tag in ("joint", "freejoint"):
            found.joints.append((part, where))
        elif part.tag == "geom":
            cylinder = _cylinder(tree, part, where)
            if cylinder is not None:
                found.cylinders.append(cylinder)
        elif part.tag == "site" and part.get("name"):
            _site(tree, part, where)
        elif isinstance(part.tag, str) and part.tag not in (*_LEFT_ALONE, *_NOT_READ):
            tree.values.problems.add(part, "is no element of a body", "correct or remove it")
    return found


def _class_within(tree: MjcfTree, element: etree._Element, outer: str) -> str:
    """Return the default class that holds within a body or frame."""
    name = element.get("childclass", outer)
    if not tree.values.has_class(name):
        tree.values.problems.add(
            element, f"names the default class '{name}', which is not in the file",
            "correct the name",
        )  # fmt: skip
        return outer
    return name


def _body(
    tree: MjcfTree, element: etree._Element, place: Place
) -> list[tuple[etree._Element, Place]]:
    """Write a body with its joints, and return the bodies on it."""
    name = element.get("name", "")
    if name in tree.poses:
        tree.values.problems.add(
            element, f"has the name '{name}', which another body has", "give each its own name"
        )
    if not name or name in tree.poses:
        name = unused(tree, f"body{len(tree.poses)}")
    T_parent_body = place.T_body_frame * tree.values.pose(element, own_attributes(element))
    tree.poses[name] = tree.poses[place.body] * T_parent_body
    inside = _contents(
        tree, element, Place(name, EYE, _class_within(tree, element, place.childclass))
    )
    at, T_at_body = place.body, T_parent_body
    if at == WORLD and is_free(tree, inside.joints):
        tree.text.joint(unused(tree, f"{name}_free"), "floating", at, name, T_at_body)
        at, inside.joints = name, []
    for i, (joint, where) in enumerate(inside.joints):
        only = len(inside.joints) == 1
        at, T_at_body = write_joint(
            tree, joint, where, at, T_at_body, last=i + 1 == len(inside.joints), only=only
        )
    if at != name:
        tree.text.joint(unused(tree, f"{name}_fixed"), "fixed", at, name, T_at_body)
    tree.text.link(name, tuple(inside.cylinders))
    return inside.bodies


def _cylinder(tree: MjcfTree, element: etree._Element, place: Place) -> TextCylinder | None:
    """Return the cylinder of a geom that is a cylinder or a capsule, else None."""
    values = tree.values
    attributes = values.attributes(element, place.childclass)
    kind = attributes.get("type", "sphere")
    if kind not in _GEOMS:
        values.problems.add(
            element, f"has the type '{kind}', needed one of {', '.join(_GEOMS)}", "correct it"
        )
    if kind not in ("cylinder", "capsule") or "mesh" in attributes:
        return None
    size = values.numbers(element, attributes, "size", (1, 2, 3))
    ends = values.numbers(element, attributes, "fromto", (6,))
    length = None
    T: RigidTransform
    if ends is not None:
        along: Array = ends[3:] - ends[:3]
        length = float(np.linalg.norm(along))
        if length > 0.0:
            T = RigidTransform.from_components(0.5 * (ends[3:] + ends[:3]), z_onto(along))
    else:
        T = values.pose(element, attributes)
        length = 2.0 * float(size[1]) if size is not None and len(size) > 1 else None
    if size is None or length is None or not (size[0] > 0.0 and length > 0.0):
        values.problems.add(
            element, "is a cylinder without a radius and a length above zero",
            "write size, or fromto and size",
        )  # fmt: skip
        return None
    return TextCylinder(place.T_body_frame * T, float(size[0]), length)


def _site(tree: MjcfTree, element: etree._Element, place: Place) -> None:
    """Note a site by its name."""
    values = tree.values
    name = str(element.get("name"))
    if name in tree.sites:
        values.problems.add(
            element, f"has the name '{name}', which another site has", "give each its own name"
        )
    attributes = values.attributes(element, place.childclass)
    ends = values.numbers(element, attributes, "fromto", (6,))
    if ends is not None and np.linalg.norm(ends[3:] - ends[:3]) > 0.0:
        T = RigidTransform.from_components(0.5 * (ends[3:] + ends[:3]), z_onto(ends[3:] - ends[:3]))
    else:
        T = values.pose(element, attributes)
    tree.sites[name] = place.body, place.T_body_frame * T
