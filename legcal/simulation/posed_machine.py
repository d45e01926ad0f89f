"""A machine in one pose as viewing rays meet it: triangles, hit by embree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import trimesh
from trimesh.ray.ray_pyembree import RayMeshIntersector

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.mechanism.configurations import Configurations
from legcal.mechanism.model import Mechanism
from legcal.simulation.shapes import Box, Cylinder, Shape, Sphere
from legcal.simulation.solids import PlacedSolid, Solid, link_poses, placed

_SECTIONS = 48  # sides of a cylinder of triangles: 0.2 % of its radius too thin at most
_SUBDIVISIONS = 2  # of an icosahedron that stands for a sphere
_FLAT = 1e-3  # thickness of joint centres that lie in a plane, of their size


@dataclass(frozen=True, eq=False)
class PosedMachine:
    """A machine in one pose.

    Attributes
    ----------
    A, B : (n_legs, 3) array
        Joint centres in the base link [m].
    solids : tuple of PlacedSolid
        What is seen of it, in the base link.
    vertices, faces : (n, 3) array and (m, 3) array of int
        The same as triangles, in the base link [m].
    """

    A: Array
    B: Array
    solids: tuple[PlacedSolid, ...]
    vertices: Array
    faces: IntArray

    def hidden(self, centre: Array, points: Array, margin: Array) -> BoolArray:
        """Return which points something stands before, seen from a centre.

        Parameters
        ----------
        centre : (3,) array
            The camera centre in the base link [m].
        points : (n, 3) array
            Points in the base link [m].
        margin : (n,) array
            What is hit this near to a point, or behind it, does not hide it [m].
        """
        ray = points - centre
        distance = np.linalg.norm(ray, axis=-1)
        ray = ray / distance[:, None]
        hits, index, _ = _caster(self).intersects_location(
            np.broadcast_to(centre, ray.shape), ray, multiple_hits=False
        )
        hidden = np.zeros(len(points), dtype=np.bool_)
        reached = np.linalg.norm(np.reshape(hits, (-1, 3)) - centre, axis=-1)
        hidden[index] = reached < distance[index] - margin[index]
        return hidden

    def encloses(self, centre: Array) -> bool:
        """Say whether a point (3,) is in a solid, or between the joints of the machine."""
        if any(
            _is_in(shape.solid.shape, shape.T_base_solid.inv().apply(centre))
            for shape in self.solids
        ):
            return True
        joints = np.concatenate([self.A, self.B])
        size = np.linalg.svd(joints - joints.mean(axis=0), compute_uv=False)
        if len(joints) < 5 or size[2] < _FLAT * size[0]:
            return False
        from scipy.spatial import Delaunay

        return bool(Delaunay(joints).find_simplex(centre) >= 0)


def pose_machine(
    mechanism: Mechanism, solids: Sequence[Solid], poses: Configurations
) -> tuple[PosedMachine, ...]:
    """Return a machine in every pose.

    Parameters
    ----------
    mechanism : Mechanism
        The true machine.
    solids : sequence of Solid
        What is seen of it.
    poses : Configurations
        Its poses.
    """
    meshes = [_triangles(solid.shape) for solid in solids]
    faces, first = [], 0
    for mesh in meshes:
        faces.append(mesh.faces + first)
        first += len(mesh.vertices)
    stacked = np.concatenate(faces)
    machines = []
    for configuration, T in zip(poses.configurations, poses.poses, strict=True):
        here = placed(solids, link_poses(mechanism, configuration))
        vertices = [p.T_base_solid.apply(m.vertices) for p, m in zip(here, meshes, strict=True)]
        B = np.asarray(T.apply(mechanism.B_platform))
        machines.append(PosedMachine(mechanism.A_base, B, here, np.concatenate(vertices), stacked))
    return tuple(machines)


@lru_cache(maxsize=8)  # many cameras may look at one machine, and thousands wait for theirs
def _caster(machine: PosedMachine) -> RayMeshIntersector:
    """Return what casts rays at a machine."""
    return RayMeshIntersector(trimesh.Trimesh(machine.vertices, machine.faces, process=False))


def _triangles(shape: Shape) -> Any:
    """Return a shape as triangles."""
    if isinstance(shape, Cylinder):
        return trimesh.creation.cylinder(shape.radius, shape.length, sections=_SECTIONS)
    if isinstance(shape, Sphere):
        return trimesh.creation.icosphere(_SUBDIVISIONS, shape.radius)
    if isinstance(shape, Box):
        return trimesh.creation.box(shape.size)
    return trimesh.Trimesh(shape.vertices, shape.faces, process=False)


def _is_in(shape: Shape, point: Array) -> bool:
    """Say whether a point (3,) in the frame of a shape is inside it."""
    if isinstance(shape, Cylinder):
        beside = np.hypot(point[0], point[1]) < shape.radius
        return bool(beside and abs(point[2]) < 0.5 * shape.length)
    if isinstance(shape, Sphere):
        return bool(np.linalg.norm(point) < shape.radius)
    if isinstance(shape, Box):
        return bool(np.all(np.abs(point) < 0.5 * np.asarray(shape.size)))
    mesh = _triangles(shape)
    return bool(mesh.is_watertight and mesh.contains(point[None])[0])
