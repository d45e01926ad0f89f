"""Photographs of a simulated machine: rendered, in several processes if wanted, and written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from legcal.detection.workers import Run
from legcal.errors import OutOfResources
from legcal.progress import Report
from legcal.simulation.images import Images, Viewpoint
from legcal.simulation.posed_machine import PosedMachine
from legcal.simulation.rendering.appearance import Appearance
from legcal.simulation.rendering.scene import Scene, prepare_scene
from legcal.simulation.solids import PlacedSolid

STAGE = "Photographs"
_FAST = (cv2.IMWRITE_PNG_COMPRESSION, 1)  # noise does not compress: more effort saves nothing


def take_photographs(
    folder: Path,
    names: Sequence[str],
    images: Images,
    machines: Sequence[PosedMachine],
    viewpoints: Sequence[Viewpoint],
    appearance: Appearance,
    rng: np.random.Generator,
    run: Run,
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
    run : Run
        How the work is shared.
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
    for v, viewpoint in enumerate(viewpoints):
        rows = np.flatnonzero(images.view == v).tolist()
        studio = _Studio(
            viewpoint,
            tuple(machines[images.pose[row]].solids for row in rows),
            tuple(folder / names[row] for row in rows),
            appearance,
            of_views[v],
            tuple(of_images[row] for row in rows),
        )
        for _ in run(studio.photograph, range(len(rows))):
            done += 1
            progress(STAGE, done, len(images))


@dataclass(frozen=True, eq=False)
class _Studio:
    """A camera in its place, and the machine in the poses that it takes photographs of."""

    viewpoint: Viewpoint
    machines: tuple[tuple[PlacedSolid, ...], ...]
    paths: tuple[Path, ...]
    appearance: Appearance
    rng: np.random.Generator
    sensor_rngs: tuple[np.random.Generator, ...]

    @cached_property
    def scene(self) -> Scene:
        """The camera in front of its surroundings."""
        view = self.viewpoint
        return prepare_scene(
            self.machines[0], view.camera, view.T_base_camera, self.appearance, self.rng
        )

    def photograph(self, k: int) -> None:
        """Write photograph k."""
        image = self.scene.render(self.machines[k], self.sensor_rngs[k])
        found, content = cv2.imencode(".png", image, _FAST)
        if not found:
            raise OutOfResources(
                f"{self.paths[k]}: the photograph could not be encoded: found an image of "
                f"{image.shape[1]} x {image.shape[0]} px that PNG does not take, needed a smaller "
                "one; use another camera."
            )
        self.paths[k].write_bytes(content.tobytes())
