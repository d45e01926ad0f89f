"""Visible cylinders of a file: along legs and on arms; the heights of planar legs.

The kinematics of planar machines do not determine heights, and joint origins may be anywhere along
their axes. A camera sees the legs where their cylinders are.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np

from legcal.geometry.lines import cross, distance_to_line
from legcal.geometry.motions import matrix_applied, matrix_inverse, matrix_product
from legcal.geometry.types import Array
from legcal.machine.actuator import Actuator, Arm, Line
from legcal.machine.bodies import Bodies
from legcal.machine.classification import joint_tolerance
from legcal.machine.leg import Cylinder, JointType, Leg, LegChain, Step
from legcal.machine.urdf import Urdf, origins_of, parse_robot

PARALLEL = 1e-6
COAXIAL = 10.0  # largest offset of the ends of a coaxial cylinder, in tolerances of joints

Half = tuple[Literal["base", "platform"], Array, Array]


class VisualCylinder(NamedTuple):
    """A visual cylinder of the file: its link, its pose there, radius and length [m]."""

    link: str
    T_link_cylinder: Array  # (4, 4)
    radius: float
    length: float


def coaxial_tolerance(legs: Sequence[Leg] | Sequence[LegChain]) -> float:
    """Return the largest distance [m] of the ends of a cylinder along a leg from its axis."""
    joints = ([leg.A for leg in legs], [leg.B for leg in legs])
    return COAXIAL * joint_tolerance(joints)


def with_cylinders(
    legs: Sequence[Leg],
    shown: Sequence[VisualCylinder],
    bodies: Bodies,
) -> tuple[Leg, ...]:
    """Return the legs with the visual cylinders that are coaxial with them, in the file's order.

    A cylinder counts on every link that moves rigidly with the base or the platform half of the
    leg, or only turns about the leg's axis.
    """
    within = coaxial_tolerance(legs)
    return tuple(
        leg
        if leg.chain is None
        else replace(leg, cylinders=_along(leg, leg.chain, shown, bodies, within))
        for leg in legs
    )


def with_arms(
    legs: Sequence[Leg], shown: Sequence[VisualCylinder], bodies: Bodies, T_body_base: Array
) -> tuple[Leg, ...]:
    """Return the legs with the cylindrical arms of their motors; the base link is at T_body_base.

    The arm is the longest cylinder on the link of a motor, other than those about the motor axis.
    """
    arms: dict[str, Actuator] = {}
    within = coaxial_tolerance(legs)
    for leg in legs:
        actuator, chain = leg.actuator, leg.chain
        if actuator is None or chain is None or not actuator.turns or actuator.joint in arms:
            continue
        T = matrix_product(matrix_inverse(T_body_base), matrix_inverse(chain.poses[0]))
        T_base_arm = matrix_product(T, chain.poses[1])
        candidates = [
            _arm(
                cylinder,
                matrix_applied(T_base_arm, _ends(cylinder, bodies)),
                actuator,
                leg.name,
                within,
            )
            for cylinder in shown
            if bodies.body_of[cylinder.link] == chain.bodies[0]
        ]
        seen = [arm for arm in candidates if _from_axis(arm.ends, actuator).max() > within]
        longest = max(seen, key=lambda arm: (arm.length, arm.radius), default=None)
        arms[actuator.joint] = replace(actuator, arm=longest)
    return tuple(
        replace(leg, actuator=arms[leg.actuator.joint])
        if leg.actuator is not None and leg.actuator.joint in arms
        else leg
        for leg in legs
    )


def _arm(cylinder: VisualCylinder, ends: Array, actuator: Actuator, leg: str, within: float) -> Arm:
    """Return a cylinder with ends (2, 3) as an arm, from the axis of its motor outwards."""
    near, far = _from_axis(ends, actuator)
    first, last = ends if near <= far + within else ends[::-1]
    line = Line(0.5 * (first + last), (last - first) / cylinder.length)
    return Arm(line, cylinder.length, cylinder.radius, cylinder.link, leg)


def _from_axis(points: Array, actuator: Actuator) -> Array:
    """Return the distances (n,) of points (n, 3) from the axis of a motor [m]."""
    return distance_to_line(points, actuator.axis, actuator.point)


def at_visible_heights(
    chains: Sequence[LegChain], shown: Sequence[VisualCylinder], bodies: Bodies
) -> list[LegChain]:
    """Return the legs of a planar mechanism at the height of their longest cylinder.

    A leg without a cylinder over its axis stays at the height of the origin of its slider or base
    joint.
    """
    within = coaxial_tolerance(chains)
    return [_raised(chain, shown, bodies, within) for chain in chains]


def visual_cylinders(urdf: Urdf) -> list[VisualCylinder]:
    """Return the visual cylinders of a tree."""
    if not urdf.has_cylinders:
        return []
    shown = [
        (link.get("name", ""), visual, cylinder)
        for link in parse_robot(urdf.path, urdf.content).findall("link")
        for visual in link.findall("visual")
        if (cylinder := visual.find("geometry/cylinder")) is not None
    ]
    return [
        VisualCylinder(name, T, float(shape.get("radius", "")), float(shape.get("length", "")))
        for (name, _, shape), T in zip(shown, origins_of([v for _, v, _ in shown]), strict=True)
    ]


def is_measured(legs: Sequence[Leg], cylinder: VisualCylinder, bodies: Bodies) -> bool:
    """Return whether a visual cylinder is a part whose outlines are measured: a leg or an arm."""
    within = coaxial_tolerance(legs)
    return any(
        bool(_along(leg, leg.chain, [cylinder], bodies, within)) for leg in legs if leg.chain
    ) or any(
        (arm.link, arm.radius, arm.length) == (cylinder.link, cylinder.radius, cylinder.length)
        for leg in legs
        if (arm := leg.arm) is not None
    )


def _along(
    leg: Leg, chain: LegChain, shown: Sequence[VisualCylinder], bodies: Bodies, within: float
) -> tuple[Cylinder, ...]:
    """Return the cylinders along one leg, *within* this distance [m] of its axis."""
    halves = halves_of_leg(leg, chain)
    cylinders = []
    for cylinder in shown:
        if bodies.body_of[cylinder.link] not in halves:
            continue
        side, origin, u = halves[bodies.body_of[cylinder.link]]
        ends = _ends(cylinder, bodies) - origin
        along = ends @ u
        if np.linalg.norm(ends - along[:, None] * u, axis=1).max() < within:
            start, end = sorted(float(x) for x in along)
            cylinders.append(Cylinder(cylinder.link, cylinder.radius, side, start, end))
    return tuple(cylinders)


def halves_of_leg(leg: Leg, chain: LegChain) -> dict[str, Half]:
    """Return the side (A or B) of each body on the axis of the leg, with u from A to B."""
    halves: dict[str, Half] = {}

    def turns(body: int, side: Literal["base", "platform"], point: Array, step: Step) -> bool:
        """Take a body, and return whether the joint behind it is a revolute about the leg."""
        at, u = chain.line_in(body, point)
        halves[chain.bodies[body - 1]] = side, at, leg.sign * u
        axis = step.line(step.far if side == "base" else step.near)[1]
        return step.connection.type == "revolute" and bool(
            np.linalg.norm(cross(axis, u)) < PARALLEL
        )

    for k in reversed(range(min(chain.n_lower, len(chain.bodies)))):
        if not turns(k + 1, "base", chain.A, chain.steps[k]):
            break
    if chain.slider is None:
        return halves
    if leg.is_fixed_to_platform:
        last, (B, u) = chain.steps[-1], chain.line_in(-1, chain.B)
        halves[last.connection.bodies[last.far]] = "platform", B, leg.sign * u
    for k in range(chain.n_upper, len(chain.steps)):
        if not turns(k, "platform", chain.B, chain.steps[k]):
            break
    return halves


def _raised(
    chain: LegChain, shown: Sequence[VisualCylinder], bodies: Bodies, within: float
) -> LegChain:
    """Return one leg with both centres at the height of its cylinder along the joint axes."""
    if chain.platform.type is not JointType.REVOLUTE or len(chain.steps) != 2 + (
        chain.slider is not None
    ):
        return chain
    normal = chain.base.axes[-1].along
    heights = []
    for k, centre in ((len(chain.bodies), chain.B), (1, chain.A)):
        for cylinder in shown:
            if bodies.body_of[cylinder.link] == chain.bodies[k - 1]:
                offset = matrix_applied(chain.poses[k], _ends(cylinder, bodies)) - centre
                height = float((offset @ normal).mean())
                beside = offset - (offset @ chain.u)[:, None] * chain.u - height * normal
                if np.linalg.norm(beside, axis=1).max() < within:
                    heights.append((cylinder.length, height))
    if not heights:
        return chain
    shift = max(heights)[1] * normal
    return replace(chain, A=chain.A + shift, B=chain.B + shift)


def _ends(cylinder: VisualCylinder, bodies: Bodies) -> Array:
    """Return both ends of the axis of a cylinder in its body, (2, 3) [m]."""
    T = matrix_product(bodies.T_body_link[cylinder.link], cylinder.T_link_cylinder)
    half = np.array([0.0, 0.0, 0.5 * cylinder.length])
    return matrix_applied(T, np.stack([-half, half]))
