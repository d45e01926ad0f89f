"""Visible cylinders of a file: along legs and on arms; the heights of planar legs.

The kinematics of planar machines do not determine heights, and joint origins may be anywhere along
their axes. A camera sees the legs where their cylinders are.

CAD exports draw legs and arms as meshes only. The mesh of a rod is cut across the axis of its leg,
and that of an arm across the line from the axis of its motor to A. Neighbouring sections that are
circles of one radius are a cylinder: it is written into the model as a ``<visual>``. Ends, collars,
knurls and flats are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from lxml import etree
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import RigidTransform

from legcal.geometry.lines import cross, distance_to_line
from legcal.geometry.motions import matrix_applied, matrix_inverse, matrix_of, matrix_product
from legcal.geometry.rotations import rotation_between
from legcal.geometry.types import Array, IntArray
from legcal.machine.actuator import Actuator, Arm, Line
from legcal.machine.bodies import Bodies
from legcal.machine.classification import joint_tolerance
from legcal.machine.leg import Cylinder, JointType, Leg, LegChain, Step
from legcal.machine.meshes import mesh_file, mesh_of_file
from legcal.machine.spanning_tree import origin_xml, visual_xml
from legcal.machine.urdf import Urdf, origins_of

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


ROUND = 0.02  # largest deviation of a section from a circle, and of radii, relative to the radius
SECTIONS = 200  # across a mesh
_SAMPLED = 10  # every so many are cut first: most meshes are round nowhere
_MIN_CORNERS = 11  # of a section: fewer are a prism, as of a hexagonal spacer
_MIN_LENGTH = 2.0  # of a cylinder, in its radii


class Axis(NamedTuple):
    """A line in a body along which a cylinder is looked for, between two places on it [m]."""

    leg: str
    origin: Array  # (3,)
    along: Array  # (3,)
    start: float
    end: float


def with_mesh_cylinders(
    urdf: Urdf, bodies: Bodies, legs: Sequence[Leg], base: str, radius: float | None = None
) -> tuple[Urdf, list[str]]:
    """Return the tree with a cylinder for each leg and arm that is drawn as a mesh, and notes.

    With a *radius* [m] each leg without a cylinder of its own gets one of it.
    """
    axes, parts_of = _axes(legs, bodies, base), _RoundParts(urdf.path, coaxial_tolerance(legs))
    added: dict[str, list[str]] = {}
    parts: dict[tuple[str, str, float], list[str]] = {}  # legs by mesh, diameter, length
    for link in urdf.robot().findall("link"):
        name = link.get("name", "")
        for axis in axes.get(bodies.body_of[name], []):
            found = [
                (part, visual)
                for visual in link.findall("visual")
                if (part := parts_of.about(visual, bodies.T_body_link[name], axis))
            ]
            if not found:
                continue
            (round_radius, start, end), visual = max(found, key=lambda f: f[0][2] - f[0][1])
            shown = round_radius if radius is None else radius
            there = axis._replace(start=start, end=end)
            added.setdefault(name, []).append(_drawn(bodies, name, there, shown))
            mesh = visual.find("geometry/mesh").get("filename", "")  # type: ignore[union-attr]
            key = Path(mesh).name, f"{2e3 * shown:.4g}", round(1e3 * (end - start), 1)
            parts.setdefault(key, []).append(axis.leg)
    if radius is not None:
        seen = {name for names in parts.values() for name in names}
        for leg in legs:
            if not leg.cylinders and leg.name not in seen:
                for link_name, axis in _stated(leg, axes, bodies):
                    added.setdefault(link_name, []).append(_drawn(bodies, link_name, axis, radius))
    if not added:
        return urdf, []
    robot = urdf.robot()
    for link in robot.findall("link"):
        for text in added.get(link.get("name", ""), []):
            link.append(etree.fromstring(text))
    return urdf.edited(robot), [
        f"the mesh {mesh} of {', '.join(legs)} is round over {length:g} mm: this part was taken as "
        f"the visible cylinder, with a diameter of {diameter} mm; give --leg-radius if it has "
        "another."
        for (mesh, diameter, length), legs in parts.items()
    ]


def _axes(legs: Sequence[Leg], bodies: Bodies, base: str) -> dict[str, list[Axis]]:
    """Return the axes in each body along which a leg or an arm without a cylinder is drawn."""
    axes: dict[str, list[Axis]] = {}
    arms = set[str]()
    for leg in legs:
        chain = leg.urdf_chain
        halves = halves_of_leg(leg, chain)
        drawn = {bodies.body_of[c.link] for c in leg.cylinders}
        for body, (side, origin, along) in halves.items():
            if body in drawn:
                continue
            start, end = (0.0, np.inf) if side == "base" else (-np.inf, 0.0)
            if chain.slider is None:
                start, end = 0.0, leg.q0
            axes.setdefault(body, []).append(Axis(leg.name, origin, along, start, end))
        actuator = leg.actuator
        if actuator is None or not actuator.turns or actuator.joint in arms or actuator.arm:
            continue
        arms.add(actuator.joint)
        T = matrix_inverse(chain.poses[1])  # from the base body to that of the arm, at zero
        foot = actuator.point + ((leg.A - actuator.point) @ actuator.axis) * actuator.axis
        near, far = matrix_applied(
            matrix_product(T, bodies.T_body_link[base]), np.stack([foot, leg.A])
        )
        length = float(np.linalg.norm(far - near))
        axis = Axis(f"the arm of {leg.name}", near, (far - near) / length, 0.0, length)
        axes.setdefault(chain.bodies[0], []).append(axis)
    return axes


def _stated(leg: Leg, axes: dict[str, list[Axis]], bodies: Bodies) -> list[tuple[str, Axis]]:
    """Return the links and the places of cylinders with a stated radius, inside each part."""
    placed, reach = [], abs(leg.q0)
    if leg.has_value and leg.actuator is None:
        reach = min(abs(leg.length_at(x)) for x in leg.travel)
    for body, lines in axes.items():
        for axis in lines:
            if axis.leg != leg.name:
                continue
            part = (0.1 * reach, 0.9 * reach)
            if leg.chain is not None and leg.chain.slider is not None:
                part = (
                    (0.1 * reach, 0.5 * reach) if axis.end > 0.0 else (-0.5 * reach, -0.1 * reach)
                )
            link = next(link for link, other in bodies.body_of.items() if other == body)
            placed.append((link, axis._replace(start=part[0], end=part[1])))
    return placed


def _drawn(bodies: Bodies, link: str, axis: Axis, radius: float) -> str:
    """Return the ``<visual>`` of a cylinder of a radius [m] on an axis, in its link."""
    middle = axis.origin + 0.5 * (axis.start + axis.end) * axis.along
    turn = rotation_between(np.array([0.0, 0.0, 1.0]), axis.along).as_matrix()
    T = matrix_product(matrix_inverse(bodies.T_body_link[link]), matrix_of(turn, middle))
    at = origin_xml(RigidTransform.from_matrix(T))
    return visual_xml(at, float(radius), float(axis.end - axis.start))


@dataclass(frozen=True, eq=False)
class _RoundParts:
    """The cylinders of mesh files; a mesh that occurs several times is cut once.

    Axes that are the same in the frame of the file, up to *within* [m], have the same cylinder.
    """

    urdf_path: Path
    within: float
    # Both ends of an axis, the position of the first on it, and the cylinder, by mesh.
    known: dict[int, list[tuple[Array, float, tuple[float, float, float] | None]]] = field(
        default_factory=dict
    )

    def about(
        self, visual: etree._Element, T_body_link: Array, axis: Axis
    ) -> tuple[float, float, float] | None:
        """Return radius, start and end [m] of the longest cylinder about an axis, or None."""
        mesh = visual.find("geometry/mesh")
        if mesh is None or mesh_file(self.urdf_path, mesh.get("filename", "")) is None:
            return None
        try:
            corners, triangles = mesh_of_file(self.urdf_path, visual)
        except ValueError:  # pictures state the reason
            return None
        T = matrix_inverse(matrix_product(T_body_link, origins_of([visual])[0]))
        origin, along = matrix_applied(T, axis.origin), T[:3, :3] @ axis.along
        turn = rotation_between(along, np.array([0.0, 0.0, 1.0])).as_matrix()
        seen = (corners - origin) @ turn.T
        low = max(axis.start, float(seen[:, 2].min()))
        high = min(axis.end, float(seen[:, 2].max()))
        ends = origin + np.array([[low], [high]]) * along
        fits = self.known.setdefault(id(corners), [])
        for there, start, part in fits:
            if np.abs(ends - there).max() <= self.within:
                shift = low - start
                return None if part is None else (part[0], part[1] + shift, part[2] + shift)
        fits.append((ends, low, cylinder_about_z(seen, triangles, low, high)))
        return fits[-1][2]


def cylinder_about_z(
    corners: Array, triangles: IntArray, start: float = -np.inf, end: float = np.inf
) -> tuple[float, float, float] | None:
    """Return radius, lower and upper end [m] of the longest cylinder about z of a mesh, or None."""
    low, high = max(start, corners[:, 2].min()), min(end, corners[:, 2].max())
    if not low < high:
        return None
    step = (high - low) / SECTIONS
    heights = low + step * (np.arange(SECTIONS) + 0.5)
    shapes = corners[triangles]
    bottom, top = shapes[:, :, 2].min(axis=1), shapes[:, :, 2].max(axis=1)

    def radii_at(heights: Array) -> Array:
        return np.array([_radius_of_section(shapes[(bottom < z) & (top > z)], z) for z in heights])

    if not np.any(np.isfinite(radii_at(heights[::_SAMPLED]))):
        return None
    radii = radii_at(heights)
    runs, first = list[tuple[int, int]](), 0
    for k in range(1, SECTIONS + 1):
        reference = np.median(radii[first:k])
        if k == SECTIONS or not abs(radii[k] - reference) <= ROUND * reference:
            runs.append((first, k))
            first = k
    runs = [run for run in runs if np.isfinite(radii[run[0]])]
    if not runs:
        return None
    first, last = max(runs, key=lambda run: run[1] - run[0])
    radius = float(np.median(radii[first:last]))
    if (last - first) * step < _MIN_LENGTH * radius:
        return None
    return radius, float(heights[first]), float(heights[last - 1])


def _radius_of_section(corners: Array, z: float) -> float:
    """Return the radius of the outer contour of triangles (n, 3, 3) that cross a height.

    It is NaN if the contour is not round. The corners of a round one lie on the circle about the
    z axis, and the facets between them are chords.
    """
    edges = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2)
    edges = edges.reshape(-1, 2, 3)
    from_z, to_z = edges[:, 0, 2] - z, edges[:, 1, 2] - z
    cut = from_z * to_z < 0.0
    share = (from_z[cut] / (from_z[cut] - to_z[cut]))[:, None]
    points = edges[cut, 0, :2] + share * (edges[cut, 1, :2] - edges[cut, 0, :2])
    try:
        contour = points[ConvexHull(points).vertices]
    except (QhullError, ValueError):
        return np.nan
    distances = np.linalg.norm(contour, axis=1)
    radius = float(distances.max())
    # Points on the facets between corners do not count.
    contour = contour[distances > (1.0 - ROUND) * radius]
    turns = np.sort(np.arctan2(contour[:, 1], contour[:, 0]))
    gaps = np.diff(np.append(turns, turns[0] + 2.0 * np.pi))
    return radius if gaps.max() <= 2.0 * np.pi / _MIN_CORNERS else np.nan
