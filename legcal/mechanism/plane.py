"""Whether a mechanism moves in a plane: all revolutes parallel to one normal (section 2)."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array
from legcal.mechanism.axes import parallel, undirected
from legcal.mechanism.leg_chain import LegChain

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
