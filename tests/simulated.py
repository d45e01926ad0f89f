"""Small simulated datasets for tests."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from legcal.simulation.dataset import SimulatedDataset, simulate
from legcal.simulation.request import Level
from legcal.simulation.settings import SimulationSettings
from legcal.vision.camera import Camera
from legcal.vision.camera_file import camera_info

PLACES = Path(__file__).parent / "data/camera_places.json"  # by machine and view
SMALL = SimulationSettings(level=Level.OUTLINES, poses=3, views=2, seed=5)


def small_camera(folder: Path, width: int = 200, height: int = 150) -> Path:
    """Write the file of a camera for small, quick photographs."""
    K = np.array([[1.25 * width, 0.0, 0.5 * width], [0.0, 1.25 * width, 0.5 * height], [0, 0, 1.0]])
    path = folder / "small.yaml"
    path.write_text(camera_info(Camera(K, width, height), "small"))
    return path


def settings(**changes: object) -> SimulationSettings:
    """Return settings of a small dataset with some of them changed."""
    return replace(SMALL, **changes)  # type: ignore[arg-type]


def simulated(folder: Path, model: str, *, views: int = 2, **changes: object) -> SimulatedDataset:
    """Simulate a shipped machine before cameras at known places: a search is half of the time."""
    places = json.loads(PLACES.read_text())[model]
    folder.parent.mkdir(parents=True, exist_ok=True)
    cameras = folder.with_name(f"{folder.name}-cameras.yaml")
    cameras.write_text(
        json.dumps({"views": {f"c{v}": places[f"c{v}"] for v in range(1, views + 1)}})
    )
    made = simulate(model, folder, settings(views=cameras, **changes))
    cameras.unlink()
    return made


def files_of(folder: Path) -> dict[str, bytes]:
    """Return all files of a folder with their content, but schemas for editors."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.parent.name != ".schemas"
    }
