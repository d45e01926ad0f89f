"""Small simulated datasets for tests."""

import contextlib
import json
import os
import pickle
import shutil
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import numpy as np

from legcal.files.motions import MotionEntry
from legcal.simulation.cameras import mild_lens, read_lens
from legcal.simulation.dataset import SimulatedDataset, simulate
from legcal.simulation.observe import Viewpoint
from legcal.simulation.settings import Level, SimulationSettings
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


def standing(model: str, views: int = 2, camera: Path | None = None) -> tuple[Viewpoint, ...]:
    """Return cameras at known places before a shipped machine."""
    lens = mild_lens() if camera is None else read_lens(camera)
    places = json.loads(PLACES.read_text())[model]
    return tuple(
        Viewpoint(name, lens, MotionEntry(**places[name]["T_base_camera"]).motion())
        for name in [f"c{v}" for v in range(1, views + 1)]
    )


def simulated(
    folder: Path, model: str, *, views: int = 2, camera: Path | None = None, **changes: object
) -> SimulatedDataset:
    """Simulate a shipped machine before cameras at known places: a search is half of the time.

    Outlines that were simulated before, by any process of these tests, are copied.
    """
    # cameras are placed to see a board
    seen_from = views if changes.get("board") else standing(model, views, camera)
    given = settings(views=seen_from, **changes)
    read = camera is not None or isinstance(given.poses, Path)  # a file, which may have changed
    if given.level != Level.OUTLINES or read or not _MADE:
        return simulate(model, folder, given)
    kept = _MADE[0] / sha256(pickle.dumps((model, views, repr(changes)))).hexdigest()
    if not kept.is_dir():
        made = simulate(model, folder, given)
        other = kept.with_name(f"{kept.name}-{os.getpid()}")
        shutil.copytree(folder, other / "files")
        (other / "made").write_bytes(pickle.dumps(made))
        with contextlib.suppress(OSError):  # another process was faster
            other.rename(kept)
        return made
    earlier: SimulatedDataset = pickle.loads((kept / "made").read_bytes())
    shutil.copytree(kept / "files", folder)
    truth = folder / earlier.truth_path.relative_to(earlier.folder)
    return replace(earlier, folder=folder, truth_path=truth)


_MADE: list[Path] = []  # the folder of what was simulated


def keep_simulated(folder: Path) -> None:
    """Have sessions kept in a folder that all processes of these tests share."""
    folder.mkdir(parents=True, exist_ok=True)
    _MADE[:] = [folder]


def files_of(folder: Path) -> dict[str, bytes]:
    """Return all files of a folder with their content, but schemas for editors."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.parent.name != ".schemas"
    }
