"""World and tool in the URDF: two links, held by fixed joints; every other byte stays.

A ``world`` link above the root carries the machine, a ``tool`` link hangs on the platform. Where
they are there already, as an earlier location leaves them, their origins are changed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import ModelError, UsageError
from legcal.files.atomic import temporary_folder
from legcal.files.schema import is_plain_name
from legcal.geometry.frames import roll_pitch_yaw
from legcal.location.location import Location
from legcal.mechanism.load import load_mechanism
from legcal.mechanism.model import Mechanism
from legcal.mechanism.urdf import Urdf
from legcal.report.destination import existing_parent
from legcal.report.model_files import write_model
from legcal.report.urdf_patch import Origin, patch_origins

WORLD, TOOL = "world", "tool"
_SAME = 1e-12  # [m, rad]: rounding of the analysis


def write_located_model(
    mechanism: Mechanism,
    location: Location,
    folder: Path,
    *,
    world: str = WORLD,
    tool: str = TOOL,
) -> tuple[Path, Path]:
    """Write ``models/NAME.yaml`` and ``urdf/NAME.urdf`` with the located frames in the URDF.

    Parameters
    ----------
    mechanism : Mechanism
        The machine that was located.
    location : Location
        Its frames.
    folder : Path
        Gets ``models`` and ``urdf``; nothing there is replaced.
    world, tool : str
        The links.

    Returns
    -------
    tuple of Path
        The YAML and the URDF.

    Raises
    ------
    UsageError
        If files of these names are there, or the links have another meaning in the URDF.
    ModelError
        If the URDF does not let a link carry the machine.
    """
    content = with_frames(mechanism, location, world=world, tool=tool)
    located = replace(mechanism, urdf=replace(mechanism.urdf, content=content))
    with temporary_folder(existing_parent(folder / "x"), "located") as temporary:
        written, _ = write_model(located, temporary)
        check_same(mechanism, load_mechanism(written))
    return write_model(located, folder)


def with_frames(
    mechanism: Mechanism, location: Location, *, world: str = WORLD, tool: str = TOOL
) -> bytes:
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
    urdf = mechanism.urdf
    T_root_base = _from_root(urdf, mechanism.base)
    origins: dict[str, Origin] = {}
    added: list[str] = []
    if world in urdf.links:
        joint = _joint_of_world(mechanism, world)
        T_child_base = urdf.joints[joint].T_parent_origin.inv() * T_root_base
        origins[joint] = _origin(location.T_world_base * T_child_base.inv())
    else:
        T_world_root = location.T_world_base * T_root_base.inv()
        added += _elements(urdf, world, urdf.root, world, T_world_root)
    if tool in urdf.links:
        origins[_joint_of_tool(mechanism, tool)] = _origin(location.T_platform_tool)
    else:
        added += _elements(urdf, mechanism.platform, tool, tool, location.T_platform_tool)
    return _inserted(patch_origins(urdf.content, origins), added)


def _from_root(urdf: Urdf, base: str) -> RigidTransform:
    """Return T_root_base, refused where a joint between them moves."""
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


def _joint_of_world(mechanism: Mechanism, world: str) -> str:
    """Return the fixed joint below a world link that carries all the rest."""
    urdf = mechanism.urdf
    below = [joint for joint in urdf.joints.values() if joint.parent == world]
    if world == urdf.root != mechanism.base and len(below) == 1 and not below[0].moves:
        return below[0].name
    raise UsageError(
        f"{urdf.path}: the world could not be written: found a link '{world}' that is not a root "
        "with the machine on one fixed joint below it, needed such a link or a free name; give "
        "another name (--world-link)."
    )


def _joint_of_tool(mechanism: Mechanism, tool: str) -> str:
    """Return the fixed joint between the platform and a tool link that carries nothing."""
    urdf = mechanism.urdf
    joint = next((joint for joint in urdf.joints.values() if joint.child == tool), None)
    frames = {name for c in mechanism.chain.closures for name in (c.frame_1, c.frame_2)}
    carries = any(other.parent == tool for other in urdf.joints.values())
    if (
        joint is not None
        and not joint.moves
        and joint.parent == mechanism.platform
        and not carries
        and frames.isdisjoint((tool, joint.name))
    ):
        return joint.name
    raise UsageError(
        f"{urdf.path}: the tool could not be written: found a link '{tool}' that is not at the end "
        f"of a fixed joint on the platform '{mechanism.platform}', needed such a link or a free "
        "name; give another name (--tool-link)."
    )


def _elements(urdf: Urdf, parent: str, child: str, link: str, T: RigidTransform) -> list[str]:
    """Return a new link and the fixed joint between it and its neighbour, a line each."""
    taken = {*urdf.links, *urdf.joints}
    joint = f"{parent}_{child}_frame"
    while joint in taken:
        joint += "_"
    origin = _origin(T)
    return [
        f"<link name={quoteattr(link)}/>",
        f'<joint name={quoteattr(joint)} type="fixed"><parent link={quoteattr(parent)}/>'
        f"<child link={quoteattr(child)}/>"
        f'<origin xyz="{_numbers(origin.xyz)}" rpy="{_numbers(origin.rpy)}"/></joint>',
    ]


def _origin(T: RigidTransform) -> Origin:
    """Return a motion as a URDF has it."""
    return Origin(np.asarray(T.translation), roll_pitch_yaw(T.rotation.as_matrix()))


def _numbers(values: np.ndarray | None) -> str:
    """Return numbers with all their digits."""
    return "" if values is None else " ".join(repr(float(x)) for x in values)


def _inserted(content: bytes, lines: Sequence[str]) -> bytes:
    """Return a URDF with lines before the end of the robot."""
    if not lines:
        return content
    end = _end_of_robot(content)
    newline = b"\r\n" if b"\r\n" in content else b"\n"
    text = b"".join(b"  " + line.encode() + newline for line in lines)
    before = content[:end]
    if before.rstrip(b" \t").endswith(b"\n"):
        before = before.rstrip(b" \t")
    else:
        text = newline + text
    return before + text + content[end:]


def _end_of_robot(content: bytes) -> int:
    """Return the offset of ``</robot>``."""
    ends: list[int] = []
    parser = expat.ParserCreate()
    parser.EndElementHandler = lambda tag: ends.append(parser.CurrentByteIndex)
    parser.Parse(content, True)
    return ends[-1]


def check_same(before: Mechanism, after: Mechanism) -> None:
    """Check that a model with frames is the same machine.

    Raises
    ------
    ModelError
        If its analysis differs by more than rounding.
    """
    same = (
        before.leg_names == after.leg_names
        and before.motors == after.motors
        and before.mobility == after.mobility
        and before.frame_legs == after.frame_legs
        and all(
            np.abs(one - other).max() <= _SAME
            for one, other in (
                (before.A_base, after.A_base),
                (before.B_platform, after.B_platform),
                (before.q0, after.q0),
                (before.home.as_matrix(), after.home.as_matrix()),
            )
        )
    )
    if not same:
        raise ModelError(
            f"{before.urdf_path}: the frames could not be written: found another machine after "
            "it, needed the same one; give other names (--world-link, --tool-link)."
        )
