"""The bodies of an MJCF file, written as the links and joints of a URDF."""

from dataclasses import dataclass, field

import numpy as np
from lxml import etree
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array
from legcal.mechanism.sources.mjcf_values import Attributes, Values, own_attributes, z_onto
from legcal.mechanism.sources.tree_text import EYE, FULL_TURN, TextCylinder, TreeText
from legcal.mechanism.urdf_checks import number_list

WORLD = "world"
_Z = (0.0, 0.0, 1.0)
_NOT_READ = ("include", "composite", "flexcomp", "attach", "replicate")


@dataclass
class MjcfTree:
    """What is found while the bodies are walked.

    Attributes
    ----------
    text : TreeText
        The URDF.
    poses : dict of str to RigidTransform
        The bodies in the world in the configuration of the file, where its loops are closed.
    sites : dict of str to (str, RigidTransform)
        Body and pose there of every named site.
    joints : dict of str to str
        The type of every hinge, slide, ball or free joint.
    references : dict of str to float
        The values [rad, m] of hinges and slides in the configuration of the file.
    taken : set of str
        Names that no new link or joint may have.
    driven : frozenset of str
        The joints that actuators drive or sensors measure.
    """

    values: Values
    text: TreeText = field(default_factory=TreeText)
    poses: dict[str, RigidTransform] = field(default_factory=dict)
    sites: dict[str, tuple[str, RigidTransform]] = field(default_factory=dict)
    joints: dict[str, str] = field(default_factory=dict)
    references: dict[str, float] = field(default_factory=dict)
    taken: set[str] = field(default_factory=set)
    driven: frozenset[str] = frozenset()


@dataclass(frozen=True, eq=False)
class _Place:
    """Where in the tree an element stands: its body, the frame it is written in, its class."""

    body: str
    T_body_frame: RigidTransform
    childclass: str


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
    bodies: list[tuple[etree._Element, _Place]] = []
    for world in worlds:
        inside = _contents(tree, world, _Place(WORLD, EYE, world.get("childclass", "main")))
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

    joints: list[tuple[etree._Element, _Place]] = field(default_factory=list)
    bodies: list[tuple[etree._Element, _Place]] = field(default_factory=list)
    cylinders: list[TextCylinder] = field(default_factory=list)


def _contents(tree: MjcfTree, element: etree._Element, place: _Place) -> _Contents:
    """Return the joints, bodies and cylinders of a body and note its sites."""
    found = _Contents()
    pending = [(part, place) for part in element]
    while pending:
        part, where = pending.pop(0)
        if part.tag == "frame":
            T = where.T_body_frame * tree.values.pose(part, own_attributes(part))
            inner = _Place(where.body, T, _class_within(tree, part, where.childclass))
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
    tree: MjcfTree, element: etree._Element, place: _Place
) -> list[tuple[etree._Element, _Place]]:
    """Write a body with its joints, and return the bodies on it."""
    name = element.get("name", "")
    if name in tree.poses:
        tree.values.problems.add(
            element, f"has the name '{name}', which another body has", "give each its own name"
        )
    if not name or name in tree.poses:
        name = _unused(tree, f"body{len(tree.poses)}")
    T_parent_body = place.T_body_frame * tree.values.pose(element, own_attributes(element))
    tree.poses[name] = tree.poses[place.body] * T_parent_body
    inside = _contents(
        tree, element, _Place(name, EYE, _class_within(tree, element, place.childclass))
    )
    at, T_at_body = place.body, T_parent_body
    if at == WORLD and _is_free(tree, inside.joints):
        tree.text.joint(_unused(tree, f"{name}_free"), "floating", at, name, T_at_body)
        at, inside.joints = name, []
    for i, (joint, where) in enumerate(inside.joints):
        only = len(inside.joints) == 1
        at, T_at_body = _joint(
            tree, joint, where, at, T_at_body, last=i + 1 == len(inside.joints), only=only
        )
    if at != name:
        tree.text.joint(_unused(tree, f"{name}_fixed"), "fixed", at, name, T_at_body)
    tree.text.link(name, tuple(inside.cylinders))
    return inside.bodies


def _is_free(tree: MjcfTree, joints: list[tuple[etree._Element, _Place]]) -> bool:
    """Say whether the joints of a body, none of them driven, leave it all six freedoms."""
    axes: dict[str, list[Array]] = {"slide": [], "hinge": [], "ball": []}
    for element, place in joints:
        attributes = tree.values.attributes(element, place.childclass)
        kind = attributes.get("type", "hinge")
        axis = number_list(attributes.get("axis", "0 0 1"), 3)
        driven = attributes.get("name") in tree.driven
        if element.tag != "joint" or kind not in axes or axis is None or driven:
            return False
        axes[kind].append(np.array(axis))
    turns_freely = len(axes["ball"]) == 1 if axes["ball"] else _span_space(axes["hinge"])
    return _span_space(axes["slide"]) and turns_freely and len(axes["hinge"]) in (0, 3)


def _span_space(axes: list[Array]) -> bool:
    """Say whether there are three axes, independent of each other."""
    return len(axes) == 3 and int(np.linalg.matrix_rank(np.array(axes), tol=1e-3)) == 3


