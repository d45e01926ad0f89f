"""A small renderer of lit cylinders with exactly known outlines, and repeated images of legs."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from csv_rows import write_rows
from scipy.spatial.transform import RigidTransform

from legcal.files.motions import motion_to_xyz_quat
from legcal.geometry.motions import look_at
from legcal.geometry.types import Array, Image
from legcal.machine.configurations import random_configurations
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.simulation.rendering.appearance import Appearance
from legcal.simulation.rendering.scene import prepare_view
from legcal.simulation.solids import PlacedSolid
from legcal.vision.camera import Camera
from legcal.vision.visibility import visible_segments


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
    seed: int = 0,
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
    small += noise * np.random.default_rng(seed).standard_normal(small.shape)
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
    rows, columns = _box(image.shape, rays, bar)
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


def _box(shape: tuple[int, ...], rays: Array, bar: Bar) -> tuple[slice, slice]:
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


# Repeated images


SIZE = (512, 384)
NOISE = 3.0  # grey levels
EVEN = Light(ambient=0.9, diffuse=0.1)


@dataclass
class RepeatedImages:
    """A dataset of one view; tests change rows, entry or pictures before :meth:`write`."""

    path: Path
    machine: Machine
    entry: dict[str, Any]
    rows: list[dict[str, str]]
    pictures: dict[str, Array] = field(default_factory=dict)  # by image, with noise

    def write(self) -> Path:
        """Write everything."""
        (self.path / "images").mkdir(parents=True, exist_ok=True)
        (self.path / "dataset.yaml").write_text(yaml.safe_dump(self.entry, sort_keys=False))
        camera = {
            "image_width": SIZE[0],
            "image_height": SIZE[1],
            "camera_matrix": {"rows": 3, "cols": 3, "data": _camera().K.ravel().tolist()},
            "distortion_model": "plumb_bob",
            "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.0] * 5},
        }
        (self.path / "camera_info.yaml").write_text(yaml.safe_dump(camera))
        for name, picture in self.pictures.items():
            pixels = np.clip(np.rint(picture), 0, 255).astype(np.uint8)
            assert cv2.imwrite(str(self.path / name), pixels)
        write_rows(self.path / "measurements.csv", self.rows)
        return self.path


def repeated_images(
    path: Path,
    model: str = "hexapod",
    n_poses: int = 2,
    n_images: int = 3,
    *,
    level_leg: int | None = None,
) -> RepeatedImages:
    """Render a machine in random poses, each several times with other noise.

    The camera is held so that the image of ``level_leg`` in the first pose is parallel to the image
    x axis.
    """
    machine = load_mechanism(model)
    drawn = random_configurations(machine, n_poses, 3)
    middle = 0.5 * (machine.A_base.mean(axis=0) + machine.home.apply(machine.B_platform).mean(0))
    lengths = np.linalg.norm(machine.home.apply(machine.B_platform) - machine.A_base, axis=1)
    size = max(float(lengths.max()), float(np.ptp(machine.A_base, axis=0).max()))
    aside = np.array([1.0, 0.45, 0.5]) if machine.spatial else np.array([0.15, 0.1, 1.3])
    roll = 0.1
    if level_leg is not None:
        T = look_at(middle + 1.7 * size * aside, middle).inv()
        B_base = drawn.poses[0].apply(machine.B_platform[level_leg])
        normal = np.cross(T.apply(machine.A_base[level_leg]), T.apply(B_base))
        roll = float(np.arctan2(-normal[0], normal[1]))
    T_base_camera = look_at(middle + 1.7 * size * aside, middle, roll=roll)
    entry = {
        "legcal_dataset": 1,
        "mechanism": str(machine.yaml_path),
        "measurements": "measurements.csv",
        "encoder_sigma": 2e-6,
        "views": {
            "c1": {
                "camera": "camera_info.yaml",
                "T_base_camera": motion_to_xyz_quat(T_base_camera),
            }
        },
    }
    made = RepeatedImages(path, machine, entry, [])
    rng = np.random.default_rng(5)
    for p, (q, T) in enumerate(zip(drawn.readings, drawn.poses, strict=True)):
        clean = _picture(machine, T, T_base_camera)
        for k in range(n_images):
            name = f"images/p{p}_{k}.png"
            made.pictures[name] = clean + NOISE * rng.standard_normal(clean.shape)
            readings = {str(machine.legs[j].prismatic): f"{q[j]:.9f}" for j in machine.motors}
            made.rows.append({"view": "c1", "image": name, "pose": f"p{p}", **readings})
    return made


def _camera() -> Camera:
    K = np.array([[520.0, 0.0, 257.3], [0.0, 520.0, 190.1], [0.0, 0.0, 1.0]])
    return Camera(K, *SIZE)


def _picture(
    machine: Machine, T_base_platform: RigidTransform, T_base_camera: RigidTransform
) -> Array:
    """Return a picture of all legs without noise."""
    T = T_base_camera.inv()
    A, B = T.apply(machine.A_base), T.apply(T_base_platform.apply(machine.B_platform))
    bars: Sequence[Bar] = [
        Bar(A[j] + piece.start * u, A[j] + piece.end * u, piece.radius)
        for j, leg in enumerate(machine.legs)
        for length in [float(np.linalg.norm(B[j] - A[j]))]
        for u in [(B[j] - A[j]) / length]
        for piece in visible_segments(leg.cylinders, length)
    ]
    return render(_camera(), bars, 60.0, EVEN, blur=0.6, noise=0.0, supersample=3)
