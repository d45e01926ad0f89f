"""Rigid bodies of a mechanism and the joints between them, independent of the tree of its URDF.

Links connected by fixed joints are one body, and so are two bodies welded by a ``6d`` closure.
The remaining connections are the movable joints of the tree and a spherical joint at each ``3d``
closure. The virtual platform joint carries nothing and is left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from legcal.errors import ModelError
from legcal.geometry.motions import matrix_inverse, matrix_product
from legcal.geometry.types import Array
from legcal.machine.chain import Closure
from legcal.machine.urdf import Urdf

ConnectionType = Literal["revolute", "prismatic", "sphere"]


@dataclass(frozen=True, eq=False)
class Connection:
    """A joint of the mechanism between two bodies: one of the tree, or a ``3d`` closure."""

    type: ConnectionType
    bodies: tuple[str, str]  # named by one of their links; parent and child of a joint of the tree
    T_body_joint: tuple[Array, Array]  # (4, 4) each; the joint moves the second frame in the first
    joint: str | None  # the URDF joint; None for a closure
    closure: int | None  # the index of the closure; None for a joint of the tree


@dataclass(frozen=True, eq=False)
class Bodies:
    """The bodies and connections of a mechanism."""

    body_of: dict[str, str]  # body of every link
    T_body_link: dict[str, Array]  # (4, 4)
    connections: tuple[Connection, ...]  # without the virtual platform joint


def rigid_bodies(urdf: Urdf, closures: Sequence[Closure], platform_joint: str | None) -> Bodies:
    """Return the bodies of a tree with closures, and the joints between them.

    Raises
    ------
    ModelError
        If a weld closes a loop of bodies that are rigid already.
    """
    body_of = {link: link for link in urdf.links}
    T_body_link = {link: np.eye(4) for link in urdf.links}
    for joint in urdf.joints.values():
        if not joint.moves:
            T = joint.T_parent_origin.as_matrix()
            _merge(body_of, T_body_link, joint.parent, joint.child, T)
    for closure in closures:
        if closure.kind == "6d":
            first, second = (frame_link(urdf, name) for name in (closure.frame_1, closure.frame_2))
            if body_of[first] == body_of[second]:
                raise ModelError(
                    f"the 6d closure of '{closure.frame_1}' and '{closure.frame_2}' could not "
                    "be used",
                    "both on one rigid body",
                    "two",
                    "remove it",
                    urdf.path,
                )
            _merge(body_of, T_body_link, first, second, np.eye(4))
    tree = [
        Connection(
            "prismatic" if joint.type == "prismatic" else "revolute",
            (body_of[joint.parent], body_of[joint.child]),
            (
                matrix_product(T_body_link[joint.parent], joint.T_parent_origin.as_matrix()),
                T_body_link[joint.child],
            ),
            joint.name,
            None,
        )
        for joint in urdf.joints.values()
        if joint.moves and joint.name != platform_joint
    ]
    spheres = []
    for i, closure in enumerate(closures):
        if closure.kind == "3d":
            first, second = (frame_link(urdf, name) for name in (closure.frame_1, closure.frame_2))
            bodies, poses = (
                (body_of[first], body_of[second]),
                (T_body_link[first], T_body_link[second]),
            )
            spheres.append(Connection("sphere", bodies, poses, None, i))
    return Bodies(body_of, T_body_link, (*tree, *spheres))


def frame_link(urdf: Urdf, frame: str) -> str:
    """Return the link of a frame, named by a link or by the joint whose child it is."""
    return frame if frame in urdf.links else urdf.joints[frame].child


def _merge(
    body_of: dict[str, str],
    T_body_link: dict[str, Array],
    keep: str,
    join: str,
    T_keep_join: Array,
) -> None:
    into, gone = body_of[keep], body_of[join]
    T_into_gone = matrix_product(T_body_link[keep], T_keep_join, matrix_inverse(T_body_link[join]))
    for link, body in body_of.items():
        if body == gone:
            body_of[link] = into
            T_body_link[link] = matrix_product(T_into_gone, T_body_link[link])
