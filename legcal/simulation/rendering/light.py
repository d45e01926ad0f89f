"""Light on surfaces: the light of each lamp, and the shadows of solids."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.simulation.rendering.appearance import mottled
from legcal.simulation.rendering.rays import (
    Faces,
    PixelRays,
    Single,
    SolidInView,
    is_hidden,
    normals,
)
from legcal.simulation.solids import Box, SolidCylinder, Sphere

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
    """Return the share of the lamp seen past a cylinder."""
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
    """Return the share of the lamp seen past a sphere."""
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

    lamps: tuple[Lamp, ...]  # the lamps
    ambient: float  # radiance of a white surface by light from everywhere
    up: Array  # (3,) away from the floor
    limb: float  # limb, specular, texture: factors on the properties of materials
    specular: float
    texture: float
    colour: bool  # whether there are three channels

    @property
    def n_channels(self) -> int:
        """Number of channels: grey, or blue, green, red."""
        return 3 if self.colour else 1


@dataclass(frozen=True, eq=False)
class Shaded:
    """Light from points of a surface, apart by where it comes from."""

    P: Single  # (3, n) the points in the camera frame [m]
    fixed: Single  # (n_channels, n) light that shadows do not affect
    of_lamp: list[Single]  # (n_channels, n) the light of each lamp, without shadows
    faces_lamp: list[BoolArray]  # (n,) whether the surface faces the lamp


def shade(
    solid: SolidInView,
    x: Single,
    y: Single,
    z: Single,
    face: Faces,
    light: Lighting,
    ink: Single | None = None,
) -> Shaded:
    """Return the light that points of a solid send to the camera."""
    material = solid.material
    P = np.stack([x * z, y * z, z])
    n = normals(solid, P, face)
    to_eye = -1.0 / np.sqrt(x * x + y * y + 1.0)
    vx, vy, vz = x * to_eye, y * to_eye, to_eye
    facing = np.clip(n[0] * vx + n[1] * vy + n[2] * vz, 0.0, 1.0)
    albedo = np.full(len(x), material.albedo, dtype=np.float32)
    if ink is not None:
        albedo *= ink
    limb = material.limb * light.limb
    if limb:
        albedo *= 1.0 - limb + limb * facing
    if material.texture * light.texture:
        local = solid.R.T.astype(np.float32) @ (P - solid.w.astype(np.float32)[:, None])
        albedo *= np.maximum(
            1.0 + material.texture * light.texture * mottled(np.asarray(local, dtype=np.float32)),
            0.05,
        )
    gloss = material.specular * light.specular
    upx, upy, upz = light.up.tolist()
    up = n[0] * upx + n[1] * upy + n[2] * upz
    even = light.ambient * (0.8 + 0.2 * up) if light.lamps else np.float32(light.ambient)
    mirror = None
    if gloss > _SHARP:
        of_eye = vx * upx + vy * upy + vz * upz
        sky = np.clip(0.5 + 0.5 * (2.0 * facing * up - of_eye), 0.0, 1.0)
        mirror = (gloss * light.ambient) * (0.2 + 3.0 * sky**4)
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
    return Shaded(P, fixed, of_lamp, faces_lamp)


def _channels(
    scattered: Single, mirrored: Single | None, tint: Sequence[float], light: Lighting
) -> Single:
    """Return the channels: scattered light takes the colour of the surface, mirrored does not."""
    if not light.colour:
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
    """The visible part of one solid."""

    solid: int  # the solid, as an index
    pixels: IntArray  # (n_pixels,) its pixels, ascending
    shaded: Shaded  # the light from its points
    # (n_pixels,) the first point of each pixel where a pixel has several
    first: IntArray | None = None

    def faces(self, lamp: int) -> BoolArray:
        """Return a mask (n_pixels,) of the pixels where the surface faces a lamp."""
        faces = self.shaded.faces_lamp[lamp]
        return faces if self.first is None else np.logical_or.reduceat(faces, self.first)

    def radiance(self, shares: Sequence[Single | None], n_terms: int) -> Single:
        """Return the light summed over points, (n_terms, n_channels, n_pixels)."""
        lit = [
            light if share is None else light * self._spread(share)
            for light, share in zip(self.shaded.of_lamp, shares, strict=True)
        ]
        fixed = self.shaded.fixed
        terms = np.stack([fixed, *lit]) if n_terms > 1 else np.asarray(sum(lit, fixed))[None]
        if self.first is None:
            return terms
        return np.asarray(np.add.reduceat(terms, self.first, axis=-1))

    def _spread(self, share: Single) -> Single:
        """Return the shares of pixels, repeated for all of their points."""
        if self.first is None:
            return share
        return np.repeat(share, np.diff(self.first, append=self.shaded.P.shape[1]))


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
        points = [_traced(part, some) for part, some in zip(parts, lit, strict=True)]
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


def _traced(part: VisibleSolid, some: IntArray) -> Single:
    """Return a point of each of some pixels, (3, n)."""
    return part.shaded.P[:, some if part.first is None else part.first[some]]
