"""Rendered pictures of single cylinders whose outlines are known exactly.

A cylinder in any direction, lit by one lamp from somewhere and by light from everywhere, before a
plain or sloped background; material, light, background, lens, sensor and width are drawn anew.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array, Image
from legcal.simulation.rendering.appearance import Appearance, Light
from legcal.simulation.rendering.rays import divided, in_view
from legcal.simulation.rendering.scene import FrameBuffer, develop, prepare_view
from legcal.simulation.solids import Material, PlacedSolid, Solid, SolidCylinder
from legcal.vision.camera import Camera
from legcal.vision.cylinder import EPSILON, outlines_of_axis
from legcal.vision.image_file import Grey
from legcal.vision.visibility import Band, bands_of_legs

PHOTOGRAPHS = 3  # of every scene
FINE = 3  # times as many pixels are rendered in every row, so that the lens blurs before they count
DEEP = 2.5  # from the outline, where the contrast is read [px] and blurs
WIDTHS = (12.0, 25.0, 60.0, 200.0)
BLURS = (0.35, 0.6, 1.0, 1.8)  # at most a twelfth of the width
GAMMAS = (1.0, 2.2, -2.2)  # negative: not told
ELECTRONS = (40_000.0, 8_000.0, 1_500.0)
LIGHTS = ("front", "side", "rim")
BACKGROUNDS = ("dark", "bright", "like the leg")


@dataclass(frozen=True, eq=False)
class Looks:
    """What is drawn for a scene.

    Attributes
    ----------
    width : float
        Of the cylinder in the middle of the picture [px].
    blur : float
        Of the lens [px]; that of the pixels comes on top.
    gamma : float
        Of the camera; negative if legcal is not given it.
    electrons : float
        Of a pixel at full scale.
    bits : int
        8 or 16.
    light, background : str
        Where the lamp stands, and how bright it is behind.
    """

    width: float
    blur: float
    gamma: float
    electrons: float
    bits: int
    light: str
    background: str


@dataclass(frozen=True, eq=False)
class Photographed:
    """A scene, its photographs and the truth.

    Attributes
    ----------
    looks : Looks
        How it looks.
    images : list of array
        Photographs that differ by their noise.
    camera : Camera
        The camera.
    band : Band
        The frame along the cylinder.
    v : (2, 2) array
        True offsets of edge 1 and 2 at both ends of the band [px].
    contrast : (2,) array
        From the background to the leg at both edges [grey levels].
    """

    looks: Looks
    images: list[Image]
    camera: Camera
    band: Band
    v: Array
    contrast: Array


def draw_looks(rng: np.random.Generator) -> Looks:
    """Draw how a scene looks."""
    width = float(rng.choice(WIDTHS))
    return Looks(
        width,
        float(rng.choice([blur for blur in BLURS if 12.0 * blur <= width])),
        float(rng.choice(GAMMAS)),
        float(rng.choice(ELECTRONS)),
        int(rng.choice([8, 16])),
        str(rng.choice(LIGHTS)),
        str(rng.choice(BACKGROUNDS)),
    )


def photograph(looks: Looks, rng: np.random.Generator, times: int = PHOTOGRAPHS) -> Photographed:
    """Render a scene and photograph it."""
    side = 240 if looks.width < 100.0 else 360
    focal = 1.6 * side
    camera = Camera(
        np.array([[focal, 0.0, 0.5 * side], [0.0, focal, 0.5 * side], [0.0, 0.0, 1.0]]),
        side,
        side,
        np.array([rng.uniform(-0.15, 0.1), 0.03, 0.0, 0.0, 0.0]),
        gamma=max(looks.gamma, 1.0),
    )
    radius = 0.01
    distance = 2.0 * radius * focal / looks.width
    angle, tilt = rng.uniform(0.0, np.pi), rng.uniform(-0.6, 0.6)
    u = np.array([np.cos(angle) * np.cos(tilt), np.sin(angle) * np.cos(tilt), np.sin(tilt)])
    across = np.array([-np.sin(angle), np.cos(angle), 0.0])
    middle = np.array([0.0, 0.0, distance]) + across * rng.uniform(-0.08, 0.08) * distance
    reach = 0.9 * distance
    A, B = middle - reach * u, middle + reach * u
    ends = np.array([[0.0], [2.0 * reach]])
    (band,) = bands_of_legs(camera, A[None], B[None], *ends)
    if band is None:
        raise ValueError("the camera misses the cylinder")
    h = outlines_of_axis(u[None], middle[None], radius)[0]
    v = band.offsets(h[:, None, :], np.array([0.0, band.length]))
    material = Material(
        albedo=rng.uniform(0.15, 0.8),
        specular=rng.choice([0.0, 0.1, 0.4]),
        shininess=rng.choice([8.0, 40.0, 120.0]),
        limb=rng.choice([0.0, 0.3, 0.7]),
    )
    spread = {"front": (0.0, 0.5), "side": (0.7, 1.3), "rim": (1.5, 2.1)}[looks.light]
    away, around = rng.uniform(*spread), rng.uniform(0.0, 2.0 * np.pi)
    lamp = Light(
        (np.sin(away) * np.cos(around), np.sin(away) * np.sin(around), np.cos(away)),
        with_camera=True,
        strength=1.0,
        shadows=False,
    )
    appearance = Appearance.clean(
        lights=(lamp,), ambient=rng.uniform(0.05, 0.4), limb=1.0, specular=1.0, background=0.0,
        electrons=looks.electrons, read_noise=12.0, bits=looks.bits,
        gamma=abs(looks.gamma),
    )  # fmt: skip
    towards = Rotation.align_vectors(u[None], np.array([[0.0, 0.0, 1.0]]))[0]
    pose = RigidTransform.from_components(middle, towards)
    solid = PlacedSolid(
        Solid(None, SolidCylinder(radius, 2.0 * reach), RigidTransform.identity(), material),
        pose,
    )
    dark, bright = (
        _radiance(solid, camera, replace(appearance, background=level, samples=21))
        for level in (0.0, 1.0)
    )
    free = bright - dark  # share of each pixel that shows the background
    behind = _background(looks.background, dark, free, rng)
    light = _through_lens(dark + free * behind, looks.blur)
    light *= np.float32(rng.uniform(0.5, 0.95) / np.quantile(light, 0.98))
    images = [develop(light.copy(), appearance, rng) for _ in range(times)]
    plain = replace(appearance, electrons=np.inf, bits=16)
    contrast = _contrasts(
        grey_levels(develop(light.copy(), plain, rng)), camera, band, v, looks.blur
    )
    told = replace(camera, gamma=1.0) if looks.gamma < 0.0 else camera
    return Photographed(looks, images, told, band, v, contrast)


def _radiance(solid: PlacedSolid, camera: Camera, appearance: Appearance) -> Grey:
    """Return the light of a solid before an even background, in fine pixels."""
    rng = np.random.default_rng(0)
    camera = divided(camera, FINE)
    scene = prepare_view([solid], camera, RigidTransform.identity(), appearance, rng)
    canvas = FrameBuffer(scene.canvas.z.copy(), scene.canvas.terms.sum(axis=0)[None])
    scene.painter.paint(canvas, in_view([solid], scene.T_camera_base))
    return np.asarray(canvas.terms[0, 0].reshape(camera.height, camera.width))


def _through_lens(fine: Grey, blur: float) -> Grey:
    """Return the light that pixels gather behind a lens that blurs."""
    blurred = cv2.GaussianBlur(fine, (0, 0), FINE * blur)
    height, width = fine.shape
    gathered = blurred.reshape(height // FINE, FINE, width // FINE, FINE).mean(axis=(1, 3))
    return np.asarray(gathered, dtype=np.float32)


def _background(kind: str, dark: Grey, free: Grey, rng: np.random.Generator) -> Grey:
    """Return the light of a background that slopes a little."""
    leg = float(np.quantile(dark[free == 0.0], 0.9))
    level = {
        "dark": rng.uniform(0.01, 0.25) * leg,
        "bright": rng.uniform(1.3, 2.5) * leg,
        "like the leg": rng.uniform(0.3, 1.0) * leg,
    }[kind]
    height, width = dark.shape
    slope = rng.choice([0.0, 0.4]) * rng.uniform(-1.0, 1.0, 2)
    y, x = np.mgrid[-1.0 : 1.0 : height * 1j, -1.0 : 1.0 : width * 1j]
    return np.asarray(level * (1.0 + slope[0] * x + slope[1] * y), dtype=np.float32)


def _contrasts(grey: Grey, camera: Camera, band: Band, v: Array, blur: float) -> Array:
    """Return how much brighter the leg is than its background, along both edges."""
    t = np.linspace(0.1, 0.9, 50)
    deep = DEEP * (1.0 + blur)
    contrasts = []
    for ends, epsilon in zip(v, EPSILON, strict=True):
        at = ends[0] + (ends[1] - ends[0]) * t
        inside, outside = (
            interpolated(grey, camera, band.points(t * band.length, at + epsilon * d)).mean()
            for d in (min(deep, 0.3 * abs(v[1, 0] - v[0, 0])), -deep)
        )
        contrasts.append(float(inside - outside))
    return np.array(contrasts)


def grey_levels(image: Image) -> Grey:
    """Return an image of 8 or 16 bits, grey or in colour (BGR), as grey levels 0 to 255."""
    values = image.astype(np.float32)
    if image.dtype == np.uint16:
        values /= np.float32(257.0)
    if values.ndim == 3:
        values = np.asarray(cv2.cvtColor(values, cv2.COLOR_BGR2GRAY), dtype=np.float32)
    return values


def interpolated(grey: Grey, camera: Camera, xy: Array) -> Grey:
    """Return grey levels at points of the sensor plane."""
    pixels = camera.distort(xy).astype(np.float32)
    mapped = cv2.remap(grey, pixels[..., 0], pixels[..., 1], cv2.INTER_CUBIC)
    return np.asarray(mapped, dtype=np.float32)
