"""Small datasets with repeated images of the same poses, of any machine."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from rendering import Bar, Light, render
from scipy.spatial.transform import RigidTransform

from legcal.files import motion_to_xyz_quat
from legcal.geometry.types import Array
from legcal.machine import Machine, load_mechanism, random_configurations
from legcal.simulation import look_at
from legcal.vision.camera import Camera
from legcal.vision.visibility import visible_segments

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
        with (self.path / "measurements.csv").open("w", newline="") as stream:
            writer = csv.DictWriter(stream, list(self.rows[0]))
            writer.writeheader()
            writer.writerows(self.rows)
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
