"""Rays against meshes, by trimesh and Embree."""

from functools import lru_cache
from typing import Any

import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.simulation.rendering.rays import Single
from legcal.simulation.rendering.solid_in_view import SolidInView
from legcal.simulation.shapes import Mesh


def first_triangle(solid: SolidInView, mesh: Mesh, x: Single, y: Single) -> tuple[Single, IntArray]:
    """Return depth [m] and triangle of a mesh that rays (x, y, 1) meet first; infinite where none.

    Embree finds the triangle in single precision; the depth is that of its plane.
    """
    rays = np.stack([x, y, np.ones_like(x)], axis=1).astype(np.float64) @ solid.R
    origin = -solid.R.T @ solid.w
    triangle = _caster(mesh).intersects_first(np.broadcast_to(origin, rays.shape), rays)
    z = np.full(len(x), np.inf, dtype=np.float32)
    hit = np.flatnonzero(triangle >= 0)
    corners = mesh.vertices[mesh.faces[triangle[hit]]]
    n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.sum(n * (corners[:, 0] - origin), axis=1) / np.sum(n * rays[hit], axis=1)
    z[hit] = np.where(np.isfinite(depth) & (depth > 0.0), depth, np.inf)
    return z, np.where(triangle >= 0, triangle, 0).astype(np.intp)


def is_hidden(solid: SolidInView, mesh: Mesh, P: Single, lamp: Array) -> Single:
    """Return 1 where a mesh stands between points (3, n) of the camera frame and a lamp, else 0."""
    points = (P.T - solid.w) @ solid.R
    towards = (lamp - solid.w) @ solid.R - points
    hidden = _caster(mesh).intersects_any(points, towards)
    return np.asarray(hidden, dtype=np.float32)


@lru_cache(maxsize=256)
def _caster(mesh: Mesh) -> Any:
    """Return what casts rays at a mesh."""
    import trimesh  # half a second: only where there is a mesh

    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).ray
