"""A small renderer of lit cylinders with exactly known outlines."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array, Image
from legcal.simulation.rendering.appearance import Appearance
from legcal.simulation.rendering.scene import prepare_view
from legcal.simulation.solids import PlacedSolid
from legcal.vision.camera import Camera


def photograph(
    placed: Sequence[PlacedSolid],
    camera: Camera,
    T_base_camera: RigidTransform,
    appearance: Appearance,
    rng: np.random.Generator,
) -> Image:
    """Return a photograph of solids by the renderer of the package."""
    return prepare_view(placed, camera, T_base_camera, appearance, rng).render(placed, rng)


@dataclass(frozen=True, eq=False)
class Bar:
    """A cylinder between two points of the camera frame."""

    A: Array
    B: Array
    radius: float
    albedo: float = 180.0


@dataclass(frozen=True, eq=False)
class Light:
    """How bars are lit: a surface is albedo * (ambient + lambert + gloss), light from infinity."""

    direction: tuple[float, float, float] = (0.4, -0.3, -0.9)
    ambient: float = 0.6
    diffuse: float = 0.5
    gloss: float = 0.0


def render(
    camera: Camera,
    bars: Sequence[Bar],
    background: Array | float,
    light: Light | None = None,
    blur: float = 0.5,
    noise: float = 2.0,
    supersample: int = 5,
) -> Array:
    """Return an image (height, width) of grey levels 0 to 255.

    ``background`` is a grey level or a picture of the size of the image. Blur [px] and noise [grey
    levels] are Gaussian.
    """
    light = Light() if light is None else light
    n = supersample
    height, width = camera.height, camera.width
    u = (np.arange(width * n) + 0.5) / n - 0.5
    v = (np.arange(height * n) + 0.5) / n - 0.5
    pixels = np.stack(np.meshgrid(u, v), axis=-1)
    rays: Array = np.ones((*pixels.shape[:2], 3))
    rays[..., :2] = _undistort(camera, pixels)
    behind = np.broadcast_to(np.asarray(background, dtype=np.float64), (height, width))
    size = (width * n, height * n)
    fine = cv2.resize(behind, size, interpolation=cv2.INTER_LINEAR)
    image: Array = np.array(fine, dtype=np.float64)
    depth: Array = np.full(image.shape, np.inf)
    toward = np.array(light.direction) / np.linalg.norm(light.direction)
    for bar in bars:
        _paint(image, depth, rays, bar, light, toward)
    if blur > 0.0:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), blur * n), dtype=np.float64)
    small = image.reshape(height, n, width, n).mean(axis=(1, 3)).astype(np.float64)
    small += noise * np.random.default_rng(0).standard_normal(small.shape)
    return np.asarray(np.clip(small, 0.0, 255.0))


def _undistort(camera: Camera, pixels: Array) -> Array:
    """Undistort a fine grid by interpolating a coarser exact one."""
    if not camera.has_distortion:
        return camera.undistort(pixels)
    coarse = pixels[::5, ::5]
    exact = camera.undistort(np.ascontiguousarray(coarse))
    rows, columns = np.indices(pixels.shape[:2], dtype=np.float32) / np.float32(5.0)
    smooth = [
        cv2.remap(exact[..., i], columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        for i in range(2)
    ]
    return np.asarray(np.stack(smooth, axis=-1), dtype=np.float64)


def _paint(image: Array, depth: Array, rays: Array, bar: Bar, light: Light, toward: Array) -> None:
    """Draw one bar over what lies behind it."""
    length = float(np.linalg.norm(bar.B - bar.A))
    u = (bar.B - bar.A) / length
    rows, columns = _box(rays, bar)
    ray = rays[rows, columns]
    across = ray - (ray @ u)[..., None] * u
    offset = bar.A - (bar.A @ u) * u
    a, b = np.sum(across**2, axis=-1), across @ offset
    disc = b**2 - a * (offset @ offset - bar.radius**2)
    hit = disc > 0.0
    z = (b - np.sqrt(np.where(hit, disc, 0.0))) / a
    s = z * (ray @ u) - bar.A @ u
    hit &= (s > 0.0) & (s < length) & (z > 0.0) & (z < depth[rows, columns])
    normal = (z[..., None] * across - offset) / bar.radius
    lit = np.maximum(normal @ toward, 0.0)
    view = -ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    half = toward + view
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    gloss = np.maximum(np.sum(normal * half, axis=-1), 0.0) ** 30 * (lit > 0.0)
    shade = bar.albedo * (light.ambient + light.diffuse * lit + light.gloss * gloss)
    image[rows, columns] = np.where(hit, shade, image[rows, columns])
    depth[rows, columns] = np.where(hit, z, depth[rows, columns])


def _box(rays: Array, bar: Bar) -> tuple[slice, slice]:
    """Return the part of the image that a bar may cover."""
    ends = np.stack([bar.A, bar.B])
    xy = ends[:, :2] / ends[:, 2:]
    margin = 2.0 * bar.radius / ends[:, 2].min()
    low, high = xy.min(axis=0) - margin, xy.max(axis=0) + margin
    x, y = rays[..., 0], rays[..., 1]
    inside = (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    if not len(rows):
        return slice(0, 0), slice(0, 0)
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
