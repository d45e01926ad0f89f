"""At which height the legs of a planar mechanism lie: where their visible cylinders are.

In a plane the kinematics say nothing of heights, and joint origins may stand anywhere along their
axes. A camera sees the legs where their cylinders are.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from legcal.geometry.types import Array
from legcal.mechanism.bodies import Bodies
from legcal.mechanism.cylinders import COAXIAL, VisualCylinder, ends_in_body
from legcal.mechanism.leg_chain import JointGroup, LegChain


def at_visible_heights(
    chains: Sequence[LegChain], shown: Sequence[VisualCylinder], bodies: Bodies
) -> list[LegChain]:
    """Return the legs of a planar mechanism at the height of their longest cylinder.

    A leg without a cylinder over its axis stays where its slider, or its joint at the base, has its
    origin.

    Parameters
    ----------
    chains : sequence of LegChain
        Legs with an R joint at either end, all axes parallel.
    shown : sequence of VisualCylinder
        The cylinders of the file.
    bodies : Bodies
        The rigid bodies.
    """
    return [_raised(chain, shown, bodies) for chain in chains]


def _raised(chain: LegChain, shown: Sequence[VisualCylinder], bodies: Bodies) -> LegChain:
    """Return one leg with both centres at the height of its cylinder."""
    first, last = chain.steps[0], chain.steps[-1]
    if chain.platform.letter != "R" or len(chain.steps) != 2 + (chain.slider is not None):
        return chain
    on_base, on_lower = (first.line(side)[1] for side in (first.near, first.far))
    on_upper = on_lower
    if chain.slider is not None:
        T_lower, T_upper = (
            chain.slider.connection.T_body_joint[side]
            for side in (chain.slider.near, chain.slider.far)
        )
        on_upper = np.asarray((T_upper.rotation * T_lower.rotation.inv()).apply(on_lower))
    up = float(np.sign(on_upper @ last.line(last.near)[1]))
    on_platform = up * last.line(last.far)[1]
    halves = {
        chain.bodies[-1]: (chain.platform.centre_near, chain.u_upper, on_upper),
        chain.bodies[0]: (chain.base.centre_far, chain.u_lower, on_lower),
    }
    found = [
        (cylinder.length, height)
        for cylinder in shown
        if (body := bodies.body_of[cylinder.link]) in halves
        if (height := _height(ends_in_body(cylinder, bodies), *halves[body])) is not None
    ]
    if not found:
        return chain
    height = max(found)[1]
    return replace(
        chain,
        base=_moved(chain.base, height * on_base, height * on_lower),
        platform=_moved(chain.platform, height * on_upper, height * on_platform),
    )


def _height(ends: Array, centre: Array, u: Array, normal: Array) -> float | None:
    """Return how far over a leg's axis a cylinder lies along it [m], None if it does not."""
    offset = ends - centre
    heights = offset @ normal
    beside = offset - (offset @ u)[:, None] * u - heights.mean() * normal
    return float(heights.mean()) if np.linalg.norm(beside, axis=1).max() < COAXIAL else None


def _moved(group: JointGroup, near: Array, far: Array) -> JointGroup:
    """Return a joint with its centre moved in the bodies on both sides [m]."""
    return replace(group, centre_near=group.centre_near + near, centre_far=group.centre_far + far)
