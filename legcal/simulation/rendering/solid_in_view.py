"""A solid in the camera frame, ready for rays."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array
from legcal.simulation.shapes import Cylinder, Mesh, Shape, Sphere
from legcal.simulation.solids import Material, PlacedSolid


@dataclass(frozen=True, eq=False)
class SolidInView:
    """A solid at its place in the camera frame.

    Attributes
    ----------
    shape : Cylinder, Sphere, Box or Mesh
        Its shape.
    material : Material
        Its surface.
    R, w : (3, 3) and (3,) array
        Rotation and translation [m] of T_camera_solid.
    centre : (3,) array
        The middle of a sphere that holds it [m].
    reach : float
        The radius of that sphere [m].
    """

    shape: Shape
    material: Material
    R: Array
    w: Array
    centre: Array
    reach: float


def in_view(solids: Sequence[PlacedSolid], T_camera_base: RigidTransform) -> list[SolidInView]:
    """Return solids in the frame of a camera."""
    if not solids:
        return []
    motions = np.stack([placed.T_base_solid.as_matrix() for placed in solids])
    found = []
    for placed, T in zip(solids, T_camera_base.as_matrix() @ motions, strict=True):
        shape, R, w = placed.solid.shape, T[:3, :3], T[:3, 3]
        middle, reach = holding_sphere(shape)
        found.append(SolidInView(shape, placed.solid.material, R, w, R @ middle + w, reach))
    return found


def holding_sphere(shape: Shape) -> tuple[Array, float]:
    """Return middle (3,) and radius of a sphere around a shape, in its own frame [m]."""
    if isinstance(shape, Mesh):
        low, high = shape.vertices.min(axis=0), shape.vertices.max(axis=0)
        middle = 0.5 * (low + high)
        return middle, float(np.linalg.norm(shape.vertices - middle, axis=1).max())
    if isinstance(shape, Cylinder):
        return np.zeros(3), float(np.hypot(shape.radius, 0.5 * shape.length))
    if isinstance(shape, Sphere):
        return np.zeros(3), shape.radius
    return np.zeros(3), 0.5 * float(np.linalg.norm(shape.size))
