"""The solids that a mechanism is seen as: the visuals of its URDF, and where they are."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.frames import product
from legcal.geometry.lines import distance_to_line
from legcal.geometry.types import Array
from legcal.mechanism.cylinders import COAXIAL
from legcal.mechanism.leg import Leg
from legcal.mechanism.model import Mechanism
from legcal.simulation.shapes import Cylinder, Shape
from legcal.simulation.visuals import Visual, visuals


class Sheet(Protocol):
    """What is printed on a face of a box.

    Attributes
    ----------
    face : int
        The face: -x, -y, -z, x, y, z.
    """

    @property
    def face(self) -> int:
        """The face."""

    def reflectance(self, x: Array, y: Array) -> Array:
        """Return factors (n,) of the albedo at points x, y of the z faces, in the box [m]."""


@dataclass(frozen=True)
class Material:
    """How a surface returns light; everything in linear light, not in grey levels.

    Attributes
    ----------
    albedo : float
        Share of light that is scattered evenly, 0 to 1.
    specular : float
        Strength of the highlight; 0 for a dull surface, about 1 for polished steel.
    shininess : float
        Exponent of the highlight: the larger, the narrower.
    limb : float
        How much darker the surface is where it is seen edge-on, 0 to 1: the scattered light is
        times 1 - limb (1 - cos), with the angle between the normal and the line of sight. On a
        cylinder the cosine grows like the square root of the depth inside the outline.
    texture : float
        Standard deviation of a mottled pattern on it, as a part of the albedo.
    tint : tuple of float
        Factors of red, green, blue; used in pictures in colour only.
    sheet : Sheet or None
        What is printed on one of its faces, if it is a box.
    """

    albedo: float = 0.5
    specular: float = 0.1
    shininess: float = 20.0
    limb: float = 0.3
    texture: float = 0.0
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    sheet: Sheet | None = None


TUBE = Material(albedo=0.70, specular=0.25, shininess=40.0, limb=0.35)
ROD = Material(albedo=0.35, specular=0.80, shininess=80.0, limb=0.35)
PART = Material(albedo=0.30, specular=0.05, shininess=15.0, limb=0.20)


@dataclass(frozen=True, eq=False)
class Solid:
    """A solid that moves with a link.

    Attributes
    ----------
    name : str
        Its name.
    link : str or None
        The URDF link; None where it stands in the base frame and is no part of the machine.
    shape : Cylinder, Sphere, Box or Mesh
        Its shape.
    T_link_solid : RigidTransform
        Its pose in the link, or in the base frame.
    material : Material
        Its surface.
    leg : int or None
        The leg whose axis it is coaxial with, as an index into ``mechanism.legs``.
    part : str or None
        The link that names it as a part of that leg in observations.
    """

    name: str
    link: str | None
    shape: Shape
    T_link_solid: RigidTransform
    material: Material = PART
    leg: int | None = None
    part: str | None = None


@dataclass(frozen=True, eq=False)
class PlacedSolid:
    """A solid at its place in the base frame."""

    solid: Solid
    T_base_solid: RigidTransform


def solids_of(mechanism: Mechanism) -> tuple[Solid, ...]:
    """Return the visuals of a mechanism, those that are coaxial with legs marked as such.

    Parameters
    ----------
    mechanism : Mechanism
        The mechanism.

    Raises
    ------
    ModelError
        If a visual has no size or its mesh is missing or has no triangles.
    """
    shown = visuals(mechanism.urdf)
    poses = link_poses(mechanism, mechanism.home_configuration)
    lines = _leg_lines(mechanism)
    counts: dict[str, int] = {}
    solids = []
    for visual in shown:
        number = counts[visual.link] = counts.get(visual.link, 0) + 1
        leg = _leg_of(visual, poses[visual.link], mechanism.legs, lines)
        solids.append(
            Solid(
                name=visual.link if number == 1 else f"{visual.link}/{number}",
                link=visual.link,
                shape=visual.shape,
                T_link_solid=visual.T_link_shape,
                material=_material(visual, None if leg is None else mechanism.legs[leg]),
                leg=leg,
                part=None if leg is None else visual.link,
            )
        )
    return tuple(solids)


def link_poses(mechanism: Mechanism, configuration: Array) -> dict[str, RigidTransform]:
    """Return T_base_link of every link at a configuration of the chain, (nq,)."""
    chain, base = mechanism.chain, mechanism.base
    return {link: chain.pose(configuration, base, link) for link in mechanism.urdf.links}


def placed(solids: Sequence[Solid], poses: Mapping[str, RigidTransform]) -> tuple[PlacedSolid, ...]:
    """Return solids where the poses of their links, T_base_link, put them."""
    return tuple(
        PlacedSolid(s, s.T_link_solid if s.link is None else product(poses[s.link], s.T_link_solid))
        for s in solids
    )


def _leg_lines(mechanism: Mechanism) -> list[tuple[Array, Array]]:
    """Return a point and the direction of every leg's axis at home, in the base frame."""
    A, B = mechanism.A_base, mechanism.home.apply(mechanism.B_platform)
    u = (B - A) / np.linalg.norm(B - A, axis=-1, keepdims=True)
    return list(zip(A, u, strict=True))


def _leg_of(
    visual: Visual,
    T_base_link: RigidTransform,
    legs: Sequence[Leg],
    lines: list[tuple[Array, Array]],
) -> int | None:
    """Return the leg that counts a visual among its cylinders, at home."""
    if not isinstance(visual.shape, Cylinder):
        return None
    half = np.array([0.0, 0.0, 0.5 * visual.shape.length])
    ends = (T_base_link * visual.T_link_shape).apply(np.stack([-half, half]))
    for j, (leg, (A, u)) in enumerate(zip(legs, lines, strict=True)):
        counted = any(
            c.link == visual.link and abs(c.radius - visual.shape.radius) < COAXIAL
            for c in leg.cylinders
        )
        if counted and distance_to_line(ends, u, A).max() < 2.0 * COAXIAL:
            return j
    return None


def _material(visual: Visual, leg: Leg | None) -> Material:
    """Return the surface of a visual: its colour if it has one, else what it most likely is."""
    material = PART
    if leg is not None and isinstance(visual.shape, Cylinder):
        thickest = max(c.radius for c in leg.cylinders)
        material = TUBE if visual.shape.radius > 0.999 * thickest else ROD
    if visual.colour is None:
        return material
    albedo = max(sum(visual.colour) / 3.0, 0.02)
    r, g, b = (c / albedo for c in visual.colour)
    return replace(material, albedo=albedo, tint=(r, g, b))
