"""Whether a mechanism moves in a plane: all revolutes parallel to one normal (section 2)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import OutOfClass
from legcal.geometry.types import Array
from legcal.mechanism.axes import off_square, parallel, undirected
from legcal.mechanism.leg_chain import LegChain
from legcal.mechanism.urdf import UrdfJoint

Normals = tuple[Array, Array]


def plane_of_motion(chains: Sequence[LegChain]) -> Normals | None:
    """Return the normal of the plane in which a mechanism moves, None if it moves in space.

    All joints must be revolutes, all of their axes parallel; the sliders are perpendicular to
    them in every leg of the class.

    Parameters
    ----------
    chains : sequence of LegChain
        The legs.

    Returns
    -------
    tuple of (3,) array or None
        The unit normal in the bodies of base and platform, the same way up in both.
    """
    normals = [_normals(chain) for chain in chains]
    first = normals[0]
    if first is None:
        return None
    for other in normals:
        if other is None or not all(parallel(a, b) for a, b in zip(first, other, strict=True)):
            return None
    return first


def _normals(chain: LegChain) -> Normals | None:
    """Return the direction of all axes of a leg in base and platform, None if they differ."""
    if chain.base.letter != "R" or chain.platform.letter not in ("R", ""):
        return None
    v, w = chain.base.inner, chain.platform.inner
    if v is None or (w is not None and not parallel(v, w)):
        return None
    return v, np.asarray(chain.T_zero.rotation.inv().apply(v))


def in_links(normals: Normals, T_body_link: tuple[RigidTransform, RigidTransform]) -> Normals:
    """Return the normals in the links of base and platform.

    The last component that is not zero is positive in the base.
    """
    base, platform = (
        np.asarray(T.rotation.inv().apply(normal))
        for normal, T in zip(normals, T_body_link, strict=True)
    )
    return (base, platform) if np.all(undirected(base) == base) else (-base, -platform)


def check_virtual_joint(joint: UrdfJoint, normal: Array | None, path: Path) -> None:
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
