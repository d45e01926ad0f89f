"""The cylinders that a camera sees of each leg, from the URDF's visuals."""

import io
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np
from lxml import etree
from scipy.spatial.transform import RigidTransform

from legcal.geometry.frames import product
from legcal.geometry.types import Array
from legcal.mechanism.axes import Step
from legcal.mechanism.bodies import Bodies
from legcal.mechanism.leg import Cylinder, Leg
from legcal.mechanism.leg_chain import LegChain
from legcal.mechanism.robot_xml import parse_robot
from legcal.mechanism.urdf import Urdf

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
