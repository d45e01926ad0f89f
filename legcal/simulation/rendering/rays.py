"""Rays of a camera's pixels and their intersections with solids: depth, face, normal, print."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array, IntArray
from legcal.machine.meshes import ray_caster
from legcal.simulation.solids import (
    Box,
    Material,
    Mesh,
    PlacedSolid,
    Shape,
    SolidCylinder,
    Sphere,
    holding_sphere,
)
from legcal.vision.camera import Camera

Single = NDArray[np.float32]
Faces = NDArray[np.integer[Any]]

_TILE = 64  # [px] period of the shifts of the lattice
_SPACING = 8  # [px] between the pixels that are undistorted exactly

CAP = 1  # the face of a cylinder; 0 is its lateral surface
_TINY = 1e-12

NEAR = 1e-4  # [m] in front of the camera
MARGIN = 2  # [px]
_SPARE = 0.02  # margin around the picture, in units of its size
_PIECES = 12  # segments of each side of a polygon, which the lens bends
_SHIFT = 4  # fractional bits of pixels
_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])

_PIXELS = 8192  # pixels processed at a time


class PixelRays:
    """The points (x, y) of the sensor plane seen at every pixel, and between pixels.

    In single precision: 3e-8 of the sensor plane, 1e-4 px of a long lens.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.width, self.height = camera.width, camera.height
        x, y = _undistorted(camera)
        self.x: Single = x.ravel()
        self.y: Single = y.ravel()
        self.low = np.array([x.min(), y.min()], dtype=np.float64)
        self.high = np.array([x.max(), y.max()], dtype=np.float64)

    def within(self, pixels: IntArray, samples: int) -> tuple[Single, Single]:
        """Return several points (x, y) inside each of some pixels, both (n, samples).

        They are a Fibonacci lattice, shifted differently in each pixel, so that the share of points
        on one side of an edge is an unbiased estimate of the pixel's area there.
        """
        rows, columns = np.divmod(pixels, self.width)
        du, dv = _offsets(samples)
        tile = rows % _TILE * _TILE + columns % _TILE
        du, dv = du[tile], dv[tile]
        left = np.where(columns > 0, pixels - 1, pixels)
        right = np.where(columns < self.width - 1, pixels + 1, pixels)
        above = np.where(rows > 0, pixels - self.width, pixels)
        below = np.where(rows < self.height - 1, pixels + self.width, pixels)
        across = (right - left).astype(np.float32)[:, None]
        down = ((below - above) // self.width).astype(np.float32)[:, None]
        points = []
        for grid in (self.x, self.y):
            along_u = (grid[right] - grid[left])[:, None] / across
            along_v = (grid[below] - grid[above])[:, None] / down
            point = along_u * du
            point += along_v * dv
            point += grid[pixels][:, None]
            points.append(point)
        return points[0], points[1]


def _undistorted(camera: Camera) -> tuple[Single, Single]:
    """Return the sensor plane's x and y at every pixel, (height, width).

    Distortion is undone at some pixels and is a quintic spline in between, to 1e-6 px.
    """
    v, u = (np.linspace(0.0, n - 1.0, max(n // _SPACING, 6)) for n in (camera.height, camera.width))
    xy = camera.undistort(np.stack(np.meshgrid(u, v), axis=-1))
    rows, columns = np.arange(float(camera.height)), np.arange(float(camera.width))
    x, y = (
        RectBivariateSpline(v, u, xy[..., i], kx=5, ky=5, s=0.0)(rows, columns).astype(np.float32)
        for i in (0, 1)
    )
    return x, y


@lru_cache(maxsize=4)
def pixel_rays(camera: Camera, fineness: int = 1) -> PixelRays:
    """Return the rays of the parts of a camera's pixels, shared by all of its images."""
    return PixelRays(camera if fineness == 1 else divided(camera, fineness))


def divided(camera: Camera, fineness: float) -> Camera:
    """Return a camera with ``fineness`` x ``fineness`` pixels in place of each pixel."""
    K = camera.K * [[fineness], [fineness], [1.0]]
    K[:2, 2] += 0.5 * (fineness - 1)
    width, height = round(fineness * camera.width), round(fineness * camera.height)
    return replace(camera, K=K, width=width, height=height)


@lru_cache(maxsize=4)
def _offsets(samples: int) -> tuple[Single, Single]:
    """Return the positions of rays in each pixel of a tile, (_TILE * _TILE, samples) [px]."""
    before, now = 1, 1
    while now < samples:
        before, now = now, before + now
    i = np.arange(samples)
    lattice = np.stack([(i + 0.5) / samples, (i * before % samples + 0.5) / samples])
    shifts = np.random.default_rng(0).random((2, _TILE * _TILE, 1))
    u, v = ((lattice[:, None] + shifts) % 1.0 - 0.5).astype(np.float32)
    return u, v


@dataclass(frozen=True, eq=False)
class SolidInView:
    """A solid at its place in the camera frame."""

    shape: Shape  # its shape
    material: Material  # its surface
    R: Array  # R, w: (3, 3) rotation and translation [m] of T_camera_solid
    w: Array
    centre: Array  # (3,) the middle of a sphere that holds it [m]
    reach: float  # the radius of that sphere [m]


def in_view(solids: Sequence[PlacedSolid], T_camera_base: RigidTransform) -> list[SolidInView]:
    """Return solids in the frame of a camera."""
    if not solids:
        return []
    motions = np.stack([placed.T_base_solid.as_matrix() for placed in solids])
    in_camera = []
    for placed, T in zip(solids, T_camera_base.as_matrix() @ motions, strict=True):
        shape, R, w = placed.solid.shape, T[:3, :3], T[:3, 3]
        middle, reach = holding_sphere(shape)
        in_camera.append(SolidInView(shape, placed.solid.material, R, w, R @ middle + w, reach))
    return in_camera


def first_triangle(solid: SolidInView, mesh: Mesh, x: Single, y: Single) -> tuple[Single, IntArray]:
    """Return depth [m] and index of the first triangle on rays (x, y, 1); infinite for a miss.

    Embree finds the triangle in single precision; the depth is computed from its plane.
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
    """Return 1 where a mesh is between points (3, n) of the camera frame and a lamp, else 0."""
    points = (P.T - solid.w) @ solid.R
    towards = (lamp - solid.w) @ solid.R - points
    hidden = _caster(mesh).intersects_any(points, towards)
    return np.asarray(hidden, dtype=np.float32)


@lru_cache(maxsize=256)
def _caster(mesh: Mesh) -> Any:
    return ray_caster(mesh.vertices, mesh.faces)


def intersect(solid: SolidInView, x: Single, y: Single) -> tuple[Single, Faces]:
    """Return the depths and faces of the entry points of rays into a solid."""
    shape = solid.shape
    if isinstance(shape, SolidCylinder):
        return _cylinder(solid, shape, x, y)
    if isinstance(shape, Sphere):
        return _sphere(solid, shape, x, y)
    if isinstance(shape, Box):
        return _box(solid, shape, x, y)
    return first_triangle(solid, shape, x, y)


def normals(solid: SolidInView, P: Single, face: Faces) -> Single:
    """Return the outward unit normals at points of a solid's faces, (3, n)."""
    shape = solid.shape
    w = solid.w.astype(np.float32)[:, None]
    if isinstance(shape, Sphere):
        return np.asarray((P - w) * np.float32(1.0 / shape.radius))
    if isinstance(shape, SolidCylinder):
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


def _cylinder(
    solid: SolidInView, shape: SolidCylinder, x: Single, y: Single
) -> tuple[Single, Faces]:
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


def footprint(rays: PixelRays, solid: SolidInView) -> IntArray:
    """Return the pixels that a solid may cover, with a small margin.

    The hull of points around the solid is clipped to the picture's part of the sensor plane, where
    the lens model is valid, before it is distorted.
    """
    points = surrounding_points(solid)
    in_front = points[:, 2] > NEAR
    if not in_front.any():
        return np.zeros(0, dtype=np.intp)
    if not in_front.all():
        return np.arange(rays.width * rays.height)
    hull = _hull(points[:, :2] / points[:, 2:])
    spare = _SPARE * (rays.high - rays.low)
    hull = _cut(hull, rays.low - spare, rays.high + spare)
    if not len(hull):
        return np.zeros(0, dtype=np.intp)
    # More points along its sides: the lens bends them.
    along, side = np.arange(_PIECES)[:, None] / _PIECES, np.roll(hull, -1, axis=0) - hull
    dense = (hull[:, None] + along * side[:, None]).reshape(-1, 2)
    return _filled(_hull(rays.camera.distort(dense)), rays.width, rays.height)


def surrounding_points(solid: SolidInView) -> Array:
    """Return points (n, 3) in the camera frame with a convex hull that contains the solid [m]."""
    shape = solid.shape
    if isinstance(shape, SolidCylinder):
        n = 12
        angles = 2.0 * np.pi * np.arange(n) / n
        outer = shape.radius / np.cos(np.pi / n)
        ring = np.stack([outer * np.cos(angles), outer * np.sin(angles), np.zeros(n)], axis=-1)
        end = np.array([0.0, 0.0, 0.5 * shape.length])
        points = np.concatenate([ring - end, ring + end])
    elif isinstance(shape, Box):
        points = _CORNERS * np.array(shape.size)
    elif isinstance(shape, Sphere):
        points = 2.0 * shape.radius * _CORNERS
    else:
        points = shape.vertices
    return np.asarray(points @ solid.R.T + solid.w)


def _hull(points: Array) -> Array:
    """Return the convex hull of points in the plane, in order, (n, 2)."""
    return np.asarray(cv2.convexHull(points.astype(np.float32))[:, 0], dtype=np.float64)


def _cut(polygon: Array, low: Array, high: Array) -> Array:
    """Return the part of a convex polygon inside a rectangle."""
    if np.all((polygon >= low) & (polygon <= high)):
        return polygon
    for axis in (0, 1):
        for bound, sign in ((low[axis], 1.0), (high[axis], -1.0)):
            inside = sign * (polygon[:, axis] - bound)
            kept = []
            for i in range(len(polygon)):
                distance, previous = inside[i], inside[i - 1]
                if (distance >= 0.0) != (previous >= 0.0):
                    t = previous / (previous - distance)
                    kept.append(polygon[i - 1] + t * (polygon[i] - polygon[i - 1]))
                if distance >= 0.0:
                    kept.append(polygon[i])
            if not kept:
                return np.zeros((0, 2))
            polygon = np.array(kept)
    return polygon


def _filled(hull: Array, width: int, height: int) -> IntArray:
    """Return the pixels in and around a convex polygon of pixels."""
    low = np.maximum(np.floor(hull.min(axis=0)).astype(int) - MARGIN - 1, 0)
    high = np.minimum(np.ceil(hull.max(axis=0)).astype(int) + MARGIN + 2, [width, height])
    if np.any(high <= low):
        return np.zeros(0, dtype=np.intp)
    mask = np.zeros((high[1] - low[1], high[0] - low[0]), dtype=np.uint8)
    corners = np.rint((hull - low) * 2**_SHIFT).astype(np.int32)
    cv2.fillConvexPoly(mask, corners, 1, shift=_SHIFT)
    cv2.polylines(mask, [corners], True, 1, thickness=2 * MARGIN + 1, shift=_SHIFT)
    inside = np.flatnonzero(mask)
    skipped = width - mask.shape[1]  # pixels between the end of a row and the start of the next
    return np.asarray(inside + inside // mask.shape[1] * skipped + low[1] * width + low[0])


def printed(solid: SolidInView, x: Single, y: Single, face: Faces) -> Single | None:
    """Return factors (n,) of the albedo where rays meet a solid; None without a print."""
    sheet = solid.material.sheet
    if sheet is None or not isinstance(solid.shape, Box):
        return None
    height = (0.5 if sheet.face > 2 else -0.5) * solid.shape.size[2]
    origin = -solid.R.T @ solid.w
    a, b, c = (solid.R[:, i].tolist() for i in range(3))
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        depth = (height - float(origin[2])) / (x * c[0] + y * c[1] + c[2])
        u = float(origin[0]) + depth * (x * a[0] + y * a[1] + a[2])
        v = float(origin[1]) + depth * (x * b[0] + y * b[1] + b[2])
    factor = np.ones(len(x), dtype=np.float32)
    on = np.flatnonzero((face == sheet.face) & np.isfinite(u) & np.isfinite(v))
    factor[on] = sheet.reflectance(u[on], v[on])
    return factor


def printed_inside(
    solid: SolidInView, rays: PixelRays, pixels: IntArray, face: Faces, samples: int
) -> Single | None:
    """Return the mean of :func:`printed` over each of some pixels, (n,); None without a print."""
    if solid.material.sheet is None:
        return None
    means = []
    for start in range(0, len(pixels), _PIXELS):
        pixel_chunk = pixels[start : start + _PIXELS]
        x, y = rays.within(pixel_chunk, samples)
        faces = np.repeat(face[start : start + _PIXELS], samples)
        ink = printed(solid, x.ravel(), y.ravel(), faces)
        if ink is None:
            return None
        means.append(ink.reshape(len(pixel_chunk), samples).mean(axis=1))
    return np.concatenate(means) if means else np.zeros(0, dtype=np.float32)