def _joint(
    tree: MjcfTree,
    element: etree._Element,
    place: _Place,
    at: str,
    T_at_body: RigidTransform,
    *,
    last: bool,
    only: bool,
) -> tuple[str, RigidTransform]:
    """Write one joint of a body; return the link after it and the body's frame in that link."""
    values = tree.values
    attributes = values.attributes(element, place.childclass)
    kind = "free" if element.tag == "freejoint" else attributes.get("type", "hinge")
    name = attributes.get("name", "")
    if name and name in tree.joints:
        values.problems.add(
            element, f"has the name '{name}', which another joint has", "give each its own name"
        )
    if not name or name in tree.joints:
        name = _unused(tree, f"{place.body}_{kind}")
    tree.joints[name] = kind
    if kind == "free":
        if not only or at != WORLD:
            values.problems.add(
                element, "frees a body that has other joints or is not on the world itself",
                "a free joint stands alone in a body of <worldbody>",
            )  # fmt: skip
        tree.text.joint(name, "floating", at, place.body, T_at_body)
        return place.body, EYE
    if kind not in ("hinge", "slide", "ball"):
        values.problems.add(
            element, f"has the type '{kind}', needed free, ball, slide or hinge", "correct it"
        )
        return at, T_at_body
    pos = values.numbers(element, attributes, "pos", (3,))
    pos = np.zeros(3) if pos is None or kind == "slide" else pos
    T_body_joint = RigidTransform.from_translation(place.T_body_frame.apply(pos))
    T_at_joint = T_at_body * T_body_joint
    centred = not np.asarray(T_body_joint.translation).any()
    child = place.body if last and centred else _unused(tree, f"{name}_link")
    if kind == "ball":
        _ball(tree, name, at, child, T_at_joint)
    else:
        _one_axis(tree, element, attributes, place, name, kind, at, child, T_at_joint)
    if child != place.body:
        tree.text.link(child)
    return child, EYE if child == place.body else T_body_joint.inv()


def _ball(tree: MjcfTree, name: str, at: str, child: str, T_at_joint: RigidTransform) -> None:
    """Write a ball joint as three revolutes, perpendicular in the configuration of the file."""
    for i, letter in enumerate("xyz"):
        after = child if letter == "z" else _unused(tree, f"{name}_{letter}_link")
        if after != child:
            tree.text.link(after)
        tree.text.joint(
            _unused(tree, f"{name}_{letter}"),
            "revolute",
            at,
            after,
            T_at_joint if i == 0 else EYE,
            np.eye(3)[i],
        )
        at = after


def _one_axis(
    tree: MjcfTree,
    element: etree._Element,
    attributes: Attributes,
    place: _Place,
    name: str,
    kind: str,
    at: str,
    child: str,
    T_at_joint: RigidTransform,
) -> None:
    """Write a hinge or a slide, its zero where the value of the file is."""
    values = tree.values
    given = values.numbers(element, attributes, "axis", (3,))
    axis = np.array(_Z) if given is None else given
    if not np.linalg.norm(axis) > 1e-9:
        values.problems.add(element, "has a zero axis, needed a direction", "correct its axis")
        axis = np.array(_Z)
    axis = place.T_body_frame.rotation.apply(axis / np.linalg.norm(axis))
    ref = values.numbers(element, attributes, "ref", (1,))
    zero = 0.0 if ref is None else float(ref[0])
    limits = _range(tree, element, attributes)
    if kind == "slide":
        T_at_joint = T_at_joint * RigidTransform.from_translation(-zero * axis)
        tree.references[name] = zero
        tree.text.joint(name, "prismatic", at, child, T_at_joint, axis, limits)
        return
    zero = values.compiler.radians(zero)
    tree.references[name] = zero
    turn = Rotation.from_rotvec(-zero * axis)
    T_at_joint = T_at_joint * RigidTransform.from_rotation(turn)
    turns = (-FULL_TURN, FULL_TURN)
    if limits is not None:
        turns = values.compiler.radians(limits[0]), values.compiler.radians(limits[1])
    tree.text.joint(name, "revolute", at, child, T_at_joint, axis, turns)


def _range(
    tree: MjcfTree, element: etree._Element, attributes: Attributes
) -> tuple[float, float] | None:
    """Return the limits of a joint as the file writes them, or None."""
    numbers = tree.values.numbers(element, attributes, "range", (2,))
    limited = attributes.get("limited", "auto")
    if numbers is None or limited == "false" or not numbers.any():
        return None
    if limited == "auto" and not tree.values.compiler.autolimits:
        return None
    lower, upper = float(numbers[0]), float(numbers[1])
    if not lower < upper:
        tree.values.problems.add(
            element, f"has the range {lower:g} to {upper:g}", "give the lower end first"
        )
        return None
    return lower, upper


def _cylinder(tree: MjcfTree, element: etree._Element, place: _Place) -> TextCylinder | None:
    """Return the cylinder of a geom that is a cylinder or a capsule, else None."""
    values = tree.values
    attributes = values.attributes(element, place.childclass)
    if attributes.get("type", "sphere") not in ("cylinder", "capsule") or "mesh" in attributes:
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


def _site(tree: MjcfTree, element: etree._Element, place: _Place) -> None:
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


def _unused(tree: MjcfTree, name: str) -> str:
    """Return a name that nothing in the file has, and take it."""
    number, found = 1, name
    while found in tree.taken or found in tree.text.links or found in tree.text.joints:
        number += 1
        found = f"{name}_{number}"
    tree.taken.add(found)
    return found
