"""Closures of formats that join two links by a joint, written as frames that coincide.

A point becomes a ``3d`` pair and a weld a ``6d`` pair. A revolute or universal joint that closes a
loop becomes one or two revolute joints with massless links, welded to the other side.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array
from legcal.mechanism.sources.tree_text import EYE, TreeText

LoopKind = Literal["point", "weld", "revolute", "universal"]
_X, _Y, _Z = np.eye(3)


@dataclass(frozen=True, eq=False)
class Loop:
    """A joint between two links that closes a loop of the tree.

    Attributes
    ----------
    name : str
        Its name; new links and joints are named after it.
    kind : {"point", "weld", "revolute", "universal"}
        What of both frames coincides.
    links : tuple of str
        The two links.
    T_link_frame : tuple of RigidTransform
        The frame of the joint in either link.
    axes : tuple of (3,) array
        Unit axis in either frame: the common one of a revolute joint; of a universal one the
        axis that is fixed in the first link and the axis that is fixed in the second.
    """

    name: str
    kind: LoopKind
    links: tuple[str, str]
    T_link_frame: tuple[RigidTransform, RigidTransform]
    axes: tuple[Array, Array] = (_X, _X)


def close_loop(
    loop: Loop, text: TreeText, poses: Mapping[str, RigidTransform]
) -> tuple[list[str], str]:
    """Add the frames of a loop to a tree and return the closure.

    Parameters
    ----------
    loop : Loop
        The joint that closes it.
    text : TreeText
        The tree; frames are added on links of their own, so that calibration can move them.
    poses : mapping of str to RigidTransform
        A configuration that is closed, or near one: the zeros of new joints are taken from it.

    Returns
    -------
    frames : list of str
        The two links that coincide.
    type : str
        ``3d`` or ``6d``.
    """
    one, two = loop.T_link_frame
    if loop.kind in ("revolute", "universal"):
        one, two = _with_axes(loop, poses)
    ends = []
    for number, (link, T_link_frame) in enumerate(
        zip(loop.links, (one, two), strict=True), start=1
    ):
        frame = text.unused(f"{loop.name}_{number}")
        text.link(frame)
        text.joint(text.unused(f"{frame}_frame"), "fixed", link, frame, T_link_frame)
        ends.append(frame)
    turns = {"revolute": (_Z,), "universal": (_X, _Y)}.get(loop.kind, ())
    for axis in turns:
        turned = text.unused(f"{loop.name}_turned")
        text.link(turned)
        text.joint(text.unused(f"{turned}_joint"), "revolute", ends[0], turned, EYE, axis)
        ends[0] = turned
    return ends, "3d" if loop.kind == "point" else "6d"


def _with_axes(
    loop: Loop, poses: Mapping[str, RigidTransform]
) -> tuple[RigidTransform, RigidTransform]:
    """Return the frames turned onto the axes of the joint, alike where the loop is closed."""
    one, two = loop.T_link_frame
    first, second = (
        T.rotation.apply(axis) for T, axis in zip(loop.T_link_frame, loop.axes, strict=True)
    )
    R_two_one = poses[loop.links[1]].rotation.inv() * poses[loop.links[0]].rotation
    if loop.kind == "revolute":
        across = _across(first, np.roll(first, 1))
        across_two = _across(second, R_two_one.apply(across))
        rotations = (
            _columns(across, np.cross(first, across), first),
            _columns(across_two, np.cross(second, across_two), second),
        )
    else:
        along_y = _across(first, R_two_one.inv().apply(second))
        along_x = _across(second, R_two_one.apply(first))
        rotations = (
            _columns(first, along_y, np.cross(first, along_y)),
            _columns(along_x, second, np.cross(along_x, second)),
        )
    return (
        RigidTransform.from_components(one.translation, rotations[0]),
        RigidTransform.from_components(two.translation, rotations[1]),
    )


def _across(axis: Array, direction: Array) -> Array:
    """Return the unit part of a direction across an axis, or another one where it has none."""
    for candidate in (direction, np.eye(3)[int(np.argmin(np.abs(axis)))]):
        part = candidate - (candidate @ axis) * axis
        if np.linalg.norm(part) > 1e-3 * np.linalg.norm(candidate):
            break
    return np.asarray(part / np.linalg.norm(part))


def _columns(x: Array, y: Array, z: Array) -> Rotation:
    """Return the rotation whose columns are three perpendicular unit vectors."""
    return Rotation.from_matrix(np.column_stack([x, y, z]))
