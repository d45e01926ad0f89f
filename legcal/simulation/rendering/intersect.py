"""Where rays from the camera centre first meet a solid.

A ray is d = (x, y, 1), so that the distance z along it is the depth. A cylinder is met through the
distance of the ray from its axis, which stays exact to 1e-7 of the scene in single precision.
"""

import numpy as np

from legcal.simulation.rendering.meshes import first_triangle
from legcal.simulation.rendering.rays import Faces, Single
from legcal.simulation.rendering.solid_in_view import SolidInView
from legcal.simulation.shapes import Box, Cylinder, Sphere

LATERAL, CAP = 0, 1  # faces of a cylinder
_TINY = 1e-12


def intersect(solid: SolidInView, x: Single, y: Single) -> tuple[Single, Faces]:
    """Return where rays enter a solid.

    Parameters
    ----------
    solid : SolidInView
        A solid that the camera is not inside of.
    x, y : (n,) array
        Rays (x, y, 1).

    Returns
    -------
    z : (n,) array
        Depth [m]; infinite where the ray passes.
    face : (n,) array of int
        The face of the solid that is met, of a mesh the triangle.
    """
    shape = solid.shape
    if isinstance(shape, Cylinder):
        return _cylinder(solid, shape, x, y)
    if isinstance(shape, Sphere):
        return _sphere(solid, shape, x, y)
    if isinstance(shape, Box):
        return _box(solid, shape, x, y)
    return first_triangle(solid, shape, x, y)


def normals(solid: SolidInView, P: Single, face: Faces) -> Single:
    """Return the outward unit normals at points of a solid's faces, (3, n).

    Parameters
    ----------
    solid : SolidInView
        The solid.
    P : (3, n) array
        Points of its surface in the camera frame [m].
    face : (n,) array of int
        Their faces.
    """
    shape = solid.shape
    w = solid.w.astype(np.float32)[:, None]
    if isinstance(shape, Sphere):
        return np.asarray((P - w) * np.float32(1.0 / shape.radius))
    if isinstance(shape, Cylinder):
        u = solid.R[:, 2].astype(np.float32)
        away = P - w
        s = u @ away
        n = (away - u[:, None] * s) * np.float32(1.0 / shape.radius)
        caps = np.flatnonzero(face)
        if len(caps):
            n[:, caps] = u[:, None] * np.sign(s[caps])
        return n
    if isinstance(shape, Box):
        sides = np.concatenate([-solid.R, solid.R], axis=1).astype(np.float32)
        return sides[:, face]
    corners = shape.vertices[shape.faces[face]]
    n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) @ solid.R.T
    n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), _TINY)
    n *= -np.sign(np.sum(n * P.T, axis=1, keepdims=True))  # towards the camera, however they turn
    return np.asarray(n.T.astype(np.float32))


def _cylinder(solid: SolidInView, shape: Cylinder, x: Single, y: Single) -> tuple[Single, Faces]:
    """Return depths and faces of a closed cylinder."""
    ux, uy, uz = solid.R[:, 2].tolist()
    wx, wy, wz = solid.w.tolist()
    hx, hy, hz = np.cross(solid.R[:, 2], solid.w).tolist()
    along = float(solid.R[:, 2] @ solid.w)
    half = 0.5 * shape.length
    cx, cy, cz = y * uz - uy, ux - x * uz, x * uy - y * ux  # d x u
    c2 = np.maximum(cx * cx + cy * cy + cz * cz, _TINY)
    m = x * hx + y * hy + hz  # distance from the axis, times |d x u|
    disc = c2 * shape.radius**2 - m * m
    hit = disc > 0.0
    du = x * ux + y * uy + uz
    z = ((x * wx + y * wy + wz) - du * along - np.sqrt(np.maximum(disc, 0.0))) / c2
    s = z * du - along
    hit &= (np.abs(s) <= half) & (z > 0.0)
    z[~hit] = np.inf
    face = np.zeros(len(x), dtype=np.uint8)
    if abs(along) > half:  # one cap faces the camera
        end = -half if along > 0.0 else half
        ex, ey, ez = (solid.w + end * solid.R[:, 2]).tolist()
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            depth = (along + end) / du
            px, py, pz = depth * x - ex, depth * y - ey, depth - ez
            on_cap = (px * px + py * py + pz * pz <= shape.radius**2) & (depth > 0.0) & (depth < z)
        z[on_cap] = depth[on_cap]
        face[on_cap] = CAP
    return z, face


def _sphere(solid: SolidInView, shape: Sphere, x: Single, y: Single) -> tuple[Single, Faces]:
    """Return depths of a sphere."""
    wx, wy, wz = solid.w.tolist()
    cx, cy, cz = y * wz - wy, wx - x * wz, x * wy - y * wx  # d x w
    d2 = x * x + y * y + 1.0
    disc = d2 * shape.radius**2 - (cx * cx + cy * cy + cz * cz)
    z = ((x * wx + y * wy + wz) - np.sqrt(np.maximum(disc, 0.0))) / d2
    z[(disc <= 0.0) | (z <= 0.0)] = np.inf
    return z, np.zeros(len(x), dtype=np.uint8)


def _box(solid: SolidInView, shape: Box, x: Single, y: Single) -> tuple[Single, Faces]:
    """Return depths and faces (-x, -y, -z, x, y, z) of a box."""
    origin = -solid.R.T @ solid.w
    enter = np.full(len(x), -np.inf, dtype=np.float32)
    leave = np.full(len(x), np.inf, dtype=np.float32)
    face = np.zeros(len(x), dtype=np.uint8)
    for axis in range(3):
        rx, ry, rz = solid.R[:, axis].tolist()
        d = x * rx + y * ry + rz
        d[d == 0.0] = _TINY
        low = (-0.5 * shape.size[axis] - float(origin[axis])) / d
        high = (0.5 * shape.size[axis] - float(origin[axis])) / d
        first, last = np.minimum(low, high), np.maximum(low, high)
        later = first > enter
        enter[later] = first[later]
        face[later] = np.where(d[later] > 0.0, axis, axis + 3)
        np.minimum(leave, last, out=leave)
    enter[(enter > leave) | (enter <= 0.0)] = np.inf
    return enter, face
