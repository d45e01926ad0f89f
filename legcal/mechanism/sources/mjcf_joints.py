"""The joints of an MJCF body, written as those of a URDF with massless links between them.

MuJoCo applies the joints of a body one after the other, each about a point of the body.
"""

import numpy as np
from lxml import etree
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array
from legcal.mechanism.sources.mjcf_tree import WORLD, MjcfTree, Place, unused
from legcal.mechanism.sources.mjcf_values import Attributes
from legcal.mechanism.sources.tree_text import EYE, FULL_TURN
from legcal.mechanism.urdf_checks import number_list

_Z = (0.0, 0.0, 1.0)


def is_free(tree: MjcfTree, joints: list[tuple[etree._Element, Place]]) -> bool:
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


def write_joint(
    tree: MjcfTree,
    element: etree._Element,
    place: Place,
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
        name = unused(tree, f"{place.body}_{kind}")
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
    child = place.body if last and centred else unused(tree, f"{name}_link")
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
        after = child if letter == "z" else unused(tree, f"{name}_{letter}_link")
        if after != child:
            tree.text.link(after)
        tree.text.joint(
            unused(tree, f"{name}_{letter}"),
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
    place: Place,
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
