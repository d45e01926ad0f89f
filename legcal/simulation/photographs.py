"""Photographs of a simulated machine: rendered, in several processes if wanted, and written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from legcal.errors import OutOfResources
from legcal.geometry.types import Image
from legcal.progress import Report
from legcal.simulation.images import Images, Viewpoint
from legcal.simulation.posed_machine import PosedMachine
from legcal.simulation.rendering.appearance import Appearance
from legcal.simulation.rendering.scene import Scene, prepare_scene
from legcal.simulation.solids import PlacedSolid
from legcal.workers import worker_pool

STAGE = "Photographs"
_FAST = (cv2.IMWRITE_PNG_COMPRESSION, 1)  # for colours; grey levels are written faster without


def take_photographs(
    folder: Path,
    names: Sequence[str],
    images: Images,
    machines: Sequence[PosedMachine],
    viewpoints: Sequence[Viewpoint],
    appearance: Appearance,
    rng: np.random.Generator,
    workers: int,
    progress: Report,
) -> None:
    """Render all images and write them.

    What stands around the machine is drawn once for each view, the noise of the sensor for each
    image: images do not depend on how many processes make them.

    Parameters
    ----------
    folder : Path
        The dataset.
    names : sequence of str
        The file of each image, relative to it.
    images, machines, viewpoints
        The images, the machine in every pose, and the cameras.
    appearance : Appearance
        How the photographs look.
    rng : numpy.random.Generator
        Source of surroundings and noise.
    workers : int
        Number of processes.
    progress : callable
        Told of finished photographs.

    Raises
    ------
    OutOfResources
        If a file cannot be written.
    """
    of_views, of_images = rng.spawn(len(viewpoints)), rng.spawn(len(images))
    (folder / "images").mkdir()
    done = 0
    progress(STAGE, done, len(images))
    try:
        with worker_pool(workers) as run:
            for v, viewpoint in enumerate(viewpoints):
                rows = np.flatnonzero(images.view == v).tolist()
                machine = {row: machines[images.pose[row]].solids for row in rows}
                nearby = next(iter(machine.values()), ())
                studio = _Studio(
                    _Place(f"{folder} {v}", viewpoint, nearby, appearance, of_views[v]),
                    machine,
                    {row: folder / names[row] for row in rows},
                    {row: of_images[row] for row in rows},
                )
                for _ in run(studio.photograph, rows):
                    done += 1
                    progress(STAGE, done, len(images))
    finally:
        _scene.cache_clear()


@dataclass(frozen=True)
class _Place:
    """A camera in its place; two of one key are the same, in whatever process they are."""

    key: str
    viewpoint: Viewpoint = field(compare=False)
    machine: tuple[PlacedSolid, ...] = field(compare=False)
    appearance: Appearance = field(compare=False)
    rng: np.random.Generator = field(compare=False)


@lru_cache(maxsize=1)
def _scene(place: _Place) -> Scene:
    """Return the camera in front of its surroundings, painted once in each process."""
    view = place.viewpoint
    return prepare_scene(
        place.machine, view.camera, view.T_base_camera, place.appearance, place.rng
    )


@dataclass(frozen=True, eq=False)
class _Studio:
    """A camera in its place, and the machine in the poses that it takes photographs of."""

    place: _Place
    machines: Mapping[int, tuple[PlacedSolid, ...]]
    paths: Mapping[int, Path]
    sensor_rngs: Mapping[int, np.random.Generator]

    def photograph(self, row: int) -> None:
        """Write the photograph of a row."""
        image = _scene(self.place).render(self.machines[row], self.sensor_rngs[row])
        self._write(self.paths[row], image)

    def _write(self, path: Path, image: Image) -> None:
        """Write a photograph."""
        encoded, content = cv2.imencode(".png", image, _FAST if image.ndim == 3 else ())
        if not encoded:
            raise OutOfResources(
                f"{path}: the photograph could not be encoded: found an image of {image.shape[1]} "
                f"x {image.shape[0]} px that PNG does not take, needed a smaller one; use another "
                "camera."
            )
        path.write_bytes(content.tobytes())
