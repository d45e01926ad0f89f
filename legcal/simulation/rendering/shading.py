"""How much light a surface sends to the camera."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array, BoolArray
from legcal.simulation.rendering.intersect import normals
from legcal.simulation.rendering.rays import Faces, Single
from legcal.simulation.rendering.shadows import Lamp
from legcal.simulation.rendering.solid_in_view import SolidInView
from legcal.simulation.rendering.texture import mottled

_SHARP = 0.3  # strength of highlights from which a surface mirrors its surroundings


@dataclass(frozen=True, eq=False)
class Lighting:
    """The light of a view, in the camera frame.

    Attributes
    ----------
    lamps : tuple of Lamp
        The lamps.
    ambient : float
        Radiance of a white surface by light from everywhere.
    up : (3,) array
        Away from the floor.
    limb, specular, texture : float
        Factors on what the materials say.
    colour : bool
        Whether there are three channels.
    """

    lamps: tuple[Lamp, ...]
    ambient: float
    up: Array
    limb: float
    specular: float
    texture: float
    colour: bool

    @property
    def n_channels(self) -> int:
        """Number of channels: grey, or blue, green, red."""
        return 3 if self.colour else 1


@dataclass(frozen=True, eq=False)
class Shaded:
    """Light from points of a surface, apart by where it comes from.

    Attributes
    ----------
    P : (3, n) array
        The points in the camera frame [m].
    fixed : (n_channels, n) array
        What no shadow takes away.
    of_lamp : list of (n_channels, n) array
        The light of each lamp, without shadows.
    faces_lamp : list of (n,) array of bool
        Whether the surface faces the lamp.
    """

    P: Single
    fixed: Single
    of_lamp: list[Single]
    faces_lamp: list[BoolArray]


def shade(
    solid: SolidInView,
    x: Single,
    y: Single,
    z: Single,
    face: Faces,
    light: Lighting,
    ink: Single | None = None,
) -> Shaded:
    """Return the light that points of a solid send to the camera.

    Parameters
    ----------
    solid : SolidInView
        The solid.
    x, y, z, face : (n,) array
        Rays (x, y, 1), depths [m] and faces.
    light : Lighting
        The light.
    ink : (n,) array, optional
        Factors of the albedo by what is printed on the solid.
    """
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
