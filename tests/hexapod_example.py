"""Copies of the example hexapod, as it is or small for tests to spoil; one run of all of it."""

import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from csv_rows import read_rows, write_rows
from numpy.typing import NDArray

from legcal.calibration.result import Calibration
from legcal.calibration.result_folder import write_result

ROOT = Path(__file__).parents[1]
HEXAPOD = ROOT / "examples" / "hexapod"
TRUTH = ROOT / "tests" / "data" / "hexapod-truth" / "models" / "hexapod.yaml"


def copy_of_the_example(destination: Path) -> Path:
    """Copy the example without what an earlier run left beside it."""
    left = shutil.ignore_patterns("observations.csv", ".legcal-cache.json")
    return Path(shutil.copytree(HEXAPOD, destination, ignore=left))


@dataclass(frozen=True)
class Run:
    """One calibration of the example hexapod from its photographs."""

    folder: Path
    output: Path
    calibration: Calibration
    stages: tuple[str, ...]

    def written_again(self, *_: Any, output: Path, beside: Any, **__: Any) -> Calibration:
        """Write the result into another folder, as if it were calibrated again, and return it."""
        return write_result(self.calibration, output, beside=beside)


# Copies with spoiled images


Picture = NDArray[np.uint8]


@dataclass
class Spoiled:
    """What the files say, with images of half the size; changed before :meth:`write`."""

    path: Path
    rows: list[dict[str, str]]
    entry: dict[str, Any]

    def row(self, view: str, k: int) -> dict[str, str]:
        """Return the k-th row of a view."""
        return [row for row in self.rows if row["view"] == view][k]

    def change(self, view: str, k: int, change: Callable[[Picture], Any]) -> str:
        """Change an image; return its name."""
        name = self.row(view, k)["image"]
        path = str(self.path / name)
        picture = np.asarray(cv2.imread(path, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
        assert cv2.imwrite(path, np.clip(change(picture), 0, 255).astype(np.uint8))
        return name

    def swap(self, one: tuple[str, int], other: tuple[str, int]) -> None:
        """Exchange the images of two rows."""
        a, b = self.row(*one), self.row(*other)
        a["image"], b["image"] = b["image"], a["image"]

    def scale_radii(self, factor: float, leg: str) -> None:
        """Change the radii of the legs whose links begin so."""
        path = next(self.path.rglob("*.urdf"))
        parts = re.split(r'(?=<link name=")', path.read_text())
        for k, part in enumerate(parts):
            if part.startswith(f'<link name="{leg}'):
                parts[k] = re.sub(
                    r'(<cylinder[^>]*radius=")([\d.e-]+)',
                    lambda found: f"{found[1]}{factor * float(found[2]):.6f}",
                    part,
                )
        path.write_text("".join(parts))

    def write(self) -> Path:
        """Write dataset.yaml and the table."""
        (self.path / "dataset.yaml").write_text(yaml.safe_dump(self.entry, sort_keys=False))
        write_rows(self.path / "measurements.csv", self.rows)
        return self.path


def write_halved_camera(source: Path, target: Path) -> None:
    """Write the camera of a file for images at half their size."""
    camera = yaml.safe_load(source.read_text(encoding="utf-8"))
    camera["image_width"] //= 2
    camera["image_height"] //= 2
    K = np.array(camera["camera_matrix"]["data"]).reshape(3, 3)
    K[:2] *= 0.5
    K[:2, 2] -= 0.25
    camera["camera_matrix"]["data"] = K.ravel().tolist()
    camera.pop("projection_matrix", None)
    target.write_text(yaml.safe_dump(camera), encoding="utf-8")


def spoiled(path: Path, n: int, views: Sequence[str] = ("c1", "c2", "c3")) -> Spoiled:
    """Copy the first images of some views of the example at half their size."""
    shutil.copytree(HEXAPOD / "models", path / "models")
    shutil.copytree(HEXAPOD / "urdf", path / "urdf")
    (path / "images").mkdir()
    every = read_rows(HEXAPOD / "measurements.csv")
    rows = [row for v in views for row in [row for row in every if row["view"] == v][:n]]
    for row in rows:
        picture = cv2.imread(str(HEXAPOD / row["image"]), cv2.IMREAD_GRAYSCALE)
        row["image"] = str(Path(row["image"]).with_suffix(".png"))
        small = cv2.resize(np.asarray(picture), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        assert cv2.imwrite(str(path / row["image"]), small)
    write_halved_camera(HEXAPOD / "camera_info.yaml", path / "camera_info.yaml")
    entry = yaml.safe_load((HEXAPOD / "dataset.yaml").read_text())
    entry["views"] = {name: entry["views"][name] for name in views}
    return Spoiled(path, rows, entry)
