"""Photographs: surroundings of a view, radiance of pixels, then lens and sensor.

Surfaces have the light of each lamp, and the shadows of solids.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array, BoolArray, Image, IntArray
from legcal.simulation.rendering.appearance import SAMPLES, Appearance, background, mottled
from legcal.simulation.rendering.rays import (
    Faces,
    PixelRays,
    Single,
    SolidInView,
    footprint,
    in_view,
    intersect,
    is_hidden,
    normals,
    pixel_rays,
    printed,
    printed_inside,
)
from legcal.simulation.solids import (
    Box,
    Material,
    Mesh,
    PlacedSolid,
    Shape,
    Solid,
    SolidCylinder,
    Sphere,
    holding_sphere,
    triangles,
)
from legcal.vision.camera import Camera

_TINY = 1e-12
_SMALLEST = 1e-5  # [m] half-shadow of a point-like lamp
_CHUNK = 8192  # points processed at a time
_SPARE = 1e-4  # [m] margin for rounding

_SHARP = 0.3  # minimum strength of highlights of a surface that mirrors its surroundings

_STEP = 4  # [px] between traced pixels

_LARGE = 20_000  # minimum number of pixels of a solid with coarsely traced shadows


@dataclass(frozen=True, eq=False)
class Lamp:
    """A light in the camera frame."""

    position: Array  # (3,) [m]
    power: float  # radiance of a white surface that faces it, times its squared distance [m^2]
    radius: float  # its size [m]
    shadows: bool  # whether solids cast shadows of it


class Occluders:
    """Solids that may be between points and lamps: long solids by a line, others by a ball."""

    def __init__(self, solids: Sequence[SolidInView]) -> None:
        long = [
            isinstance(s.shape, SolidCylinder) and s.shape.length > s.shape.radius for s in solids
        ]
        self._lines = [i for i, is_long in enumerate(long) if is_long]
        self._balls = [i for i, is_long in enumerate(long) if not is_long]
        self.solids = tuple(solids)
        self._u = np.array([solids[i].R[:, 2] for i in self._lines]).reshape(-1, 3)
        self._w = np.array([solids[i].w for i in self._lines]).reshape(-1, 3)
        self._radius = np.array([s.shape.radius if isinstance(s.shape, SolidCylinder) else 0.0
                                 for s in (solids[i] for i in self._lines)])  # fmt: skip
        self._centre = np.array([solids[i].centre for i in self._balls]).reshape(-1, 3)
        self._reach = np.array([solids[i].reach for i in self._balls])

    def near(self, lamp: Lamp, to_lamp: Single) -> Iterator[tuple[int, IntArray]]:
        """Yield solids with the points that have a ray to a lamp near the solid.

        The ray l from a point to the lamp at O passes the line (u, w) at the distance
        l . (u x (O - w)) / |l x u|, and the ball about c at |l x (O - c)| / |l|.
        """
        l2 = np.einsum("in,in->n", to_lamp, to_lamp)
        spare = lamp.radius + _SPARE
        moment = np.cross(self._u, lamp.position - self._w).astype(np.float32) @ to_lamp
        along = self._u.astype(np.float32) @ to_lamp
        limit = ((self._radius + spare) ** 2).astype(np.float32)[:, None]
        close = moment * moment < limit * (l2 - along * along + np.float32(1e-6) * l2)
        for row in np.flatnonzero(close.any(axis=1)):
            yield self._lines[row], np.flatnonzero(close[row])
        lamp_from_centre = lamp.position - self._centre
        along = lamp_from_centre.astype(np.float32) @ to_lamp
        excess = np.sum(lamp_from_centre**2, axis=1) - (self._reach + spare) ** 2
        close = excess.astype(np.float32)[:, None] * l2 < along * along
        for row in np.flatnonzero(close.any(axis=1)):
            yield self._balls[row], np.flatnonzero(close[row])


def seen_of_lamp(
    lamp: Lamp, P: Single, occluders: Occluders, solid_of_point: IntArray | int = -1
) -> Single:
    """Return the share of a lamp that is visible from points past solids, (n,).

    The half-shadow is modelled by a straight edge: it rises smoothly from 0 to 1 over the apparent
    size of the lamp. The shadow of a box or a mesh is hard.
    """
    share_of_lamp = np.ones(P.shape[1], dtype=np.float32)
    solid_of_point = np.broadcast_to(solid_of_point, share_of_lamp.shape)
    position = lamp.position.astype(np.float32)[:, None]
    for start in range(0, P.shape[1], _CHUNK):
        points = P[:, start : start + _CHUNK]
        to_lamp = position - points
        owners = solid_of_point[start : start + _CHUNK]
        for i, some in occluders.near(lamp, to_lamp):
            some = some[owners[some] != i]
            if len(some):
                share = _past(
                    occluders.solids[i], lamp, points.take(some, axis=1), to_lamp.take(some, axis=1)
                )
                share_of_lamp[start + some] *= share
    return share_of_lamp


def _past(solid: SolidInView, lamp: Lamp, P: Single, to_lamp: Single) -> Single:
    """Return the share of the lamp seen past a solid."""
    shape = solid.shape
    if isinstance(shape, SolidCylinder):
        return _past_cylinder(solid, shape, lamp, P, to_lamp)
    if isinstance(shape, Sphere):
        return _past_sphere(solid, shape, lamp, P, to_lamp)
    if isinstance(shape, Box):
        return _past_box(solid, shape, P, to_lamp)
    return np.float32(1.0) - is_hidden(solid, shape, P, lamp.position)


def _past_cylinder(
    solid: SolidInView, shape: SolidCylinder, lamp: Lamp, P: Single, to_lamp: Single
) -> Single:
    R = solid.R.T.astype(np.float32)
    qx, qy, qz = R @ (P - solid.w.astype(np.float32)[:, None])
    lx, ly, lz = R @ to_lamp
    # The part of the ray between the planes of the caps.
    safe = np.where(np.abs(lz) < _TINY, np.float32(_TINY), lz)
    t1, t2 = (-0.5 * shape.length - qz) / safe, (0.5 * shape.length - qz) / safe
    first = np.minimum(np.maximum(np.minimum(t1, t2), 0.0), 1.0)
    last = np.minimum(np.maximum(np.maximum(t1, t2), 0.0), 1.0)
    # Closest approach to the axis there.
    t = -(qx * lx + qy * ly) / np.maximum(lx * lx + ly * ly, _TINY)
    t = np.minimum(np.maximum(t, first), last)
    px, py = qx + t * lx, qy + t * ly
    gap = np.sqrt(px * px + py * py) - shape.radius
    return np.where(last > first, _half_shadow(gap, t, lamp), np.float32(1.0))


def _past_sphere(
    solid: SolidInView, shape: Sphere, lamp: Lamp, P: Single, to_lamp: Single
) -> Single:
    q = P - solid.w.astype(np.float32)[:, None]
    l2 = np.maximum(np.einsum("in,in->n", to_lamp, to_lamp), _TINY)
    t = np.clip(-np.einsum("in,in->n", q, to_lamp) / l2, 0.0, 1.0)
    q += t * to_lamp
    gap = np.sqrt(np.einsum("in,in->n", q, q)) - shape.radius
    return _half_shadow(gap, t, lamp)


def _past_box(solid: SolidInView, shape: Box, P: Single, to_lamp: Single) -> Single:
    """Return the share of the lamp seen past a box: all or nothing."""
    R = solid.R.T.astype(np.float32)
    q, l = R @ (P - solid.w.astype(np.float32)[:, None]), R @ to_lamp  # noqa: E741
    first = np.zeros(P.shape[1], dtype=np.float32)
    last = np.ones(P.shape[1], dtype=np.float32)
    for axis in range(3):
        d = np.where(l[axis] == 0.0, np.float32(_TINY), l[axis])
        a, b = (-0.5 * shape.size[axis] - q[axis]) / d, (0.5 * shape.size[axis] - q[axis]) / d
        np.maximum(first, np.minimum(a, b), out=first)
        np.minimum(last, np.maximum(a, b), out=last)
    return (first >= last).astype(np.float32)


def _half_shadow(gap: Single, t: Single, lamp: Lamp) -> Single:
    """Return the share of the lamp past an edge: the ray misses it by a gap, t of the way."""
    width = t * np.float32(lamp.radius) + np.float32(_SMALLEST)
    # A surface that coincides with the surface of the points does not shade it.
    share = np.clip((gap + np.float32(_SMALLEST)) / width * 0.5 + 0.5, 0.0, 1.0)
    return np.asarray(share * share * (3.0 - 2.0 * share))


@dataclass(frozen=True, eq=False)
class Lighting:
    """The light of a view, in the camera frame."""

    lamps: tuple[Lamp, ...]
    up: Array  # (3,) away from the floor
    look: Appearance  # ambient light, factors on the properties of materials, colour


def shade(
    solid: SolidInView,
    x: Single,
    y: Single,
    z: Single,
    face: Faces,
    light: Lighting,
    ink: Single | None = None,
) -> tuple[Single, Single, list[Single], list[BoolArray]]:
    """Return the light that points of a solid send to the camera, as VisibleSolid has it."""
    material = solid.material
    P = np.stack([x * z, y * z, z])
    n = normals(solid, P, face)
    to_eye = -1.0 / np.sqrt(x * x + y * y + 1.0)
    vx, vy, vz = x * to_eye, y * to_eye, to_eye
    facing = np.clip(n[0] * vx + n[1] * vy + n[2] * vz, 0.0, 1.0)
    albedo = np.full(len(x), material.albedo, dtype=np.float32)
    if ink is not None:
        albedo *= ink
    limb = material.limb * light.look.limb
    if limb:
        albedo *= 1.0 - limb + limb * facing
    if texture := material.texture * light.look.texture:
        local = solid.R.T.astype(np.float32) @ (P - solid.w.astype(np.float32)[:, None])
        pattern = mottled(np.asarray(local, dtype=np.float32))
        albedo *= np.maximum(1.0 + texture * pattern, 0.05)
    gloss = material.specular * light.look.specular
    upx, upy, upz = light.up.tolist()
    up = n[0] * upx + n[1] * upy + n[2] * upz
    even = light.look.ambient * (0.8 + 0.2 * up) if light.lamps else np.float32(light.look.ambient)
    mirror = None
    if gloss > _SHARP:
        of_eye = vx * upx + vy * upy + vz * upz
        sky = np.clip(0.5 + 0.5 * (2.0 * facing * up - of_eye), 0.0, 1.0)
        mirror = (gloss * light.look.ambient) * (0.2 + 3.0 * sky**4)
    fixed = _channels(albedo * even, mirror, material.tint, light)
    of_lamp, faces_lamp = [], []
    for lamp in light.lamps:
        lx, ly, lz = (float(lamp.position[i]) - P[i] for i in range(3))
        l2 = lx * lx + ly * ly + lz * lz
        shrink = 1.0 / np.sqrt(l2)
        cosine = (n[0] * lx + n[1] * ly + n[2] * lz) * shrink
        lit = np.maximum(cosine, 0.0) * (lamp.power / l2)
        glint = None
        if gloss:
            of_eye = (vx * lx + vy * ly + vz * lz) * shrink
            half = (cosine + facing) / np.sqrt(np.maximum(2.0 + 2.0 * of_eye, 1e-6))
            glint = np.exp((half - 1.0) * material.shininess) * (gloss * lamp.power / l2)
            glint *= np.minimum(np.maximum(cosine, 0.0) * 8.0, 1.0)  # none beyond the terminator
        of_lamp.append(_channels(albedo * lit, glint, material.tint, light))
        faces_lamp.append(cosine > 0.0)
    return P, fixed, of_lamp, faces_lamp


def _channels(
    scattered: Single, mirrored: Single | None, tint: Sequence[float], light: Lighting
) -> Single:
    """Return the channels: scattered light takes the colour of the surface, mirrored does not."""
    if not light.look.colour:
        return (scattered if mirrored is None else scattered + mirrored)[None]
    bgr = np.array(tint[::-1], dtype=np.float32)[:, None] * scattered
    return bgr if mirrored is None else bgr + mirrored


class CoarseSurface:
    """A large surface: the points of it that are traced."""

    def __init__(self, rays: PixelRays, pixels: IntArray, z: Single) -> None:
        is_traced = np.zeros((rays.height, rays.width), dtype=np.bool_)
        is_traced[_STEP // 2 :: _STEP, _STEP // 2 :: _STEP] = True
        traced = np.flatnonzero(is_traced.ravel()[pixels])
        x, y, depth = rays.x[pixels[traced]], rays.y[pixels[traced]], z[traced]
        i, j = np.divmod(pixels[traced], rays.width)
        self._rays = rays
        self._where = i // _STEP, j // _STEP
        self._P: Single = np.stack([x * depth, y * depth, depth])

    def seen(self, lamp: Lamp, occluders: Occluders, solid: int = -1) -> Single:
        """Return the share of a lamp that is visible from the surface, (width * height,)."""
        shape = -(-self._rays.height // _STEP), -(-self._rays.width // _STEP)
        share, is_traced = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        share[self._where] = seen_of_lamp(lamp, self._P, occluders, solid)
        is_traced[self._where] = 1.0
        around = cv2.blur(is_traced, (3, 3))
        spread = np.divide(
            cv2.blur(share, (3, 3)), around, out=np.ones_like(share), where=around > 0.05
        )
        share = np.where(is_traced > 0.0, share, spread)
        share = np.asarray(cv2.GaussianBlur(share, (3, 3), 0.0), np.float32)  # contacts show steps
        fine = cv2.resize(share, None, fx=_STEP, fy=_STEP, interpolation=cv2.INTER_LINEAR)
        whole = fine[: self._rays.height, : self._rays.width]
        return np.ascontiguousarray(whole, dtype=np.float32).ravel()


@dataclass(frozen=True, eq=False)
class VisibleSolid:
    """The visible part of one solid, and the light from its points by where it comes from."""

    solid: int  # the solid, as an index
    pixels: IntArray  # (n_pixels,) its pixels, ascending
    # (n_pixels,) the first point of each pixel where a pixel has several
    first: IntArray | None
    P: Single  # (3, n) the points in the camera frame [m]
    fixed: Single  # (n_channels, n) light that shadows do not affect
    of_lamp: list[Single]  # (n_channels, n) the light of each lamp, without shadows
    faces_lamp: list[BoolArray]  # (n,) whether the surface faces the lamp

    def faces(self, lamp: int) -> BoolArray:
        """Return a mask (n_pixels,) of the pixels where the surface faces a lamp."""
        faces = self.faces_lamp[lamp]
        return faces if self.first is None else np.logical_or.reduceat(faces, self.first)

    def radiance(self, shares: Sequence[Single | None], n_terms: int) -> Single:
        """Return the light summed over points, (n_terms, n_channels, n_pixels)."""
        lit = [
            light if share is None else light * self._spread(share)
            for light, share in zip(self.of_lamp, shares, strict=True)
        ]
        fixed = self.fixed
        terms = np.stack([fixed, *lit]) if n_terms > 1 else np.asarray(sum(lit, fixed))[None]
        if self.first is None:
            return terms
        return np.asarray(np.add.reduceat(terms, self.first, axis=-1))

    def _spread(self, share: Single) -> Single:
        """Return the shares of pixels, repeated for all of their points."""
        if self.first is None:
            return share
        return np.repeat(share, np.diff(self.first, append=self.P.shape[1]))


def shares_of_lamps(
    parts: Sequence[VisibleSolid], lamps: Sequence[Lamp], occluders: Occluders, rays: PixelRays
) -> list[list[Single | None]]:
    """Return the visible share of each lamp for each part, by part and lamp.

    A pixel with several points is traced from the first point. Where a solid fills many pixels,
    only some of them are traced.
    """
    shares_by_part: list[list[Single | None]] = [[] for _ in parts]
    for k, lamp in enumerate(lamps):
        if not lamp.shadows:
            for shares in shares_by_part:
                shares.append(None)
            continue
        lit = [np.flatnonzero(part.faces(k)) for part in parts]
        points = [
            part.P[:, some if part.first is None else part.first[some]]
            for part, some in zip(parts, lit, strict=True)
        ]
        small = [len(some) <= _LARGE for some in lit]
        together = [P for P, is_small in zip(points, small, strict=True) if is_small]
        owners = [np.full(P.shape[1], p.solid) for p, P in zip(parts, points, strict=True)]
        small_owners = [o for o, is_small in zip(owners, small, strict=True) if is_small]
        traced_shares = np.ones(0, dtype=np.float32)
        if together:
            P = np.concatenate(together, axis=1)
            traced_shares = seen_of_lamp(lamp, P, occluders, np.concatenate(small_owners))
        start = 0
        for part, some, P, is_small, shares in zip(
            parts, lit, points, small, shares_by_part, strict=True
        ):
            share = np.ones(len(part.pixels), dtype=np.float32)
            if is_small:
                share[some] = traced_shares[start : start + len(some)]
                start += len(some)
            else:
                pixels = part.pixels[some]
                surface = CoarseSurface(rays, pixels, P[2])
                share[some] = surface.seen(lamp, occluders, part.solid).take(pixels)
            shares.append(share)
    return shares_by_part


_TABLE = Material(albedo=0.22, specular=0.06, shininess=12.0, limb=0.0, texture=0.08,
                  tint=(1.15, 1.0, 0.85))  # fmt: skip
_CABLE = Material(albedo=0.04, specular=0.15, shininess=15.0, limb=0.2)

_UP = np.array([0.0, 0.0, 1.0])  # in the base frame, for lamps and tables

_TIE = 1.0 - 3e-6  # minimum ratio of depths of coincident surfaces
_THIN = 3.0  # [px] maximum width of solids that rays through pixel centres may miss
_PIXELS = 8192  # pixels on edges painted at a time
_SHADED = 3  # one in so many of a pixel's rays that meet a solid is shaded
_FACES = 8  # number of faces distinguished in the search for edges


def _around(placed: Sequence[PlacedSolid]) -> tuple[Array, float]:
    """Return the middle and the radius of a sphere around solids; a unit sphere around nothing."""
    if not placed:
        return np.zeros(3), 1.0
    spheres = [(p.T_base_solid, *holding_sphere(p.solid.shape)) for p in placed]
    middles = np.array([T.apply(middle) for T, middle, _ in spheres])
    reaches = np.array([reach for _, _, reach in spheres])
    low, high = (middles - reaches[:, None]).min(axis=0), (middles + reaches[:, None]).max(axis=0)
    centre = 0.5 * (low + high)
    return centre, float((np.linalg.norm(middles - centre, axis=1) + reaches).max())


def _table(
    placed: Sequence[PlacedSolid], centre: Array, radius: float, eye: Array
) -> tuple[PlacedSolid, ...]:
    """Return a table right below the lowest solid; none where it would hide the machine."""
    lowest = min((_lowest(p, _UP) for p in placed), default=-radius)
    if float(eye @ _UP) <= lowest:
        return ()
    size = 4.0 * radius, 3.2 * radius, 0.06 * radius
    foot = centre + (lowest - float(centre @ _UP) - 0.5 * size[2]) * _UP
    T = RigidTransform.from_components(foot, Rotation.from_euler("z", 0.3))
    return (_placed(Box(size), T, _TABLE),)


def _lowest(placed: PlacedSolid, up: Array) -> float:
    """Return the height of the lowest point of a solid."""
    return float((placed.T_base_solid.apply(triangles(placed.solid.shape).vertices) @ up).min())


def _piece(
    centre: Array,
    radius: float,
    camera: Camera,
    T_base_camera: RigidTransform,
    rng: np.random.Generator,
) -> PlacedSolid:
    """Return a rod, box or ball behind the machine, somewhere in the picture."""
    depth = float(T_base_camera.inv().apply(centre)[2])
    pixel = rng.uniform([-0.05, -0.05], [1.05, 1.05]) * [camera.width, camera.height]
    xy = camera.undistort(np.clip(pixel, 0.0, [camera.width - 1.0, camera.height - 1.0])[None])[0]
    z = max(depth, 0.0) + radius * rng.uniform(1.6, 5.0)
    size = radius * rng.uniform(0.2, 1.0) * (z / max(depth, radius))
    kind = rng.choice(3, p=[0.5, 0.4, 0.1])
    shape: Shape
    if kind == 0:
        shape = SolidCylinder(size * rng.uniform(0.03, 0.15), size * rng.uniform(1.5, 4.0))
    elif kind == 1:
        a, b, c = (size * rng.uniform(0.3, 1.2, 3)).tolist()
        shape = Box((a, b, c))
    else:
        shape = Sphere(0.3 * size)
    z += holding_sphere(shape)[1]
    turn = (
        Rotation.random(rng=rng) if kind == 0 else Rotation.from_euler("z", rng.uniform(0.0, 7.0))
    )
    position = T_base_camera.apply(z * np.array([xy[0], xy[1], 1.0]))
    material = Material(
        albedo=float(rng.uniform(0.05, 0.7)),
        specular=float(rng.choice([0.05, 0.15, 0.6])),
        shininess=float(rng.uniform(10.0, 60.0)),
        limb=float(rng.uniform(0.1, 0.4)),
        texture=float(rng.uniform(0.0, 0.2)),
        tint=_tint(rng),
    )
    return _placed(shape, RigidTransform.from_components(position, turn), material)


def _cable(
    centre: Array, radius: float, T_base_camera: RigidTransform, rng: np.random.Generator
) -> PlacedSolid:
    """Return a thin dark cylinder that crosses the picture between camera and machine."""
    eye = T_base_camera.translation
    way = centre - eye
    distance = float(np.linalg.norm(way))
    t = rng.uniform(0.45, 0.9) * max(1.0 - radius / distance, 0.3)
    width = radius * t
    aside = T_base_camera.rotation.apply([*rng.uniform(-0.8, 0.8, 2), 0.0])
    turn = T_base_camera.rotation * Rotation.from_euler(
        "xz", [np.pi / 2 + rng.uniform(-0.3, 0.3), rng.uniform(0.0, np.pi)]
    )
    position = eye + t * way + width * aside
    shape = SolidCylinder(width * rng.uniform(0.006, 0.02), 6.0 * width)
    return _placed(shape, RigidTransform.from_components(position, turn), _CABLE)


def _placed(shape: Shape, T: RigidTransform, material: Material) -> PlacedSolid:
    """Return a placed solid outside the machine."""
    return PlacedSolid(Solid(None, shape, T, material), T)


def _tint(rng: np.random.Generator) -> tuple[float, float, float]:
    """Return a colour of mean 1."""
    rgb = rng.uniform(0.5, 1.0, 3) ** 1.5
    r, g, b = (3.0 * rgb / rgb.sum()).tolist()
    return r, g, b


def develop(
    radiance: Single, appearance: Appearance, rng: np.random.Generator, fineness: int = 1
) -> Image:
    """Return the image of a radiance: lens, saturation, noise, processing, rounding.

    The radiance is sampled ``fineness`` times a pixel along rows and columns.
    """
    camera = appearance.pipeline
    exposed = radiance * np.float32(appearance.exposure)
    light = camera.through_lens(exposed, appearance.blur, fineness)
    counts = camera.counted(light, appearance.electrons, appearance.read_noise, rng)
    level = camera.processed(counts, appearance.gamma)
    level *= 255.0 if appearance.bits == 8 else 65535.0
    level += 0.5
    return level.astype(np.uint8 if appearance.bits == 8 else np.uint16)


@dataclass(frozen=True, eq=False)
class FrameBuffer:
    """A picture being painted."""

    z: Single  # (n,) depth at every pixel's centre [m]; infinite for the background
    # (n_terms, n_channels, n) radiance: the sum, or separately the light without shadows and the
    # light of each lamp
    terms: Single


class Painter:
    """Paints solids with one light and one camera."""

    def __init__(self, rays: PixelRays, light: Lighting, samples: int) -> None:
        self.rays, self.light, self.samples = rays, light, samples

    def paint(
        self,
        canvas: FrameBuffer,
        solids: Sequence[SolidInView],
        bystanders: Sequence[SolidInView] = (),
    ) -> None:
        """Paint solids over a picture where they are in front of its surfaces."""
        behind = canvas.z.copy()
        occluders = Occluders([*solids, *bystanders])
        feet = [footprint(self.rays, solid) for solid in solids]
        key, face = self._first_hits(canvas.z, solids, feet)
        edge = self._edges(key, solids, feet)
        on_edge = np.flatnonzero(edge)
        near = self._near_edges(key, on_edge, solids, feet)
        parts = []
        for i, (solid, foot) in enumerate(zip(solids, feet, strict=True)):
            inside = foot[(key[foot] // _FACES == i + 1) & ~edge[foot]]
            if len(inside):
                x, y = self.rays.x.take(inside), self.rays.y.take(inside)
                ink = printed_inside(solid, self.rays, inside, face[inside], self.samples)
                shaded = shade(solid, x, y, canvas.z[inside], face[inside], self.light, ink)
                parts.append(VisibleSolid(i, inside, None, *shaded))
        lamp_shares = shares_of_lamps(parts, self.light.lamps, occluders, self.rays)
        for part, shares in zip(parts, lamp_shares, strict=True):
            canvas.terms[:, :, part.pixels] = part.radiance(shares, len(canvas.terms))
        del key, face, parts, lamp_shares
        for start in range(0, len(on_edge), _PIXELS):
            pixels = on_edge[start : start + _PIXELS]
            shown = near[:, start : start + _PIXELS]
            self._paint_edge(canvas, pixels, behind[pixels], solids, shown, occluders)

    def _first_hits(
        self, z: Single, solids: Sequence[SolidInView], feet: Sequence[IntArray]
    ) -> tuple[NDArray[np.uint16], NDArray[np.int32]]:
        """Return for every pixel's centre a key of solid and face (0: none), and the face."""
        key = np.zeros(len(z), dtype=np.uint16)
        faces = np.zeros(len(z), dtype=np.int32)
        for i, (solid, foot) in enumerate(zip(solids, feet, strict=True)):
            depth, face = intersect(solid, self.rays.x.take(foot), self.rays.y.take(foot))
            closer = np.flatnonzero(depth < z.take(foot) * np.float32(_TIE))
            pixels = foot[closer]
            z[pixels], faces[pixels] = depth[closer], face[closer]
            key[pixels] = _FACES * (i + 1)
            if not isinstance(solid.shape, Mesh):
                key[pixels] += face[closer].astype(np.uint16)
        return key, faces

    def _edges(
        self, key: NDArray[np.uint16], solids: Sequence[SolidInView], feet: Sequence[IntArray]
    ) -> BoolArray:
        """Return the pixels that an edge of a painted surface may cross.

        A straight edge through a pixel separates its centre from the centre of a neighbour.
        """
        picture = key.reshape(self.rays.height, self.rays.width)
        cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
        edge = (cv2.dilate(picture, cross) != cv2.erode(picture, cross)).ravel()
        for solid, foot in zip(solids, feet, strict=True):
            if self._is_thin(solid):
                edge[foot] = True
        return np.asarray(edge, dtype=np.bool_)

    def _near_edges(
        self,
        key: NDArray[np.uint16],
        on_edge: IntArray,
        solids: Sequence[SolidInView],
        feet: Sequence[IntArray],
    ) -> BoolArray:
        """Return a mask (n_solids, n) of solids that pixels may show: the solids of pixels around.

        Thin solids may be anywhere in their footprints.
        """
        rows, columns = np.divmod(on_edge, self.rays.width)
        above, below = np.maximum(rows - 1, 0), np.minimum(rows + 1, self.rays.height - 1)
        left, right = np.maximum(columns - 1, 0), np.minimum(columns + 1, self.rays.width - 1)
        shown = np.zeros((len(solids) + 1, len(on_edge)), dtype=np.bool_)
        indices = np.arange(len(on_edge))
        for row in (above, rows, below):
            for column in (left, columns, right):
                shown[key.take(row * self.rays.width + column) // _FACES, indices] = True
        for solid, foot, on_solid in zip(solids, feet, shown[1:], strict=True):
            if self._is_thin(solid):
                on_solid |= np.isin(on_edge, foot, assume_unique=True)
        return shown[1:]

    def _is_thin(self, solid: SolidInView) -> bool:
        """Return whether rays through the centres of pixels may miss a solid."""
        if isinstance(solid.shape, Mesh):
            return False
        farthest = float(solid.centre[2]) + solid.reach
        thickness = float(triangles(solid.shape).extents.min())
        return thickness * float(self.rays.camera.K[0, 0]) < _THIN * farthest

    def _paint_edge(
        self,
        canvas: FrameBuffer,
        pixels: IntArray,
        behind: Single,
        solids: Sequence[SolidInView],
        shown: BoolArray,
        occluders: Occluders,
    ) -> None:
        """Average many rays in each of some pixels, with the solids that each may show.

        ``behind`` is the depth before painting.
        """
        n, S = len(pixels), self.samples
        X, Y = self.rays.within(pixels, S)
        X, Y = X.ravel(), Y.ravel()
        Z = np.repeat(behind, S)
        solid_of_ray = np.zeros(n * S, dtype=np.uint16)
        faces = np.zeros(n * S, dtype=np.int32)
        one_pixel = np.arange(S)
        touched = []
        for i in np.flatnonzero(shown.any(axis=1)).tolist():
            rays = (np.flatnonzero(shown[i])[:, None] * S + one_pixel).ravel()
            depth, face = intersect(solids[i], X.take(rays), Y.take(rays))
            closer = np.flatnonzero(depth < Z.take(rays) * np.float32(_TIE))
            if len(closer):
                hit_rays = rays.take(closer)
                Z[hit_rays], solid_of_ray[hit_rays], faces[hit_rays] = (
                    depth.take(closer),
                    i + 1,
                    face.take(closer),
                )
                touched.append((i, rays))
        uncovered = np.count_nonzero(solid_of_ray.reshape(n, S) == 0, axis=1) / S
        total = canvas.terms[:, :, pixels] * uncovered.astype(np.float32)
        parts, weights = [], []
        for i, rays in touched:
            hit_rays = rays[solid_of_ray.take(rays) == i + 1]
            if len(hit_rays):
                hit_rays, first, weight = _some_of_each(hit_rays, hit_rays // S)
                x, y, face = X.take(hit_rays), Y.take(hit_rays), faces.take(hit_rays)
                ink = printed(solids[i], x, y, face)
                shaded = shade(solids[i], x, y, Z.take(hit_rays), face, self.light, ink)
                parts.append(VisibleSolid(i, hit_rays[first] // S, first, *shaded))
                weights.append(weight)
        lamp_shares = shares_of_lamps(parts, self.light.lamps, occluders, self.rays)
        for part, shares, weight in zip(parts, lamp_shares, weights, strict=True):
            light = part.radiance(shares, len(canvas.terms))
            total[:, :, part.pixels] += light * (weight / np.float32(S))
        canvas.terms[:, :, pixels] = total


def _some_of_each(
    rays: IntArray, pixel: NDArray[np.intp]
) -> tuple[IntArray, NDArray[np.intp], Single]:
    """Return every third ray of each pixel, the start of each pixel's rays, and their weights.

    A surface's light varies little inside a pixel; many rays are needed for its edge only.
    """
    first = np.flatnonzero(np.diff(pixel, prepend=-1))
    count = np.diff(first, append=len(rays))
    kept = (np.arange(len(rays)) - np.repeat(first, count)) % _SHADED == 0
    n_kept = -(-count // _SHADED)
    return rays[kept], np.cumsum(n_kept) - n_kept, (count / n_kept).astype(np.float32)


@dataclass(frozen=True, eq=False)
class RenderedView:
    """A camera in front of its surroundings, painted once for all images of a view."""

    T_camera_base: RigidTransform  # pose of the base frame in the camera
    painter: Painter  # paints with the camera and the light
    canvas: FrameBuffer  # the surroundings, their light apart by lamp
    bystanders: tuple[SolidInView, ...]  # objects around that cast shadows on the machine
    foreground: tuple[SolidInView, ...]  # objects in front of it
    fineness: int  # parts of a pixel along rows and columns that are painted

    def render(self, placed: Sequence[PlacedSolid], rng: np.random.Generator) -> Image:
        """Return a photograph of solids in this scene."""
        rays = self.painter.rays
        solids = [*in_view(placed, self.T_camera_base), *self.foreground]
        canvas = FrameBuffer(self.canvas.z.copy(), self._backdrop(solids))
        self.painter.paint(canvas, solids, self.bystanders)
        radiance = canvas.terms[0].reshape(-1, rays.height, rays.width)
        grey = (
            radiance[0]
            if len(radiance) == 1
            else np.ascontiguousarray(np.moveaxis(radiance, 0, -1))
        )
        return develop(grey, self.painter.light.look, rng, self.fineness)

    def _backdrop(self, solids: Sequence[SolidInView]) -> Single:
        """Return the surroundings with the shadows of solids, (1, n_channels, n)."""
        total: Single = self.canvas.terms[0].copy()
        occluders = Occluders(solids)
        for lamp, light in zip(self.painter.light.lamps, self.canvas.terms[1:], strict=True):
            if lamp.shadows:
                total += light * self._around.seen(lamp, occluders)
            else:
                total += light
        return np.asarray(total[None])

    @cached_property
    def _around(self) -> CoarseSurface:
        """The surfaces on which the machine casts shadows; no lamp lights the background."""
        near = np.flatnonzero(np.isfinite(self.canvas.z))
        return CoarseSurface(self.painter.rays, near, self.canvas.z[near])


def prepare_view(
    placed: Sequence[PlacedSolid],
    camera: Camera,
    T_base_camera: RigidTransform,
    appearance: Appearance,
    rng: np.random.Generator,
) -> RenderedView:
    """Return the scene of a view: its surroundings drawn, lit and painted."""
    fineness = appearance.pipeline.fineness(appearance.blur, camera.width * camera.height)
    rays = pixel_rays(camera, fineness)
    samples = next(n for n in SAMPLES if n * fineness**2 >= appearance.samples)
    T_camera_base = T_base_camera.inv()
    centre, radius = _around(placed)
    floor = _table(placed, centre, radius, T_base_camera.translation) if appearance.table else ()
    clutter = [
        _piece(centre, radius, camera, T_base_camera, rng) for _ in range(appearance.clutter)
    ]
    cables = [_cable(centre, radius, T_base_camera, rng) for _ in range(appearance.cables)]
    light = _lighting(centre, radius, T_camera_base, appearance)
    painter = Painter(rays, light, samples)
    canvas = _empty(rays, light, rng)
    bystanders = in_view(clutter, T_camera_base)
    painter.paint(canvas, [*in_view(floor, T_camera_base), *bystanders])
    foreground = in_view(cables, T_camera_base)
    return RenderedView(
        T_camera_base, painter, canvas, tuple(bystanders), tuple(foreground), fineness
    )


def _lighting(
    centre: Array, radius: float, T_camera_base: RigidTransform, appearance: Appearance
) -> Lighting:
    """Return the light in the camera frame, its distances in radii of the machine."""
    lamps = []
    for light in appearance.lights:
        direction = np.array(light.direction) / np.linalg.norm(light.direction)
        distance = light.distance * radius
        if light.with_camera:
            direction = T_camera_base.rotation.inv().apply(direction * [1.0, -1.0, -1.0])
        position: Array = centre + distance * direction
        lamps.append(
            Lamp(
                position=np.asarray(T_camera_base.apply(position)),
                power=light.strength * distance**2,
                radius=light.radius * radius,
                shadows=light.shadows and appearance.shadows,
            )
        )
    return Lighting(tuple(lamps), np.asarray(T_camera_base.rotation.apply(_UP)), appearance)


def _empty(rays: PixelRays, light: Lighting, rng: np.random.Generator) -> FrameBuffer:
    """Return a frame buffer with the background only."""
    n, appearance = rays.width * rays.height, light.look
    n_channels = 3 if appearance.colour else 1  # blue, green, red
    terms = np.zeros((1 + len(light.lamps), n_channels, n), dtype=np.float32)
    terms[0] = appearance.background
    if appearance.background_contrast > 0.0:
        picture = background(rays.width, rays.height, appearance.background_contrast, rng)
        terms[0] *= picture.ravel()
    return FrameBuffer(np.full(n, np.inf, dtype=np.float32), terms)
