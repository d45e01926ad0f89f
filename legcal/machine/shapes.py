"""Visible shapes of a file: cylinders along legs and on arms, and occluders, which only hide.

The kinematics of planar machines do not determine heights, and joint origins may be anywhere along
their axes. A camera sees the legs where their cylinders are.

CAD exports draw legs and arms as meshes only. The mesh of a rod is cut across the axis of its leg,
and that of an arm across the line from the axis of its motor to A. Neighbouring sections that are
circles of one radius are a cylinder: it is written into the model as a ``<visual>``. Ends, collars,
knurls and flats are left out. Where neighbouring sections of a leg's mesh are one other shape, this
part is a body, as a box would be.

All other solids are occluders: boxes, spheres, meshes and cylinders of housings, motors, carriages,
brackets, towers. Each is a convex solid, or a mesh, on a carrier. The joints A and B of the legs
determine the poses of carriers; the solids of a leg turn about it with the joint at one of its
ends. If a leg can turn about itself, the swept volume replaces its solids; meshes then only hide
the sections of their leg that they enclose.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from lxml import etree
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import RigidTransform

from legcal.geometry.lines import cross, distance_to_line
from legcal.geometry.motions import (
    matrix_applied,
    matrix_inverse,
    matrix_of,
    matrix_product,
    nearest_rotation,
    rotation_between,
)
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.actuator import Actuator, Arm, Line
from legcal.machine.chain import Bodies, Connection
from legcal.machine.classification import joint_tolerance
from legcal.machine.leg import Cover, Cylinder, JointType, Leg, LegChain
from legcal.machine.meshes import first_hits, mesh_file, mesh_of_file, ray_caster, read_mesh
from legcal.machine.spanning_tree import origin_xml, parts_of, visual_xml
from legcal.machine.urdf import Urdf, number_list, origins_of

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
        axis = actuator.axis, actuator.point
        seen = [arm for arm in candidates if distance_to_line(arm.ends, *axis).max() > within]
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
    near, far = distance_to_line(ends, actuator.axis, actuator.point)
    first, last = ends if near <= far + within else ends[::-1]
    line = Line(0.5 * (first + last), (last - first) / cylinder.length)
    return Arm(line, cylinder.length, cylinder.radius, cylinder.link, leg)


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

    def turns(body: int, side: Literal["base", "platform"], point: Array, step: Connection) -> bool:
        """Take a body, and return whether the joint behind it is a revolute about the leg."""
        at, u = chain.line_in(body, point)
        halves[chain.bodies[body - 1]] = side, at, leg.sign * u
        axis = step.line(int(side == "base"))[1]
        return step.type == "revolute" and bool(np.linalg.norm(cross(axis, u)) < PARALLEL)

    for k in reversed(range(min(chain.n_lower, len(chain.bodies)))):
        if not turns(k + 1, "base", chain.A, chain.steps[k]):
            break
    if chain.slider is None:
        return halves
    if leg.is_fixed_to_platform:
        last, (B, u) = chain.steps[-1], chain.line_in(-1, chain.B)
        halves[last.bodies[1]] = "platform", B, leg.sign * u
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
_SAME_AXIS = 10  # decimals of axes that are one [m]
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
    axes = _axes(legs, bodies, base)
    cut: dict[Hashable, tuple[float, float, float] | None] = {}  # legs that are alike share a mesh
    added: dict[str, list[str]] = {}
    parts: dict[tuple[str, str, float], list[str]] = {}  # legs by mesh, diameter, length
    for link in urdf.robot().findall("link"):
        name = link.get("name", "")
        for axis in axes.get(bodies.body_of[name], []):
            found = [
                (part, visual)
                for visual in link.findall("visual")
                if (part := _round_part(urdf.path, visual, bodies.T_body_link[name], axis, cut))
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
    at = origin_xml(*parts_of(RigidTransform.from_matrix(T)))
    return visual_xml(at, float(radius), float(axis.end - axis.start))


def _round_part(
    urdf_path: Path,
    visual: etree._Element,
    T_body_link: Array,
    axis: Axis,
    cut: dict[Hashable, tuple[float, float, float] | None],
) -> tuple[float, float, float] | None:
    """Return radius, start and end [m] of the longest cylinder of a mesh about an axis, or None.

    *cut* are those by mesh and axis in its file: a mesh is cut once about one axis.
    """
    mesh = visual.find("geometry/mesh")
    if mesh is None or mesh_file(urdf_path, mesh.get("filename", "")) is None:
        return None
    try:
        corners, triangles = mesh_of_file(urdf_path, visual)
    except ValueError:  # pictures state the reason
        return None
    T = matrix_inverse(matrix_product(T_body_link, origins_of([visual])[0]))
    origin, along = matrix_applied(T, axis.origin), T[:3, :3] @ axis.along
    line = np.round([*origin, *along, axis.start, axis.end], _SAME_AXIS)
    key = *sorted(mesh.attrib.items()), line.tobytes()
    if key not in cut:
        turn = rotation_between(along, np.array([0.0, 0.0, 1.0])).as_matrix()
        seen = (corners - origin) @ turn.T
        cut[key] = cylinder_about_z(seen, triangles, axis.start, axis.end)
    return cut[key]


def cylinder_about_z(
    corners: Array, triangles: IntArray, start: float = -np.inf, end: float = np.inf
) -> tuple[float, float, float] | None:
    """Return radius, lower and upper end [m] of the longest cylinder about z of a mesh, or None."""
    part = _constant_part(corners, triangles, start, end, _radius_of_contour)
    return None if part is None else (float(part[0][0]), part[1], part[2])


def prismatic_part(corners: Array, triangles: IntArray) -> Array | None:
    """Return the corners (n, 3) of the longest prism along z of a mesh that is not round, or None.

    Its section is the convex hull of those of the mesh.
    """
    part = _constant_part(corners, triangles, -np.inf, np.inf, _reach_of_contour)
    if part is None:
        return None
    _, low, high = part
    contour = _contour(corners[triangles], 0.5 * (low + high))
    if np.isfinite(_radius_of_contour(contour)).all():
        return None
    return np.concatenate(
        [np.column_stack([contour, np.full(len(contour), z)]) for z in (low, high)]
    )


def _constant_part(
    corners: Array,
    triangles: IntArray,
    start: float,
    end: float,
    size_of: Callable[[Array], Array],  # (m, 2) contour -> (k,) [m], NaN for other shapes
) -> tuple[Array, float, float] | None:
    """Return sizes (k,), lower and upper end [m] of the longest part of one section along z."""
    low, high = max(start, corners[:, 2].min()), min(end, corners[:, 2].max())
    if not low < high:
        return None
    step = (high - low) / SECTIONS
    heights = low + step * (np.arange(SECTIONS) + 0.5)
    shapes = corners[triangles]
    bottom, top = shapes[:, :, 2].min(axis=1), shapes[:, :, 2].max(axis=1)

    def sizes_at(heights: Array) -> Array:
        return np.array(
            [size_of(_contour(shapes[(bottom < z) & (top > z)], z)) for z in heights.tolist()]
        )

    if not np.any(np.isfinite(sizes_at(heights[::_SAMPLED]))):
        return None
    sizes = sizes_at(heights)
    runs, first = list[tuple[int, int]](), 0
    for k in range(1, SECTIONS + 1):
        reference = np.median(sizes[first:k], axis=0)
        if k == SECTIONS or not np.abs(sizes[k] - reference).max() <= ROUND * reference.max():
            runs.append((first, k))
            first = k
    runs = [run for run in runs if np.isfinite(sizes[run[0]]).all()]
    if not runs:
        return None
    first, last = max(runs, key=lambda run: run[1] - run[0])
    size = np.median(sizes[first:last], axis=0)
    if (last - first) * step < _MIN_LENGTH * size.max():
        return None
    return size, float(heights[first]), float(heights[last - 1])


def _contour(corners: Array, z: float) -> Array:
    """Return the convex contour (m, 2) of triangles (n, 3, 3) at a height, empty for none."""
    edges = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2)
    edges = edges.reshape(-1, 2, 3)
    from_z, to_z = edges[:, 0, 2] - z, edges[:, 1, 2] - z
    cut = from_z * to_z < 0.0
    share = (from_z[cut] / (from_z[cut] - to_z[cut]))[:, None]
    points = edges[cut, 0, :2] + share * (edges[cut, 1, :2] - edges[cut, 0, :2])
    try:
        return np.asarray(points[ConvexHull(points).vertices])
    except (QhullError, ValueError):
        return np.zeros((0, 2))


def _reach_of_contour(contour: Array) -> Array:
    """Return how far a contour (m, 2) reaches from the z axis in directions all around, (k,)."""
    if not len(contour):
        return np.full(SIDES, np.nan)
    turn = 2.0 * np.pi * np.arange(SIDES) / SIDES
    return np.asarray((contour @ np.stack([np.cos(turn), np.sin(turn)])).max(axis=0))


def _radius_of_contour(contour: Array) -> Array:
    """Return the radius (1,) of a contour (m, 2) about the z axis, NaN if it is not round.

    The corners of a round one lie on the circle, and the facets between them are chords.
    """
    if not len(contour):
        return np.full(1, np.nan)
    distances = np.linalg.norm(contour, axis=1)
    radius = float(distances.max())
    # Points on the facets between corners do not count.
    contour = contour[distances > (1.0 - ROUND) * radius]
    turns = np.sort(np.arctan2(contour[:, 1], contour[:, 0]))
    gaps = np.diff(np.append(turns, turns[0] + 2.0 * np.pi))
    return np.array([radius if gaps.max() <= 2.0 * np.pi / _MIN_CORNERS else np.nan])


SIDES = 24  # sides of the prism around a round solid
THICKER = 1.2  # least radius of an enclosing solid, relative to the enclosed cylinder
SLICES, DIRECTIONS = 200, 12  # samples of an enclosing mesh along and around a leg
ALONG = 1e-6  # sine of the angle to a leg below which a revolute only spins the leg
BODY_OFF, BODY_LENGTH = 0.4, 4.0  # of a body: distance of its middle from the leg, length [radii]
EMPTY = 1e-9  # size of a solid, or depth, that counts as none [m]

_HELD = 1e3  # weight of fixed directions of a carrier, relative to joints


def _none() -> Array:
    return np.zeros((0, 3))


class VisualSolid(NamedTuple):
    """A visual of the file, as the corners of a convex solid or as triangles."""

    link: str
    corners: Array  # (m, 3) in the link [m]
    triangles: IntArray | None = None  # (k, 3) indices of corners, for a mesh
    cylinder: VisualCylinder | None = None  # the visual, if it is a cylinder


@dataclass(frozen=True, eq=False)
class Carrier:
    """A rigid body placed by the joints of some legs: base, platform, carriage or arm."""

    side: Literal["base", "platform"] = "base"  # side of its joints: A or B
    legs: tuple[int, ...] = ()  # legs with joints on it; none for the base itself
    points: Array = field(default_factory=_none)  # (n, 3) these joints in its frame [m]
    fixed: Array = field(default_factory=_none)  # (m, 3) fixed points [m]
    # (k, 3) constant directions in its frame, and the same in the base link
    held: Array = field(default_factory=_none)
    towards: Array = field(default_factory=_none)

    def poses(self, A: Array, B: Array) -> tuple[Array, Array]:
        """Return R (k, 3, 3) and t (k, 3) [m] from its frame to the base link, by joints there."""
        n = len(A)
        if not self.legs:
            return np.broadcast_to(np.eye(3), (n, 3, 3)), np.zeros((n, 3))
        joints = (A if self.side == "base" else B)[:, list(self.legs)]
        there = np.concatenate([joints, np.broadcast_to(self.fixed, (n, *self.fixed.shape))], 1)
        here = np.concatenate([self.points, self.fixed])
        middle, at = here.mean(axis=0), there.mean(axis=1)
        spread = here - middle
        weight = _HELD * max(float(np.sum(spread**2)), 1e-6)
        moment = np.swapaxes(there - at[:, None], 1, 2) @ spread
        R = nearest_rotation(moment + weight * self.towards.T @ self.held)
        return R, at - R @ middle


class Roll(NamedTuple):
    """The rotation of a leg about itself, determined by a joint axis at one of its ends."""

    carrier: Carrier  # body of the axis
    axis: Array  # (3,)
    is_outer: bool  # outer axis of a universal joint, perpendicular to the axis in the leg


@dataclass(frozen=True, eq=False)
class LegHalf:
    """Half of a leg; its frame has z from A to B, and its origin at A or B."""

    leg: int
    side: Literal["base", "platform"]
    roll: Roll | None  # None if the leg can turn about itself

    def poses(self, A: Array, B: Array) -> tuple[Array, Array]:
        """Return R (k, 3, 3) and t (k, 3) [m] from its frame to the base link, by joints there."""
        AB = B[:, self.leg] - A[:, self.leg]
        u = AB / np.linalg.norm(AB, axis=1, keepdims=True)
        axis = np.eye(3)[np.argmin(np.abs(u), axis=1)]
        if self.roll is not None:
            axis = self.roll.carrier.poses(A, B)[0] @ self.roll.axis
        R = frame_along(u, axis, is_outer=self.roll is None or self.roll.is_outer)
        return R, (A if self.side == "base" else B)[:, self.leg]


def frame_along(u: Array, axis: Array, *, is_outer: bool) -> Array:
    """Return axes x, y, z as columns (..., 3, 3), z along u, x perpendicular to it.

    x is perpendicular to the axis if this is outer, else as near to the axis as possible.
    """
    x = cross(axis, u) if is_outer else axis - np.sum(axis * u, axis=-1, keepdims=True) * u
    x = x / np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-12)
    return np.stack([x, cross(u, x), u], axis=-1)


@dataclass(frozen=True, eq=False)
class Occluder:
    """A convex solid or a mesh that hides everything inside and behind it."""

    link: str
    carrier: Carrier | LegHalf
    corners: Array  # (m, 3) in the frame of its carrier [m]
    triangles: IntArray | None = None  # (k, 3) of the corners of a mesh

    @cached_property
    def planes(self) -> Array:
        """Planes (k, 4) of its faces: n x + d > 0 is outside."""
        planes = ConvexHull(self.corners).equations
        return np.unique(np.round(planes, 12), axis=0)

    @property
    def is_flat(self) -> bool:
        """Whether it has no volume."""
        middle = self.corners.mean(axis=0)
        return bool(np.linalg.svd(self.corners - middle, compute_uv=False)[-1] <= EMPTY)

    @property
    def leg(self) -> int:
        """The leg that carries it, or -1."""
        return self.carrier.leg if isinstance(self.carrier, LegHalf) else -1

    @property
    def turns(self) -> bool:
        """Whether it is the swept volume of a solid that can be anywhere around its leg."""
        return isinstance(self.carrier, LegHalf) and self.carrier.roll is None


@dataclass(frozen=True, eq=False)
class PlacedOccluders:
    """Occluders of a model with their poses in a frame."""

    occluders: tuple[Occluder, ...]
    R: Array  # (n, 3, 3)
    t: Array  # (n, 3) [m]

    @classmethod
    def none(cls) -> PlacedOccluders:
        """Return no occluders."""
        return cls((), np.zeros((0, 3, 3)), np.zeros((0, 3)))

    @classmethod
    def at(cls, occluders: Sequence[Occluder], A: Array, B: Array) -> list[PlacedOccluders]:
        """Return occluders placed in the base link, for each of joints (k, n_legs, 3) there."""
        if not occluders:
            return [cls.none() for _ in A]
        carriers = {id(o.carrier): o.carrier for o in occluders}
        poses = {key: carrier.poses(A, B) for key, carrier in carriers.items()}
        R, t = (np.stack([poses[id(o.carrier)][i] for o in occluders], axis=1) for i in (0, 1))
        return [cls(tuple(occluders), *here) for here in zip(R, t, strict=True)]

    def before(self, T_base_camera: Array) -> PlacedOccluders:
        """Return them in the frame of a camera at T_base_camera (4, 4)."""
        R = T_base_camera[:3, :3]
        return replace(self, R=R.T @ self.R, t=(self.t - T_base_camera[:3, 3]) @ R)

    def without_leg(self, leg: int) -> PlacedOccluders:
        """Return those that a leg does not carry."""
        kept = [i for i, occluder in enumerate(self.occluders) if occluder.leg != leg]
        return PlacedOccluders(tuple(self.occluders[i] for i in kept), self.R[kept], self.t[kept])

    def __len__(self) -> int:
        return len(self.occluders)

    def corners(self, i: int) -> Array:
        """Return the corners of an occluder (m, 3) [m]."""
        return np.asarray(self.occluders[i].corners @ self.R[i].T + self.t[i])

    def silhouette(self, i: int) -> Array:
        """Return the edges (k, 2, 2) around an occluder, seen from the origin along z, at depth 1.

        There are none for a mesh, nor for a solid partly behind the origin.
        """
        corners = self.corners(i)
        if self.occluders[i].triangles is not None or corners[:, 2].min() <= EMPTY:
            return np.zeros((0, 2, 2))
        xy = corners[:, :2] / corners[:, 2:]
        try:
            around = xy[ConvexHull(xy).vertices]
        except QhullError:  # a plate seen edge-on
            return np.zeros((0, 2, 2))
        return np.stack([around, np.roll(around, -1, axis=0)], axis=1)

    def hide(self, points: Array, leg_of_point: IntArray, margin: Array, before: Array) -> IntArray:
        """Return the occluder that hides each point (n, 3) from the origin, or -1.

        ``leg_of_point`` is the leg of each point, -1 for none, ``margin`` the reach of bodies of
        other legs beyond their surface at the depth of the point, and ``before`` the least distance
        by which a body that hides the point is nearer [m].
        """
        front = np.full(len(points), -1, dtype=np.intp)
        last = 1.0 - before / np.linalg.norm(points, axis=1)
        for i, occluder in enumerate(self.occluders):
            is_same_leg = (
                leg_of_point == occluder.leg
                if occluder.leg >= 0
                else np.zeros(len(leg_of_point), np.bool_)
            )
            if occluder.turns and (np.all(is_same_leg) or occluder.triangles is not None):
                continue
            reach = np.where(is_same_leg, 0.0, margin)
            behind = self._behind if occluder.triangles is None else self._behind_mesh
            hides = behind(i, points, reach, last)
            if occluder.turns:
                hides &= ~is_same_leg
            front[hides] = i
        return front

    def _behind_mesh(self, i: int, points: Array, reach: Array, last: Array) -> BoolArray:
        """Return the same as :meth:`_behind` for a mesh; ``reach`` is sampled on four sides."""
        R, t = self.R[i], self.t[i]
        sides = np.array([(0, 0, 0), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)])
        hidden = np.zeros(len(points), dtype=np.bool_)
        for side in sides if np.any(reach > 0.0) else sides[:1]:
            there = (points + reach[:, None] * side - t) @ R
            hidden |= hits_of_mesh(self.occluders[i], -t @ R, there) < last
        return hidden

    def _behind(self, i: int, points: Array, reach: Array, last: Array) -> BoolArray:
        """Return which points (n, 3) are inside or behind an occluder, seen from the origin.

        Only the first fraction ``last`` (n,) of the ray to each point counts.
        """
        planes = self.occluders[i].planes
        normal = planes[:, :3] @ self.R[i].T
        # Distance of the origin from the planes, (n, k).
        outside = planes[:, 3] - normal @ self.t[i] - reach[:, None]
        slope = points @ normal.T
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = -outside / slope
        enters = np.where(slope < 0.0, crossing, np.where(outside > 0.0, np.inf, -np.inf))
        enters[slope > 0.0] = -np.inf
        leaves = np.where(slope > 0.0, crossing, np.inf)
        first = np.maximum(enters.max(axis=1), 0.0)
        return np.asarray((first < leaves.min(axis=1)) & (first < last))


def hits_of_mesh(mesh: Occluder, origin: Array, points: Array) -> Array:
    """Return the first hits of a mesh by rays from an origin (3,) or (n, 3) to points (n, 3), (n,).

    They are fractions of the distance, infinite without a hit. All points are in the carrier frame.
    """
    if mesh.triangles is None:
        return np.full(len(points), np.inf)
    hits = first_hits(_caster(mesh), mesh.corners, mesh.triangles, origin, points)
    return np.asarray(hits / np.linalg.norm(points - origin, axis=1))


@lru_cache(maxsize=256)
def _caster(mesh: Occluder) -> Any:
    return ray_caster(mesh.corners, mesh.triangles)


def shapes_of(urdf: Urdf) -> list[VisualSolid]:
    """Return the readable boxes, spheres and cylinders of a tree."""
    solids = list[VisualSolid]()
    for link, _, shape, T in _shown(urdf):
        corners = _corners(str(shape.tag), {str(k): str(v) for k, v in shape.attrib.items()})
        if corners is not None:
            cylinder = None
            if shape.tag == "cylinder":
                sizes = float(shape.get("radius", "")), float(shape.get("length", ""))
                cylinder = VisualCylinder(link, T, *sizes)
            solids.append(VisualSolid(link, matrix_applied(T, corners), None, cylinder))
    return solids


def meshes_of(urdf: Urdf) -> list[VisualSolid]:
    """Return the readable meshes of a tree, those of a link as one: CAD draws its screws."""
    meshes: dict[str, list[tuple[Array, IntArray]]] = {}
    for link, visual, shape, _ in _shown(urdf):
        if shape.tag == "mesh" and mesh_file(urdf.path, shape.get("filename", "")) is not None:
            with suppress(ValueError):  # it hides nothing; pictures state the reason
                mesh = read_mesh(urdf.path, visual)
                meshes.setdefault(link, []).append(mesh)
    solids = list[VisualSolid]()
    for link, parts in meshes.items():
        first = np.cumsum([0, *(len(corners) for corners, _ in parts)])
        triangles = [k + shift for (_, k), shift in zip(parts, first, strict=False)]
        corners = np.concatenate([corners for corners, _ in parts])
        solids.append(VisualSolid(link, corners, np.concatenate(triangles)))
    return solids


def _shown(urdf: Urdf) -> list[tuple[str, etree._Element, etree._Element, Array]]:
    """Return the shapes of all visuals, with their link, visual and T_link_visual."""
    shown = [
        (link.get("name", ""), visual, shape)
        for link in urdf.robot().findall("link")
        for visual in link.findall("visual")
        for shape in visual.findall("geometry/*")
    ]
    origins = origins_of([visual for _, visual, _ in shown])
    return [(*one, T) for one, T in zip(shown, origins, strict=True)]


def _corners(tag: str, sizes: Mapping[str, str]) -> Array | None:
    """Return the corners (m, 3) of a shape about its origin [m], None if flat or not supported."""
    names = {"box": ("size", 3), "sphere": ("radius", 1), "cylinder": ("radius", 1)}
    if tag not in names:
        return None
    name, count = names[tag]
    numbers = number_list(sizes.get(name, ""), count)
    if numbers is None or min(numbers) <= EMPTY:
        return None
    if tag == "box":
        signs = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3), axis=-1).reshape(-1, 3)
        return np.asarray(signs * numbers)
    if tag == "sphere":
        height = np.cos(np.linspace(0.0, np.pi, SIDES // 2 + 1))
        rings = [prism(numbers[0] * np.sqrt(1.0 - z**2), (numbers[0] * z,) * 2) for z in height]
        return np.concatenate(rings)
    length = number_list(sizes.get("length", ""), 1)
    return None if length is None else prism(numbers[0], (-0.5 * length[0], 0.5 * length[0]))


def prism(radius: float, heights: tuple[float, float]) -> Array:
    """Return the corners (2 SIDES, 3) of the prism around a cylinder about z [m]."""
    turn = 2.0 * np.pi * np.arange(SIDES) / SIDES
    reach = radius / np.cos(np.pi / SIDES)
    circle = np.column_stack([reach * np.cos(turn), reach * np.sin(turn)])
    return np.concatenate([np.column_stack([circle, np.full(SIDES, z)]) for z in heights])


def occluders_of(
    legs: Sequence[Leg],
    shown: Sequence[VisualSolid],
    bodies: Bodies,
    ends: tuple[str, str],  # the links of base and platform
    normals: tuple[Array, Array] | None,  # normals of a plane of motion, in these links
) -> tuple[Occluder, ...]:
    """Return the occluders of a file: all visuals that are not measured and can be placed."""
    base, platform = ends
    places = _places(legs, bodies, base, platform, normals)
    occluders = list[Occluder]()
    for solid in shown:
        body = bodies.body_of[solid.link]
        if body not in places:
            continue
        if solid.cylinder is not None and is_measured(legs, solid.cylinder, bodies):
            continue
        carrier, T = places[body]
        corners = matrix_applied(matrix_product(T, bodies.T_body_link[solid.link]), solid.corners)
        parts = [whole := Occluder(solid.link, carrier, corners, solid.triangles)]
        if solid.triangles is not None and isinstance(carrier, LegHalf):
            prismatic = prismatic_part(corners, solid.triangles)
            if prismatic is not None and _surrounds(whole, prismatic):
                parts.append(Occluder(solid.link, carrier, prismatic))
        occluders += map(_swept, parts)
    return tuple(occluder for occluder in occluders if not occluder.is_flat)


def _surrounds(mesh: Occluder, prismatic: Array) -> bool:
    """Whether a mesh is all around the axis of its leg along a part: no fork, nor guide rods."""
    low, high = prismatic[:, 2].min(), prismatic[:, 2].max()
    closed = sum(max(0.0, min(b, high) - max(a, low)) for a, b in _enclosed(mesh, 0.0))
    return bool(closed > 0.5 * (high - low))


def _swept(occluder: Occluder) -> Occluder:
    """Return the volume that a solid sweeps if its leg can turn about itself, else the solid."""
    if not occluder.turns or occluder.triangles is not None:
        return occluder
    corners = occluder.corners
    radius = float(np.linalg.norm(corners[:, :2], axis=1).max())
    low, high = corners[:, 2].min(), corners[:, 2].max()
    return replace(occluder, corners=prism(radius, (float(low), float(high))))


def _places(
    legs: Sequence[Leg],
    bodies: Bodies,
    base: str,
    platform: str,
    normals: tuple[Array, Array] | None,
) -> dict[str, tuple[Carrier | LegHalf, Array]]:
    """Return the carrier of each body, and the pose (4, 4) of the body in the carrier frame."""
    T_base, T_platform = (matrix_inverse(bodies.T_body_link[link]) for link in (base, platform))
    free = [j for j, leg in enumerate(legs) if not leg.is_fixed_to_platform]
    # B of the other legs is arbitrary on their line.
    free = free if len(free) >= 3 else list(range(len(legs)))
    held = (_none(),) * 2 if normals is None else (normals[1][None], normals[0][None])
    on_base = Carrier()
    on_platform = Carrier(
        "platform", tuple(free), np.array([legs[j].B for j in free]), _none(), *held
    )
    places: dict[str, tuple[Carrier | LegHalf, Array]] = {
        bodies.body_of[base]: (on_base, T_base),
        bodies.body_of[platform]: (on_platform, T_platform),
    }
    moved: dict[str, Carrier] = {}
    for j, leg in enumerate(legs):
        chain = leg.urdf_chain
        carrier = on_base
        if leg.actuator is not None:
            actuator = leg.actuator
            if actuator.joint not in moved:
                on_it = [k for k, o in enumerate(legs) if o.actuator is not None
                         and o.actuator.joint == actuator.joint]  # fmt: skip
                kept = actuator.axis[None] if actuator.turns else np.eye(3)
                fixed = actuator.point[None] if actuator.turns else _none()
                joints = np.array([legs[k].A for k in on_it])
                moved[actuator.joint] = Carrier("base", tuple(on_it), joints, fixed, kept, kept)
            carrier = moved[actuator.joint]
            pose = matrix_product(T_base, chain.poses[1])
            places.setdefault(chain.bodies[0], (carrier, pose))
        for body, half in halves_of_leg(leg, chain).items():
            if body in places:
                continue
            k = chain.bodies.index(body) + 1
            roll, axis = _roll(chain, k, carrier, on_platform, (T_base, T_platform))
            places[body] = _on_leg(j, half, roll, chain.poses[k][:3, :3].T @ axis)
    return places


def _on_leg(leg: int, half: Half, roll: Roll | None, axis: Array) -> tuple[LegHalf, Array]:
    """Return half of a leg, and the pose (4, 4) in it of a body with an axis."""
    side, origin, u = half
    R = frame_along(u, axis, is_outer=roll is None or roll.is_outer)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R.T, -R.T @ origin
    return LegHalf(leg, side, roll), T


def _roll(
    chain: LegChain,
    k: int,  # index of the body in the chain
    on_base: Carrier,
    on_platform: Carrier,
    T_link_body: tuple[Array, Array],  # poses of the base and platform bodies in their links
) -> tuple[Roll | None, Array]:
    """Return the joint that keeps a body from turning about its leg, and its axis at zero.

    The axis is in the base body, with all joints of the leg at zero.
    """
    before = range(0 if chain.actuator is None else 1, k)
    T_platform = matrix_product(T_link_body[1], matrix_inverse(chain.poses[-1]))
    for pivot, steps, carrier, T in (
        (chain.base, before, on_base, T_link_body[0]),  # also on an actuator, at reading 0
        (chain.platform, range(k, len(chain.steps)), on_platform, T_platform),
    ):
        if pivot.type not in (JointType.REVOLUTE, JointType.UNIVERSAL) or pivot.outer is None:
            continue
        if any(_turns_leg(chain, i) for i in steps):
            continue
        is_outer = pivot.type.inner_is_across
        if is_outer and np.linalg.norm(cross(pivot.outer, chain.u)) < 1e-3:
            continue
        return Roll(carrier, T[:3, :3] @ pivot.outer, is_outer), pivot.outer
    return None, np.eye(3)[np.argmin(np.abs(chain.u))]


def _turns_leg(chain: LegChain, i: int) -> bool:
    """Return whether a joint of a leg is a revolute about it, or a sphere."""
    step = chain.steps[i]
    if step.type != "revolute":
        return step.type == "sphere"
    axis = chain.poses[i][:3, :3] @ step.line(0)[1]
    return bool(np.linalg.norm(cross(axis, chain.u)) < ALONG)


def bodies_of(occluders: Sequence[Occluder], n_legs: int) -> list[list[Cylinder]]:
    """Return the long bodies around the axis of each leg, as cylinders that look as thick.

    A convex solid is as wide as its circumference over pi, in the mean of all directions from
    which it is seen; a square one differs from that by up to 21 %.
    """
    bodies: list[list[Cylinder]] = [[] for _ in range(n_legs)]
    for occluder in occluders:
        half = occluder.carrier
        if not isinstance(half, LegHalf) or occluder.triangles is not None:
            continue
        across, along = occluder.corners[:, :2], occluder.corners[:, 2]
        start, end = float(along.min()), float(along.max())
        hull = across[ConvexHull(across).vertices]
        around = float(np.linalg.norm(hull - np.roll(hull, 1, axis=0), axis=1).sum())
        radius = around / (2.0 * np.pi)
        off = float(np.linalg.norm(hull.mean(axis=0)))
        if off <= BODY_OFF * radius and end - start >= BODY_LENGTH * radius:
            bodies[half.leg].append(Cylinder(occluder.link, radius, half.side, start, end))
    return bodies


def with_covers(legs: Sequence[Leg], occluders: Sequence[Occluder]) -> tuple[Leg, ...]:
    """Return legs with the sections of their cylinders that are inside other solids."""
    return tuple(
        replace(leg, cylinders=tuple(_covered(c, j, occluders) for c in leg.cylinders))
        for j, leg in enumerate(legs)
    )


def _covered(cylinder: Cylinder, leg: int, occluders: Sequence[Occluder]) -> Cylinder:
    """Return a cylinder with the sections of its axis inside solids of its leg."""
    covers = []
    for occluder in occluders:
        if not isinstance(occluder.carrier, LegHalf) or occluder.leg != leg:
            continue
        if occluder.triangles is not None:
            side, radius = occluder.carrier.side, THICKER * cylinder.radius
            covers += [Cover(side, *ends) for ends in _enclosed(occluder, radius)]
            continue
        reach = np.linalg.norm(occluder.corners[:, :2], axis=1).max()
        normal, outside = occluder.planes[:, 2], occluder.planes[:, 3]
        if reach < THICKER * cylinder.radius or np.any((np.abs(normal) < 1e-12) & (outside > 0.0)):
            continue
        ends = -outside / np.where(np.abs(normal) < 1e-12, np.nan, normal)
        low = float(np.max(ends[normal < -1e-12]))
        high = float(np.min(ends[normal > 1e-12]))
        if low < high:
            covers.append(Cover(occluder.carrier.side, low, high))
    return replace(cylinder, covers=tuple(covers)) if covers else cylinder


def _enclosed(mesh: Occluder, radius: float) -> list[tuple[float, float]]:
    """Return the sections along z surrounded by a mesh farther out than a radius [m]."""
    z = mesh.corners[:, 2]
    size = (float(z.max()) - float(z.min())) / SLICES
    if size <= EMPTY:
        return []
    height = z.min() + size * (np.arange(SLICES) + 0.5)
    far = 2.0 * float(np.linalg.norm(mesh.corners[:, :2], axis=1).max()) + radius
    turn = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    around = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(DIRECTIONS)])
    axis = np.column_stack([np.zeros((SLICES, 2)), height])
    start = (axis[:, None] + far * around).reshape(-1, 3)
    hits = hits_of_mesh(mesh, start, np.repeat(axis, DIRECTIONS, axis=0))
    is_thick = np.all((1.0 - hits.reshape(SLICES, DIRECTIONS)) * far > radius, axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_thick, [False]]).astype(np.int8)))
    at = z.min() + size * edges
    return [(float(low), float(high)) for low, high in zip(at[::2], at[1::2], strict=True)]


def reordered(occluders: Sequence[Occluder], order: Sequence[int]) -> tuple[Occluder, ...]:
    """Return occluders for another order of the legs."""
    place = {j: k for k, j in enumerate(order)}
    moved = dict[int, Carrier | LegHalf]()

    def other(carrier: Carrier) -> Carrier:
        return replace(carrier, legs=tuple(place[j] for j in carrier.legs))

    for carrier in (occluder.carrier for occluder in occluders):
        if isinstance(carrier, Carrier):
            moved[id(carrier)] = other(carrier)
            continue
        roll = carrier.roll
        roll = None if roll is None else roll._replace(carrier=other(roll.carrier))
        moved[id(carrier)] = replace(carrier, leg=place[carrier.leg], roll=roll)
    return tuple(replace(occluder, carrier=moved[id(occluder.carrier)]) for occluder in occluders)
