"""Photographs of a simulated machine: rendered, in several processes if wanted, and written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
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
    with worker_pool(workers) as run:
        for v, viewpoint in enumerate(viewpoints):
            rows = np.flatnonzero(images.view == v)
            # Every process paints the surroundings once, which takes as long as a few photographs.
            n_parts = len(rows) if workers == 1 else min(workers, len(rows))
            studio = _Studio(
                viewpoint,
                tuple(tuple(part.tolist()) for part in np.array_split(rows, n_parts)),
                {row: machines[images.pose[row]].solids for row in rows.tolist()},
                {row: folder / names[row] for row in rows.tolist()},
                appearance,
                of_views[v],
                {row: of_images[row] for row in rows.tolist()},
            )
            for taken in run(studio.photograph, range(n_parts)):
                done += taken
                progress(STAGE, done, len(images))


@dataclass(frozen=True, eq=False)
class _Studio:
    """A camera in its place, and the machine in the poses that it takes photographs of."""

    viewpoint: Viewpoint
    parts: tuple[tuple[int, ...], ...]
    machines: Mapping[int, tuple[PlacedSolid, ...]]
    paths: Mapping[int, Path]
    appearance: Appearance
    rng: np.random.Generator
    sensor_rngs: Mapping[int, np.random.Generator]

    @cached_property
    def scene(self) -> Scene:
        """The camera in front of its surroundings."""
        view = self.viewpoint
        return prepare_scene(
            self.machines[self.parts[0][0]],
            view.camera,
            view.T_base_camera,
            self.appearance,
            self.rng,
        )

    def photograph(self, part: int) -> int:
        """Write the photographs of some rows; return how many."""
        for row in self.parts[part]:
            self._write(
                self.paths[row], self.scene.render(self.machines[row], self.sensor_rngs[row])
            )
        return len(self.parts[part])

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
