"""Occluders of a model: solids that hide legs without being measured.

Boxes, spheres, meshes and cylinders of housings, motors, carriages, brackets, towers: each is a
convex solid, or a mesh, on a carrier. The joints A and B of the legs determine the poses of
carriers; the solids of a leg turn about it with the joint at one of its ends. If a leg can turn
about itself, the swept volume replaces its solids; meshes then only hide the sections of their leg
that they enclose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from legcal.geometry.lines import cross
from legcal.geometry.motions import matrix_applied, matrix_inverse, matrix_product
from legcal.geometry.rotations import nearest_rotation
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.bodies import Bodies
from legcal.machine.cylinders import Half, VisualCylinder, halves_of_leg, is_measured
from legcal.machine.leg import Cover, Cylinder, JointType, Leg, LegChain
from legcal.machine.meshes import mesh_file, ray_caster, read_mesh
from legcal.machine.urdf import Urdf, number_list, origins_of

SIDES = 24  # sides of the prism around a round solid
THICKER = 1.2  # least radius of an enclosing solid, relative to the enclosed cylinder
SLICES, DIRECTIONS = 200, 12  # samples of an enclosing mesh along and around a leg
GRAZING = 1e-5  # sine of the angle of a ray and a triangle below which the triangle hides nothing
ALONG = 1e-6  # sine of the angle to a leg below which a revolute only spins the leg
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
        return planes_around(self.corners)

    @property
    def leg(self) -> int:
        """The leg that carries it, or -1."""
        return self.carrier.leg if isinstance(self.carrier, LegHalf) else -1

    @property
    def turns(self) -> bool:
        """Whether it is the swept volume of a solid that can be anywhere around its leg."""
        return isinstance(self.carrier, LegHalf) and self.carrier.roll is None


def planes_around(corners: Array) -> Array:
    """Return planes (k, 4) of the faces of the convex hull of points (m, 3), each once."""
    planes = ConvexHull(corners).equations
    return np.unique(np.round(planes, 12), axis=0)


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
            hidden |= first_hits(self.occluders[i], -t @ R, there) < last
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


def first_hits(mesh: Occluder, origin: Array, points: Array) -> Array:
    """Return the first hits of a mesh by rays from an origin (3,) or (n, 3) to points (n, 3), (n,).

    They are fractions of the distance, infinite without a hit. All points are in the carrier frame.
    """
    way = points - origin
    start = np.broadcast_to(origin, way.shape)
    length = np.linalg.norm(way, axis=1)
    ray = way / length[:, None]
    hits = np.full(len(points), np.inf)
    if mesh.triangles is None:
        return hits
    triangle, index = _caster(mesh).intersects_id(start, ray, multiple_hits=False)
    corner = mesh.corners[mesh.triangles[triangle]]
    normal = cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    towards = np.sum(normal * ray[index], axis=1)
    is_hit = np.abs(towards) > GRAZING * np.linalg.norm(normal, axis=1)
    index, reached = index[is_hit], np.sum(normal * (corner[:, 0] - start[index]), axis=1)[is_hit]
    hits[index] = reached / towards[is_hit] / length[index]
    return hits


@lru_cache(maxsize=256)
def _caster(mesh: Occluder) -> Any:
    return ray_caster(mesh.corners, mesh.triangles)


def visual_solids(urdf: Urdf) -> list[VisualSolid]:
    """Return the readable boxes, spheres, cylinders and meshes of a tree.

    The meshes of a link are one: a CAD export draws each of its screws.
    """
    shown = [
        (link.get("name", ""), visual, shape)
        for link in urdf.robot().findall("link")
        for visual in link.findall("visual")
        for shape in visual.findall("geometry/*")
    ]
    solids, meshes = list[VisualSolid](), dict[str, list[tuple[Array, IntArray]]]()
    for (link, visual, shape), T in zip(shown, origins_of([v for _, v, _ in shown]), strict=True):
        if shape.tag == "mesh" and mesh_file(urdf.path, shape.get("filename", "")) is not None:
            with suppress(ValueError):  # it hides nothing; pictures state the reason
                mesh = read_mesh(urdf.path, visual)
                meshes.setdefault(link, []).append(mesh)
        corners = _corners(str(shape.tag), {str(k): str(v) for k, v in shape.attrib.items()})
        if corners is not None:
            cylinder = None
            if shape.tag == "cylinder":
                sizes = float(shape.get("radius", "")), float(shape.get("length", ""))
                cylinder = VisualCylinder(link, T, *sizes)
            solids.append(VisualSolid(link, matrix_applied(T, corners), None, cylinder))
    for link, parts in meshes.items():
        first = np.cumsum([0, *(len(corners) for corners, _ in parts)])
        triangles = [k + shift for (_, k), shift in zip(parts, first, strict=False)]
        corners = np.concatenate([corners for corners, _ in parts])
        solids.append(VisualSolid(link, corners, np.concatenate(triangles)))
    return solids


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
    occluders = []
    for solid in shown:
        body = bodies.body_of[solid.link]
        if body not in places:
            continue
        if solid.cylinder is not None and is_measured(legs, solid.cylinder, bodies):
            continue
        carrier, T = places[body]
        corners = matrix_applied(matrix_product(T, bodies.T_body_link[solid.link]), solid.corners)
        occluder = Occluder(solid.link, carrier, corners, solid.triangles)
        if occluder.turns and solid.triangles is None:
            radius = float(np.linalg.norm(corners[:, :2], axis=1).max())
            low, high = corners[:, 2].min(), corners[:, 2].max()
            occluder = replace(occluder, corners=prism(radius, (float(low), float(high))))
        if solid.triangles is None:
            try:
                occluder.planes  # noqa: B018
            except QhullError:  # flat
                continue
        elif np.linalg.svd(corners - corners.mean(axis=0), compute_uv=False)[-1] <= EMPTY:
            continue
        occluders.append(occluder)
    return tuple(occluders)


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
    if step.connection.type != "revolute":
        return step.connection.type == "sphere"
    axis = chain.poses[i][:3, :3] @ step.line(step.near)[1]
    return bool(np.linalg.norm(cross(axis, chain.u)) < ALONG)


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
    hits = first_hits(mesh, start, np.repeat(axis, DIRECTIONS, axis=0))
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
