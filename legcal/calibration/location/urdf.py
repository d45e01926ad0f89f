"""World and tool in the URDF: two links on fixed joints; all else stays.

A ``world`` link above the root carries the machine, a ``tool`` link is a child of the platform. If
the links exist, as after an earlier location, only their origins are changed.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.location.document import Location
from legcal.errors import ModelError, UsageError
from legcal.files.schema import is_plain_name
from legcal.geometry.rotations import roll_pitch_yaw
from legcal.machine.model import Machine
from legcal.machine.model_writer import write_model
from legcal.machine.urdf import Urdf, UrdfPatch


def write_located_model(
    machine: Machine,  # the machine that was located
    location: Location,
    folder: Path,  # parent of ``models`` and ``urdf``; existing files are not replaced
    *,
    world: str = "world",
    tool: str = "tool",
) -> tuple[Path, Path]:
    """Write ``models/NAME.yaml`` and ``urdf/NAME.urdf`` with the located frames in the URDF.

    Returns tuple of Path: The YAML and the URDF.

    Raises UsageError if files of these names are there, or the links have another meaning in the
    URDF; ModelError if the URDF does not let a link carry the machine.
    """
    content = _with_frames(machine, location, world=world, tool=tool)
    return write_model(replace(machine, urdf=replace(machine.urdf, content=content)), folder)


def _with_frames(machine: Machine, location: Location, *, world: str, tool: str) -> bytes:
    """Return the URDF of a mechanism with the located frames in it."""
    for name in (world, tool):
        if not is_plain_name(name):
            raise UsageError(
                f"The frames could not be written: found the link name {name!r}, needed letters, "
                "digits, '-', '_' and '.'; give another one."
            )
    if world == tool:
        raise UsageError(
            f"The frames could not be written: found '{world}' for world and tool, needed two "
            "names; give another one."
        )
    urdf = machine.urdf
    T_root_base = _from_root(urdf, machine.base)
    patch = UrdfPatch(urdf.content)

    def place(joint: str, T: RigidTransform) -> None:
        patch.set_origin(joint, np.asarray(T.translation), roll_pitch_yaw(T.rotation.as_matrix()))

    if world in urdf.links:
        joint = _joint_of_world(machine, world)
        T_child_base = urdf.joints[joint].T_parent_origin.inv() * T_root_base
        place(joint, location.T_world_base * T_child_base.inv())
    else:
        T_world_root = location.T_world_base * T_root_base.inv()
        patch.add_frame(
            world, urdf.root, world, _unused_joint(urdf, world, urdf.root), T_world_root
        )
    if tool in urdf.links:
        place(_joint_of_tool(machine, tool), location.T_platform_tool)
    else:
        joint = _unused_joint(urdf, machine.platform, tool)
        patch.add_frame(machine.platform, tool, tool, joint, location.T_platform_tool)
    return patch.content()


def _from_root(urdf: Urdf, base: str) -> RigidTransform:
    """Return T_root_base; refuse a moving joint between them."""
    above = {joint.child: joint for joint in urdf.joints.values()}
    T, link = RigidTransform.identity(), base
    while link != urdf.root:
        joint = above[link]
        if joint.moves:
            raise ModelError(
                f"{urdf.path}: the world could not be written: found the base '{base}' below the "
                f"joint '{joint.name}', which moves, needed fixed joints between it and the root "
                f"'{urdf.root}'; hang the platform from the base."
            )
        T, link = joint.T_parent_origin * T, joint.parent
    return T


def _joint_of_world(machine: Machine, world: str) -> str:
    """Return the fixed joint below a world link that carries the whole machine."""
    urdf = machine.urdf
    below = [joint for joint in urdf.joints.values() if joint.parent == world]
    if world == urdf.root != machine.base and len(below) == 1 and not below[0].moves:
        return below[0].name
    raise UsageError(
        f"{urdf.path}: the world could not be written: found a link '{world}' that is not a root "
        "with the machine on one fixed joint below it, needed such a link or a free name; give "
        "another name (--world-link)."
    )


def _joint_of_tool(machine: Machine, tool: str) -> str:
    """Return the fixed joint between the platform and a tool link without children."""
    urdf = machine.urdf
    joint = next((joint for joint in urdf.joints.values() if joint.child == tool), None)
    frames = {name for c in machine.chain.closures for name in (c.frame_1, c.frame_2)}
    carries = any(other.parent == tool for other in urdf.joints.values())
    if (
        joint is not None
        and not joint.moves
        and joint.parent == machine.platform
        and not carries
        and frames.isdisjoint((tool, joint.name))
    ):
        return joint.name
    raise UsageError(
        f"{urdf.path}: the tool could not be written: found a link '{tool}' that is not at the end "
        f"of a fixed joint on the platform '{machine.platform}', needed such a link or a free "
        "name; give another name (--tool-link)."
    )


def _unused_joint(urdf: Urdf, parent: str, child: str) -> str:
    """Return a free name of a fixed joint between two links."""
    joint = f"{parent}_{child}_frame"
    while joint in urdf.links or joint in urdf.joints:
        joint += "_"
    return joint
