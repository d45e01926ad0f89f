"""A leg in the links of base and platform, from its chain: centres, length law, axes and twist."""

import math
from typing import cast

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array
from legcal.mechanism.axes import undirected
from legcal.mechanism.leg import JointLetter, Leg, LegKind
from legcal.mechanism.leg_chain import JointGroup, LegChain


def leg_of(
    name: str,
    chain: LegChain,
    T_body_link: tuple[RigidTransform, RigidTransform],
    *,
    travel: tuple[float, float],
    actuated: bool,
    spatial: bool,
    home: RigidTransform | None,
) -> Leg:
    """Return a leg in the links of base and platform.

    Parameters
    ----------
    name : str
        Its name.
    chain : LegChain
        Its joints.
    T_body_link : tuple of RigidTransform
        The links of base and platform in their bodies.
    travel : tuple of float
        Limits of the slider [m].
    actuated : bool
        Whether its slider has a motor.
    spatial : bool
        Whether the mechanism moves in space; in a plane axes and twist say nothing.
    home : RigidTransform or None
        T_base_platform of a pose that tells the sign of the length law.
    """
    T_base, T_platform = T_body_link
    A_base = np.asarray(T_base.inv().apply(chain.base.centre_near))
    B_platform = np.asarray(T_platform.inv().apply(chain.platform.centre_far))
    sign, kind = 1, LegKind.CONSTANT
    if chain.slider is not None:
        length = None if home is None else float(np.linalg.norm(home.apply(B_platform) - A_base))
        sign = _sign(chain.reach, travel, length)
        kind = LegKind.ACTUATED if actuated else LegKind.PASSIVE
    base_axis = _axis(chain, chain.base, T_base)
    platform_axis = _axis(chain, chain.platform, T_platform)
    if chain.platform.letter == "":
        platform_axis = sign * np.asarray(T_platform.rotation.inv().apply(chain.u_platform))
    return Leg(
        name=name,
        base_joint=cast("JointLetter", chain.base.letter),
        platform_joint=chain.platform.letter,
        kind=kind,
        prismatic=chain.motor,
        A_base=A_base,
        B_platform=B_platform,
        q0=sign * chain.reach,
        sign=sign,
        travel=travel,
        cylinders=(),
        base_axis=base_axis if spatial else None,
        platform_axis=platform_axis if spatial else None,
        twist=_twist(chain, sign, platform_axis, T_platform) if spatial else None,
    )


def _sign(reach: float, travel: tuple[float, float], length: float | None) -> int:
    """Return whether a leg grows (+1) or shrinks (-1) with its joint value.

    B stands at reach + q along the slider. Its length at home tells on which side of A, where
    only one of the two is within the travel; else the middle of the travel does.
    """
    if length is not None:
        inside = [travel[0] <= s * length - reach <= travel[1] for s in (1, -1)]
        if inside[0] != inside[1]:
            return 1 if inside[0] else -1
    return 1 if reach + 0.5 * (travel[0] + travel[1]) > 0.0 else -1


def _axis(chain: LegChain, group: JointGroup, T_body_link: RigidTransform) -> Array | None:
    """Return the axis of a joint in its link, where it is a parameter."""
    if group.outer is None or (group.letter == "U" and chain.twists):
        return None
    return undirected(np.asarray(T_body_link.rotation.inv().apply(group.outer)))


def _twist(
    chain: LegChain, sign: int, platform_axis: Array | None, T_platform: RigidTransform
) -> float | None:
    """Return the angle about u between the inner axes of a leg without an S joint [rad]."""
    if chain.twists:
        return None
    p, w = chain.base.inner, chain.platform.inner
    if w is None and platform_axis is not None:
        T_zero_link = chain.T_zero.rotation * T_platform.rotation
        w = np.asarray(T_zero_link.apply(normal_basis(platform_axis)[0]))
    if p is None or w is None:
        raise ValueError("a leg without an S joint has an axis at both ends")
    angle = math.atan2(float(sign * chain.u_zero @ np.cross(p, w)), float(p @ w))
    # modulo pi; just above -pi/2 is rounding, and means pi/2
    return angle - math.pi * math.ceil(angle / math.pi - 0.5 - 1e-10)
