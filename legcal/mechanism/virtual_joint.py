"""The virtual joint of the tree that carries the platform: it must forbid nothing."""

from pathlib import Path

import numpy as np

from legcal.errors import OutOfClass
from legcal.geometry.types import Array
from legcal.mechanism.axes import off_square, parallel
from legcal.mechanism.bodies import Bodies
from legcal.mechanism.schema import LegcalBlock
from legcal.mechanism.urdf import Urdf, UrdfJoint


def check_type(block: LegcalBlock, urdf: Urdf, path: Path) -> None:
    """Check that the virtual joint, if there is one, has a type that is covered.

    Raises
    ------
    OutOfClass
        If it is neither floating nor planar, or planar about another axis than its z.
    """
    if block.platform_joint is None:
        return
    joint = urdf.joints[block.platform_joint]
    if joint.type not in ("floating", "planar"):
        raise OutOfClass(
            f"{path}: legcal.platform_joint '{joint.name}' is not covered: found a {joint.type} "
            "joint, needed a floating or planar one, which only says where the platform is; "
            "correct it, or write null if a leg carries the platform."
        )
    if joint.type == "planar" and not np.array_equal(joint.axis, [0.0, 0.0, 1.0]):
        axis = ", ".join(f"{x:g}" for x in joint.axis)
        raise OutOfClass(
            f"{path}: legcal.platform_joint '{joint.name}' is not covered: found a planar joint "
            f'with the axis ({axis}), needed <axis xyz="0 0 1"/>, because its plane is the xy '
            "plane of its frame; turn its origin rpy instead."
        )


def check_bodies(block: LegcalBlock, bodies: Bodies, urdf: Urdf, path: Path) -> None:
    """Check that the virtual joint carries the platform from the base.

    Raises
    ------
    OutOfClass
        If its links belong to other bodies.
    """
    if block.platform_joint is None:
        return
    joint = urdf.joints[block.platform_joint]
    found = bodies.body_of[joint.parent], bodies.body_of[joint.child]
    if found != (bodies.body_of[block.base], bodies.body_of[block.platform]):
        raise OutOfClass(
            f"{path}: legcal.platform_joint '{joint.name}' is not covered: found it between the "
            f"parent '{joint.parent}' and the child '{joint.child}', needed '{block.base}' and "
            f"'{block.platform}'; name the joint that carries the platform, or write null."
        )


def check_plane(joint: UrdfJoint, normal: Array | None, path: Path) -> None:
    """Check that a planar virtual joint lets the platform move as its legs do.

    Parameters
    ----------
    joint : UrdfJoint
        The virtual joint.
    normal : (3,) array or None
        The normal of the plane of motion in the parent link; None for a mechanism in space.
    path : Path
        The file that names it.

    Raises
    ------
    OutOfClass
        If the mechanism moves in space or in another plane.
    """
    if joint.type != "planar":
        return
    if normal is None:
        raise OutOfClass(
            f"{path}: legcal.platform_joint '{joint.name}' is not covered: found a planar joint, "
            "needed a floating one, because the axes of the legs do not let the platform move in "
            "one plane; correct its type."
        )
    z = joint.T_parent_origin.rotation.apply([0.0, 0.0, 1.0])
    if not parallel(z, normal):
        tilt = 90.0 - np.degrees(off_square(z, normal))
        raise OutOfClass(
            f"{path}: legcal.platform_joint '{joint.name}' is not covered: found its plane "
            f"{tilt:.4g} deg from the plane in which the legs move, needed the same plane within "
            "0.057 deg; correct its origin rpy."
        )
