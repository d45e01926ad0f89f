"""Whether a mechanism moves in a plane: all revolutes parallel to one normal (section 2)."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array
from legcal.mechanism.axes import parallel, undirected
from legcal.mechanism.bodies import frame_link
from legcal.mechanism.chain import Closure
from legcal.mechanism.leg_chain import LegChain
from legcal.mechanism.schema import LegcalBlock
from legcal.mechanism.sources.reference import reference_poses
from legcal.mechanism.urdf import Urdf

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


def normals_of_closures(
    in_links: Normals | None, closures: Sequence[Closure], block: LegcalBlock, urdf: Urdf
) -> list[Array | None]:
    """Return for which closures it is enough to hold in the plane, with its normal there.

    Closures of a planar mechanism repeat that it is planar, and contradict each other by what
    its axes are rounded. All are held in the plane alone; but where a floating joint carries the
    platform, one more is needed to hold that in the plane.

    Parameters
    ----------
    in_links : tuple of (3,) array or None
        The normals in the links of base and platform; None in space.
    closures : sequence of Closure
        What coincides.
    block : LegcalBlock
        The links of base and platform, and the virtual joint.
    urdf : Urdf
        The tree.

    Returns
    -------
    list of (3,) array or None
        The normal in the first frame of each closure, None where everything is to hold.
    """
    if in_links is None:
        return [None] * len(closures)
    poses, parents = reference_poses(urdf), {j.child: j for j in urdf.joints.values()}
    virtual = None if block.platform_joint is None else urdf.joints[block.platform_joint]
    floats = virtual is not None and virtual.type == "floating"
    normals: list[Array | None] = []
    for closure in closures:
        link = above = frame_link(urdf, closure.frame_1)
        while above in parents and parents[above] is not virtual:
            above = parents[above].parent
        root, normal = (block.base, in_links[0])
        if above in parents and floats:
            root, normal = (block.platform, in_links[1])
        turn = poses[link].rotation.inv() * poses[root].rotation
        normals.append(np.asarray(turn.apply(normal)) if closure.kind == "6d" else None)
    return [None, *normals[1:]] if floats else normals
