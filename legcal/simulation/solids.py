"""A machine as solids for ray casting: visuals of its URDF and parts added to them, in any pose."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from lxml import etree
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import ModelError
from legcal.geometry.lines import distance_to_line
from legcal.geometry.motions import matrix_product, motions_of, product
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.actuator import Actuator
from legcal.machine.configurations import Configurations
from legcal.machine.leg import Leg
from legcal.machine.meshes import first_hits, mesh_file, ray_caster, read_mesh
from legcal.machine.model import Machine, joint_values, vectors_A_to_B
from legcal.machine.rods import arms_at, first_rods
from legcal.machine.shapes import coaxial_tolerance
from legcal.machine.urdf import number_list, origins_of, parse_robot

_SIZES = {"cylinder": ("radius", "length"), "sphere": ("radius",), "box": ("size",)}

_BALL_SIZE, _POST_SIZE = 1.4, 1.1  # in radii of the leg
_POST_LENGTH, _PLATE_THICKNESS, _PLATE_RIM = 4.5, 1.8, 3.5  # in radii of the thickest leg
_DEFAULT_RADIUS = 0.02  # radius of a leg without a cylinder, in distances between its joints
_GAP = 1.5  # between the plates of a planar machine, in radii of the thickest leg
_FLAT = 0.2  # maximum cosine between legs and the normal of plates that are parallel to the legs

_SECTIONS = 48  # sides of a cylinder of triangles: 0.2 % of its radius too thin at most
_SUBDIVISIONS = 2  # of an icosahedron in place of a sphere
_FLAT_JOINTS = 1e-3  # maximum thickness of coplanar joint centres, in units of their extent


@dataclass(frozen=True)
class SolidCylinder:
    """A closed cylinder about the z axis, its middle at the origin."""

    radius: float  # [m]
    length: float  # [m]


@dataclass(frozen=True)
class Sphere:
    """A sphere about the origin."""

    radius: float  # [m]


@dataclass(frozen=True)
class Box:
    """A box along the axes, its middle at the origin."""

    size: tuple[float, float, float]  # whole lengths along x, y, z [m]


@dataclass(frozen=True, eq=False)
class Mesh:
    """A surface of triangles."""

    vertices: Array  # (n, 3) points [m]
    faces: IntArray  # (m, 3) the corners of each triangle


Shape = SolidCylinder | Sphere | Box | Mesh


def _shape_of(urdf_path: Path, visual: etree._Element) -> tuple[Shape, RigidTransform]:
    """Return the shape of a visual and T_link_shape; the vertices of a mesh are in the link.

    ValueError has the actual and the needed content.
    """
    element = visual.find("geometry")[0]  # type: ignore[index]
    tag, numbers = str(element.tag), list[float]()
    if tag == "mesh":
        name, scale = element.get("filename", ""), element.get("scale", "1 1 1")
        if mesh_file(urdf_path, name) is None:
            raise ValueError(
                f"found no mesh file '{name}', needed it beside the URDF; copy it, correct the "
                "name, or simulate with --level outlines, which draws no meshes"
            )
        factors = number_list(scale, 3)
        if factors is None or min(abs(factor) for factor in factors) == 0.0:
            raise ValueError(
                f'found <mesh scale="{scale}">, needed 3 numbers other than zero; correct it'
            )
        return Mesh(*read_mesh(urdf_path, visual)), RigidTransform.identity()
    if tag not in _SIZES:
        raise ValueError(
            f"found <{tag}>, needed a cylinder, sphere, box or mesh; write one of them"
        )
    for name in _SIZES[tag]:
        text, count = element.get(name, ""), 3 if name == "size" else 1
        sizes = number_list(text, count)
        if sizes is None or min(sizes) <= 0.0:
            needed = "a positive number" if count == 1 else f"{count} positive numbers"
            raise ValueError(f'found <{tag} {name}="{text}">, needed {needed}; write it [m]')
        numbers += sizes
    T = RigidTransform(origins_of([visual])[0], normalize=False, copy=False)
    if tag == "cylinder":
        return SolidCylinder(*numbers), T
    if tag == "sphere":
        return Sphere(*numbers), T
    x, y, z = numbers
    return Box((x, y, z)), T


def _rgb(material: etree._Element) -> tuple[float, float, float] | None:
    """Return the colour of a ``<material>``, 0 to 1, or None where it has none."""
    color = material.find("color")
    rgba = None if color is None else number_list(color.get("rgba", ""), 4)
    if rgba is None:
        return None
    r, g, b = (min(max(x, 0.0), 1.0) for x in rgba[:3])
    return r, g, b


class Sheet(Protocol):
    """A print on a face of a box."""

    @property
    def face(self) -> int:
        """The face."""

    def reflectance(self, x: Array, y: Array) -> Array:
        """Return factors (n,) of the albedo at points x, y of the z faces, in the box [m]."""


@dataclass(frozen=True)
class Material:
    """The reflectance of a surface; everything in linear light, not in grey levels."""

    albedo: float = 0.5  # share of light that is scattered evenly, 0 to 1
    # strength of the highlight; 0 for a dull surface, about 1 for polished steel
    specular: float = 0.1
    shininess: float = 20.0  # exponent of the highlight: the larger, the narrower
    # darkening of the surface seen edge-on, 0 to 1: the factor of scattered light is
    # 1 - limb (1 - cos), with the angle between the normal and the line of sight. On a cylinder the
    # cosine grows like the square root of the depth inside the outline
    limb: float = 0.3
    texture: float = 0.0  # standard deviation of a mottled pattern on it, as a part of the albedo
    # factors of red, green, blue; used in pictures in colour only
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    sheet: Sheet | None = None  # print on one of its faces, if it is a box


TUBE = Material(albedo=0.70, specular=0.25, shininess=40.0, limb=0.35)
ROD = Material(albedo=0.35, specular=0.80, shininess=80.0, limb=0.35)
PART = Material(albedo=0.30, specular=0.05, shininess=15.0, limb=0.20)


@dataclass(frozen=True, eq=False)
class Solid:
    """A solid that moves with a link."""

    link: str | None  # of the URDF; None for objects in the base frame that are not in the URDF
    shape: Shape
    T_link_solid: RigidTransform  # its pose in the link, or in the base frame
    material: Material = PART
    leg: int | None = None  # index of the leg it is coaxial with


@dataclass(frozen=True, eq=False)
class PlacedSolid:
    """A solid at its place in the base frame."""

    solid: Solid
    T_base_solid: RigidTransform


def solids_of(machine: Machine, *, meshes_needed: bool = True) -> tuple[Solid, ...]:
    """Return the visuals of a mechanism, with the legs that they are coaxial with.

    Empty boxes, which CAD exports put on links without a part, are left out, and so are meshes that
    cannot be read unless they are needed.
    """
    urdf = machine.urdf
    robot = parse_robot(urdf.path, urdf.content)
    colours = {m.get("name", ""): _rgb(m) for m in robot.findall("material")}
    poses = link_poses(machine, machine.home_configuration)
    problems: list[str] = []
    solids = []
    for element in robot.findall("link"):
        link = element.get("name", "")
        for visual in element.findall("visual"):
            geometry = visual.find("geometry")
            if geometry is None or len(geometry) == 0:
                continue
            size = number_list(geometry[0].get("size", ""), 3) if geometry[0].tag == "box" else None
            if size is not None and not any(size):
                continue
            try:
                shape, T = _shape_of(urdf.path, visual)
            except ValueError as error:
                if geometry[0].tag == "mesh" and not meshes_needed:
                    continue
                problems.append(
                    f"{urdf.path}, line {visual.sourceline}: the visual of link "
                    f"'{link}' could not be shown: {error}."
                )
                continue
            leg = None
            if isinstance(shape, SolidCylinder):
                leg = _leg_along(shape, product(poses[link], T), link, machine)
            named = visual.find("material")
            colour = None
            if named is not None:
                colour = _rgb(named) or colours.get(named.get("name", ""))
            material = _material(shape, colour, None if leg is None else machine.legs[leg])
            solids.append(Solid(link, shape, T, material, leg))
    if problems:
        raise ModelError(problems)
    return tuple(solids)


def link_poses(machine: Machine, configuration: Array) -> dict[str, RigidTransform]:
    """Return T_base_link of every link at a configuration of the chain, (nq,)."""
    chain, base = machine.chain, machine.base
    links = machine.urdf.links
    R, t = zip(*[chain.placement(configuration, base, link) for link in links], strict=True)
    return dict(zip(links, motions_of(np.array(R), np.array(t)), strict=True))


def placed(solids: Sequence[Solid], poses: Mapping[str, RigidTransform]) -> tuple[PlacedSolid, ...]:
    """Return solids placed by the poses of their links, T_base_link."""
    if not solids:
        return ()
    link_poses = [np.eye(4) if s.link is None else poses[s.link].as_matrix() for s in solids]
    matrices = matrix_product(
        np.array(link_poses), np.array([s.T_link_solid.as_matrix() for s in solids])
    )
    return tuple(map(PlacedSolid, solids, motions_of(matrices[:, :3, :3], matrices[:, :3, 3])))


def _leg_along(
    shape: SolidCylinder, T_base_shape: RigidTransform, link: str, machine: Machine
) -> int | None:
    """Return the leg that has a visual of a link, at home, among its cylinders."""
    half = np.array([0.0, 0.0, 0.5 * shape.length])
    ends = T_base_shape.apply(np.stack([-half, half]))
    vectors = vectors_A_to_B(machine, machine.home)
    A = machine.home.apply(machine.B_platform) - vectors
    u = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    within = coaxial_tolerance(machine.legs)
    for j, leg in enumerate(machine.legs):
        has_it = any(
            c.link == link and abs(c.radius - shape.radius) < within for c in leg.cylinders
        )
        if has_it and distance_to_line(ends, u[j], A[j]).max() < 2.0 * within:
            return j
    return None


def _material(shape: Shape, colour: tuple[float, float, float] | None, leg: Leg | None) -> Material:
    """Return the surface of a visual: its colour if it has one, else the most likely material."""
    material = PART
    if leg is not None and isinstance(shape, SolidCylinder):
        thickest = max(c.radius for c in leg.cylinders)
        material = TUBE if shape.radius > 0.999 * thickest else ROD
    if colour is None:
        return material
    albedo = max(sum(colour) / 3.0, 0.02)
    r, g, b = (c / albedo for c in colour)
    return replace(material, albedo=albedo, tint=(r, g, b))


_BALL = Material(albedo=0.06, specular=1.0, shininess=250.0, limb=0.2)
_POST = Material(albedo=0.04, specular=0.10, shininess=20.0, limb=0.3)
_PLATE = Material(albedo=0.09, specular=0.10, shininess=18.0, limb=0.1, texture=0.06)


def dressed(machine: Machine, *, meshes_needed: bool = True) -> tuple[Solid, ...]:
    """Return all solids of a mechanism in pictures: its visuals, and parts added to these.

    A link without a visual gets balls at the joint centres and, for three joints or more, a round
    plate that carries them on posts, on the side away from the legs. A link moved by a motor gets
    balls only, and a base with nothing but such motors nothing. Both plates of a planar machine are
    below its legs, the plate of the base lowest, so that the legs are visible from above.
    """
    shown = solids_of(machine, meshes_needed=meshes_needed)
    bare = {machine.base, machine.platform} - {s.link for s in shown if s.leg is None}
    radii = np.array([_radius(leg, machine) for leg in machine.legs])
    added: list[Solid] = []
    on_base = [j for j, leg in enumerate(machine.legs) if leg.actuator is None]
    if machine.base in bare and on_base:
        A = machine.A_base[on_base]
        away = _away(A, machine, -1.0)
        below = 0.0 if machine.spatial else _POST_LENGTH + _PLATE_THICKNESS + _GAP
        added += _end(machine.base, A, radii[on_base], [True] * len(A), away, below)
    for actuator in machine.actuators:
        if actuator.link not in {s.link for s in shown}:
            added += _on_actuator(machine, actuator, radii)
    if machine.platform in bare:
        balls = [not leg.is_fixed_to_platform for leg in machine.legs]
        B = machine.B_platform
        away = _away(machine.home.apply(B), machine, 1.0)
        if away is not None:
            away = machine.home.rotation.inv().apply(away)
        added += _end(machine.platform, B, radii, balls, away)
    return (*shown, *added)


def _on_actuator(machine: Machine, actuator: Actuator, radii: Array) -> list[Solid]:
    """Return the balls at the joints of the link that a motor moves, in that link."""
    on_it = [j for j, leg in enumerate(machine.legs) if leg.actuator is actuator]
    T_base_link = link_poses(machine, machine.home_configuration)[actuator.link]
    A = machine.home.apply(machine.B_platform) - vectors_A_to_B(machine, machine.home)
    joints = np.asarray(T_base_link.inv().apply(A[on_it]))
    return _end(actuator.link, joints, radii[on_it], [True] * len(on_it), None)


def _end(
    link: str,
    joints: Array,
    radii: Array,
    balls: Iterable[bool],
    away: Array | None,
    further: float = 0.0,
) -> list[Solid]:
    """Return the balls, posts and plate at one end of the legs, in its link.

    The posts are ``further`` radii of the thickest leg longer than they need to be.
    """
    solids = []
    for joint, R, ball in zip(joints, radii, balls, strict=True):
        if ball:
            position = RigidTransform.from_translation(joint)
            solids.append(Solid(link, Sphere(_BALL_SIZE * R), position, _BALL))
    if away is None:
        return solids
    turn = Rotation.align_vectors([away], [[0.0, 0.0, 1.0]])[0]
    thickest = float(radii.max())
    outside = float((joints @ away).max()) + (_POST_LENGTH + further) * thickest
    for joint, R in zip(joints, radii, strict=True):
        length = outside - float(joint @ away)
        middle = RigidTransform.from_components(joint + 0.5 * length * away, turn)
        post = SolidCylinder(_POST_SIZE * float(R), length)
        solids.append(Solid(link, post, middle, _POST))
    middle = joints.mean(axis=0)
    across = joints - middle
    across = across - (across @ away)[:, None] * away
    thickness = _PLATE_THICKNESS * thickest
    size = float(np.linalg.norm(across, axis=1).max()) + _PLATE_RIM * thickest
    position = middle + (outside + 0.5 * thickness - float(middle @ away)) * away
    pose = RigidTransform.from_components(position, turn)
    solids.append(Solid(link, SolidCylinder(size, thickness), pose, _PLATE))
    return solids


def _away(joints_base: Array, machine: Machine, side: float) -> Array | None:
    """Return the normal of the plane of joint centres, away from the legs, in the base frame."""
    if machine.base_normal is not None:
        return -machine.base_normal
    spread = joints_base - joints_base.mean(axis=0)
    _, sizes, axes = np.linalg.svd(spread)
    if len(joints_base) < 3 or sizes[1] < 0.05 * sizes[0]:
        return None
    normal = axes[2]
    legs = vectors_A_to_B(machine, machine.home).mean(axis=0)
    cosine = float(normal @ legs) / max(float(np.linalg.norm(legs)), 1e-12)
    if abs(cosine) < _FLAT:  # the legs are parallel to the plates: one plate on each side
        cosine = float(normal[np.argmax(np.abs(normal))])
    return np.asarray(side * np.sign(cosine) * normal)


def _radius(leg: Leg, machine: Machine) -> float:
    """Return the radius of the thickest cylinder of a leg, or a default [m]."""
    if leg.cylinders:
        return max(c.radius for c in leg.cylinders)
    length = leg.q0
    if leg.actuator is None:
        length = float(np.linalg.norm(machine.home.apply(leg.B) - leg.A))
    return _DEFAULT_RADIUS * length


@dataclass(frozen=True, eq=False)
class PosedMachine:
    """A machine in one pose."""

    A: Array  # A, B: (n_legs, 3) joint centres in the base link [m]
    B: Array
    solids: tuple[PlacedSolid, ...]  # visible solids, in the base link
    vertices: Array  # vertices, faces: (n, 3) the same as triangles, in the base link [m]
    faces: IntArray
    boards: tuple[Any, ...] = ()  # the ``PlacedBoard`` of each calibration board among the solids
    # Ends (2, 3) of the cylindrical arms, by the legs that have them as parts [m]
    arms: Mapping[int, Array] = field(default_factory=dict)

    def hidden(self, centre: Array, points: Array, margin: Array) -> BoolArray:
        """Return a mask of the points that are hidden from a centre by a solid."""
        if not len(self.faces):
            return np.zeros(len(points), dtype=np.bool_)
        distance = np.linalg.norm(points - centre, axis=-1)
        hits = first_hits(_caster(self), self.vertices, self.faces, centre, points)
        return np.asarray(hits < distance - margin)

    def encloses(self, centre: Array) -> bool:
        """Return whether a point (3,) is in a solid, or between the joints of the machine."""
        for placed_solid in self.solids:
            shape, point = placed_solid.solid.shape, placed_solid.T_base_solid.inv().apply(centre)
            (middle, reach), mesh = holding_sphere(shape), triangles(shape)
            is_near = np.linalg.norm(point - middle) < reach
            if is_near and mesh.is_watertight and mesh.contains(point[None])[0]:
                return True
        joints = np.concatenate([self.A, self.B])
        size = np.linalg.svd(joints - joints.mean(axis=0), compute_uv=False)
        if len(joints) < 5 or size[2] < _FLAT_JOINTS * size[0]:
            return False
        from scipy.spatial import Delaunay

        return bool(Delaunay(joints).find_simplex(centre) >= 0)


def pose_machine(
    machine: Machine, solids: Sequence[Solid], poses: Configurations
) -> tuple[PosedMachine, ...]:
    """Return a machine in every pose."""
    meshes = [triangles(solid.shape) for solid in solids]
    faces, first = [], 0
    for mesh in meshes:
        faces.append(mesh.faces + first)
        first += len(mesh.vertices)
    stacked = np.concatenate([np.zeros((0, 3), dtype=np.intp), *faces])
    posed_machines = []
    for configuration, T in zip(poses.configurations, poses.poses, strict=True):
        placed_solids = placed(solids, link_poses(machine, configuration))
        vertices = [
            p.T_base_solid.apply(m.vertices) for p, m in zip(placed_solids, meshes, strict=True)
        ]
        B = np.asarray(T.apply(machine.B_platform))
        q = joint_values(machine, configuration)
        arms = arms_at(machine.legs, q[None, first_rods(machine.legs)])
        of_legs = {j: ends[0] for j, ends in arms.items()}
        A, triangle = machine.A_at(q), np.concatenate([np.zeros((0, 3)), *vertices])
        posed_machines.append(PosedMachine(A, B, placed_solids, triangle, stacked, arms=of_legs))
    return tuple(posed_machines)


@lru_cache(maxsize=8)  # several cameras see one machine, and there may be thousands of machines
def _caster(posed: PosedMachine) -> Any:
    return ray_caster(posed.vertices, posed.faces)


@lru_cache(maxsize=256)  # links share shapes, and each camera sees all of them
def triangles(shape: Shape) -> Any:
    """Return a shape as triangles, shared: not to be modified."""
    import trimesh

    if isinstance(shape, SolidCylinder):
        return trimesh.creation.cylinder(shape.radius, shape.length, sections=_SECTIONS)
    if isinstance(shape, Sphere):
        return trimesh.creation.icosphere(_SUBDIVISIONS, shape.radius)
    if isinstance(shape, Box):
        return trimesh.creation.box(shape.size)
    return trimesh.Trimesh(shape.vertices, shape.faces, process=False)


@lru_cache(maxsize=256)
def holding_sphere(shape: Shape) -> tuple[Array, float]:
    """Return middle (3,) and radius of a sphere around a shape, in the shape's frame [m]."""
    vertices = np.asarray(triangles(shape).vertices)
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    return middle, float(np.linalg.norm(vertices - middle, axis=1).max())
