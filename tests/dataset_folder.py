"""A small dataset folder of the example hexapod, for tests to spoil."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from legcal import Machine, load_mechanism

ROOT = Path(__file__).parents[1]
HEXAPOD = ROOT / "examples" / "hexapod" / "models" / "hexapod.yaml"
JOINTS = [f"leg{j}_prismatic" for j in range(1, 7)]
SIZE = (64, 48)
SERVOS = tuple(f"servo{j}" for j in range(1, 7))


@cache
def hexapod() -> Machine:
    """The example hexapod, loaded once."""
    return load_mechanism(HEXAPOD)


def readings(seed: int) -> list[float]:
    """Readings inside the travel."""
    return [round(float(q), 7) for q in np.random.default_rng(seed).uniform(0.0, 0.14, 6)]


@dataclass
class Folder:
    """What the files say; tests change it before :meth:`write`."""

    path: Path
    rows: list[dict[str, Any]]
    columns: list[str]
    entry: dict[str, Any]
    camera: dict[str, Any] = field(
        default_factory=lambda: {
            "image_width": SIZE[0],
            "image_height": SIZE[1],
            "camera_matrix": {"rows": 3, "cols": 3, "data": [80.0, 0, 32, 0, 80, 24, 0, 0, 1]},
            "distortion_model": "plumb_bob",
            "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.0] * 5},
        }
    )

    def write(self) -> Path:
        """Write dataset.yaml, the table and the camera file."""
        (self.path / "dataset.yaml").write_text(yaml.safe_dump(self.entry, sort_keys=False))
        (self.path / "camera_info.yaml").write_text(yaml.safe_dump(self.camera))
        rows = [[str(row.get(name, "")) for name in self.columns] for row in self.rows]
        text = "".join(",".join(cells) + "\n" for cells in [self.columns, *rows])
        (self.path / "measurements.csv").write_text(text)
        return self.path


def small_folder(path: Path) -> Folder:
    """Write two views with two images of nothing each."""
    (path / "images").mkdir(parents=True)
    rows: list[dict[str, Any]] = []
    for seed, (view, number) in enumerate([("c1", 1), ("c1", 2), ("c2", 1), ("c2", 2)]):
        name = f"images/{view}_{number}.png"
        picture = np.random.default_rng(seed).integers(0, 255, (SIZE[1], SIZE[0]), dtype=np.uint8)
        cv2.imwrite(str(path / name), picture)
        rows.append({"view": view, "image": name, **dict(zip(JOINTS, readings(seed), strict=True))})
    pose = {"xyz": [0.9, 0.1, 0.2], "quat_xyzw": [0.0, 0.0, 0.0, 1.0]}
    entry = {
        "legcal_dataset": 1,
        "mechanism": str(HEXAPOD),
        "measurements": "measurements.csv",
        "encoder_sigma": 2e-6,
        "views": {
            "c1": {"camera": "camera_info.yaml", "T_base_camera": pose},
            "c2": {"camera": "camera_info.yaml", "legs": ["leg1", "leg4"]},
        },
    }
    made = Folder(path, rows, ["view", "image", *JOINTS], entry)
    made.write()
    return made


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Folder:
    """A folder to spoil; reading the mechanism again is spared."""
    monkeypatch.setattr("legcal.data.dataset.load_mechanism", lambda path: hexapod())
    return small_folder(tmp_path / "set")


def dataset_of_readings(
    folder: Path,
    readings: np.ndarray,
    entry: Mapping[str, Any],
    model: str = "servo-hexapod",
    joints: tuple[str, ...] = SERVOS,
) -> Path:
    """Write a dataset of readings (n_rows, n_motors) of a machine of arms, without images."""
    lines = ["view,image," + ",".join(joints)]
    lines += [f"c1,{k}.png," + ",".join(f"{x:.9g}" for x in row) for k, row in enumerate(readings)]
    (folder / "measurements.csv").write_text("\n".join(lines) + "\n")
    document = {
        "legcal_dataset": 1,
        "mechanism": model,
        "measurements": "measurements.csv",
        "views": {"c1": {"camera": str(ROOT / "examples/hexapod/camera_info.yaml")}},
        **entry,
    }
    (folder / "dataset.yaml").write_text(yaml.safe_dump(document))
    return folder
