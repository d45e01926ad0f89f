"""At which height the legs of a planar mechanism lie: where their visible cylinders are.

In a plane the kinematics say nothing of heights, and joint origins may stand anywhere along their
axes. A camera sees the legs where their cylinders are.
"""

import io
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np
from lxml import etree
from scipy.spatial.transform import RigidTransform

from legcal.geometry import Array, product
from legcal.machine.bodies import Bodies
from legcal.machine.classification import JointGroup, LegChain, Step
from legcal.machine.leg import Cylinder, Leg
from legcal.machine.urdf import Urdf, parse_robot

PARALLEL = 1e-6
COAXIAL = 1e-4  # [m], at both ends of a cylinder

Half = tuple[Literal["base", "platform"], Array, Array]


class VisualCylinder(NamedTuple):
    """A visual cylinder of the file: its link, its pose there, radius and length [m]."""

    link: str
    T_link_cylinder: RigidTransform
    radius: float
    length: float


def with_cylinders(
    legs: Sequence[Leg],
    shown: Sequence[VisualCylinder],
    bodies: Bodies,
    chains: Sequence[LegChain],
) -> tuple[Leg, ...]:
    """Return the legs with the visual cylinders that are coaxial with them.

    A cylinder counts on every link that moves rigidly with the base or the platform half of
    the leg, or only turns about the leg's axis.

    Parameters
    ----------
    legs : sequence of Leg
        The legs, with their sign.
    shown : sequence of VisualCylinder
        The cylinders of the file.
    bodies : Bodies
        The rigid bodies.
    chains : sequence of LegChain
        The joints of the legs.
    """
    return tuple(
        replace(leg, cylinders=_of_leg(leg, chain, bodies, shown))
        for leg, chain in zip(legs, chains, strict=True)
    )


def ends_in_body(cylinder: VisualCylinder, bodies: Bodies) -> Array:
    """Return both ends of a cylinder's axis in the body that it is on, (2, 3) [m]."""
    T = product(bodies.T_body_link[cylinder.link], cylinder.T_link_cylinder)
    half = np.array([0.0, 0.0, 0.5 * cylinder.length])
    return np.asarray(T.apply(np.stack([-half, half])))


def visual_cylinders(urdf: Urdf) -> list[VisualCylinder]:
    """Return the visual cylinders of a tree."""
    if not urdf.has_cylinders:
        return []
    from yourdfpy import URDF  # half a second: only where there is something to read

    robot: Any = URDF.load(
        io.BytesIO(_cylinders_alone(urdf)), build_scene_graph=False, load_meshes=False
    ).robot
    found = []
    for link in robot.links:
        for visual in link.visuals:
            cylinder = visual.geometry.cylinder
            if cylinder is not None:
                T = np.eye(4) if visual.origin is None else np.asarray(visual.origin)
                pose = RigidTransform.from_matrix(T)
                size = float(cylinder.radius), float(cylinder.length)
                found.append(VisualCylinder(str(link.name), pose, *size))
    return found


def _cylinders_alone(urdf: Urdf) -> bytes:
    """Return the file with nothing but its cylinders: the rest may hold anything."""
    alone = etree.Element("robot", {"name": "cylinders"})
    for link in parse_robot(urdf.path, urdf.content).findall("link"):
        kept = etree.SubElement(alone, "link", {"name": link.get("name", "")})
        for visual in link.findall("visual"):
            cylinder = visual.find("geometry/cylinder")
            if cylinder is not None:
                shown = etree.SubElement(kept, "visual")
                origin = visual.find("origin")
                if origin is not None:
                    etree.SubElement(shown, "origin", _attributes(origin, "xyz", "rpy"))
                geometry = etree.SubElement(shown, "geometry")
                size = _attributes(cylinder, "radius", "length")
                etree.SubElement(geometry, "cylinder", size)
    return etree.tostring(alone)


def _attributes(element: etree._Element, *names: str) -> dict[str, str]:
    """Return those attributes that an element has."""
    return {name: value for name in names if (value := element.get(name)) is not None}


def _of_leg(
    leg: Leg,
    chain: LegChain,
    bodies: Bodies,
    shown: Sequence[VisualCylinder],
) -> tuple[Cylinder, ...]:
    """Return the cylinders of one leg, in the order of the file."""
    halves = _halves(leg, chain)
    found = []
    for cylinder in shown:
        if bodies.body_of[cylinder.link] not in halves:
            continue
        side, origin, u = halves[bodies.body_of[cylinder.link]]
        ends = ends_in_body(cylinder, bodies) - origin
        along = ends @ u
        if np.linalg.norm(ends - along[:, None] * u, axis=1).max() < COAXIAL:
            start, end = sorted(float(x) for x in along)
            found.append(Cylinder(cylinder.link, cylinder.radius, side, start, end))
    return tuple(found)


def _halves(leg: Leg, chain: LegChain) -> dict[str, Half]:
    """Return the bodies that hold the leg's axis: their side, A or B, and u from A to B."""
    halves: dict[str, Half] = {}
    A, u = chain.base.centre_far, leg.sign * chain.u_lower
    lower = list(zip(chain.steps, chain.bodies, strict=False))[: chain.n_lower]
    for step, body in reversed(lower):
        halves[body] = "base", A, u
        if not _turns_about(step, step.far, u):
            break
        A, u = _across(step, step.far, step.near, A, u)
    if chain.slider is None:
        return halves
    B, u = chain.platform.centre_near, leg.sign * chain.u_upper
    if leg.platform_joint == "":
        last = chain.steps[-1]
        on_platform = chain.platform.centre_far, leg.sign * chain.u_platform
        halves[last.connection.bodies[last.far]] = "platform", *on_platform
    for step, body in zip(
        chain.steps[chain.n_lower + 1 :], chain.bodies[chain.n_lower :], strict=True
    ):
        halves[body] = "platform", B, u
        if not _turns_about(step, step.near, u):
            break
        B, u = _across(step, step.near, step.far, B, u)
    return halves


def _turns_about(step: Step, side: int, u: Array) -> bool:
    """Say whether a joint is a revolute about the leg's axis, which passes through its centre."""
    parallel = np.linalg.norm(np.cross(step.line(side)[1], u)) < PARALLEL
    return step.connection.type == "revolute" and bool(parallel)


def _across(step: Step, here: int, there: int, point: Array, u: Array) -> tuple[Array, Array]:
    """Return a point and a direction of a revolute's axis in the body on its other side."""
    origin, axis = step.line(here)
    along = float((point - origin) @ axis)
    return step.point(there, along), np.sign(axis @ u) * step.line(there)[1]


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
