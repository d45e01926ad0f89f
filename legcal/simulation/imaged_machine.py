"""A true machine in its poses, the cameras that look at it, and what their images show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from legcal.mechanism.configurations import Configurations
from legcal.mechanism.model import Mechanism
from legcal.progress import Report
from legcal.simulation.camera_places import places_around
from legcal.simulation.cameras import mild_lens
from legcal.simulation.cameras_file import read_cameras, read_lens
from legcal.simulation.commanded_poses import commanded_poses
from legcal.simulation.dataset_files import pose_labels
from legcal.simulation.dressing import dressed
from legcal.simulation.images import Images, Viewpoint, take_images
from legcal.simulation.motion import given_poses
from legcal.simulation.posed_machine import PosedMachine, pose_machine
from legcal.simulation.settings import Level, SimulationSettings


@dataclass(frozen=True, eq=False)
class ImagedMachine:
    """A true machine, its poses and its images.

    Attributes
    ----------
    truth : Mechanism
        The true machine.
    poses, labels, machines : sequence
        Its poses, their names, and the machine in each of them.
    views : tuple of Viewpoint
        The cameras.
    images : Images
        The images that the dataset has rows for.
    left_out : int
        Images that show no leg, which a dataset of axes or outlines has no row for.
    """

    truth: Mechanism
    poses: Configurations
    labels: tuple[str, ...]
    machines: tuple[PosedMachine, ...]
    views: tuple[Viewpoint, ...]
    images: Images
    left_out: int


def image_machine(
    truth: Mechanism,
    nominal: Mechanism,
    settings: SimulationSettings,
    chance: Mapping[str, np.random.Generator],
    progress: Report,
) -> ImagedMachine:
    """Return a machine in its poses and what its cameras show of it.

    Parameters
    ----------
    truth, nominal : Mechanism
        The machine, and the model of it.
    settings : SimulationSettings
        What to simulate.
    chance : mapping of str to numpy.random.Generator
        Sources of ``poses`` and ``cameras``.
    progress : callable
        Called as ``progress(stage, done, total)``.

    Raises
    ------
    UsageError, DatasetError, DidNotConverge, NotVisible
        As :func:`legcal.simulation.simulate.simulate` does.
    """
    camera = mild_lens() if settings.camera is None else read_lens(settings.camera)
    given = None if isinstance(settings.views, int) else read_cameras(settings.views, camera)
    n_views = settings.views if isinstance(settings.views, int) else len(given or ())
    shared = settings.shared_poses or isinstance(settings.poses, Path)
    if isinstance(settings.poses, Path):
        poses = given_poses(truth, settings.poses)
    else:
        n_poses = settings.poses * (1 if shared else n_views)
        poses = commanded_poses(
            truth, nominal, n_poses, chance["poses"], settings.sampling, progress
        )
    settings.check_images(n_views, len(poses.poses) // (1 if shared else n_views))
    # Meshes lie beside the nominal URDF, of which that of the true machine is a copy.
    shown = replace(truth, urdf=replace(truth.urdf, path=nominal.urdf.path))
    machines = pose_machine(truth, dressed(shown), poses)
    if given is None:
        places = places_around(truth, machines, [camera] * n_views, chance["cameras"], progress)
        views = tuple(Viewpoint(f"c{v + 1}", camera, T) for v, T in enumerate(places))
    else:
        views = tuple(Viewpoint(name, *place) for name, place in given.items())
    images = take_images(
        truth.legs, machines, views, settings.images, shared_poses=shared, progress=progress
    )
    rows = list(range(len(images)))
    if settings.level is not Level.PHOTOGRAPHS:
        rows = [row for row in rows if images.seen(row)]
    kept, left_out = images.chosen(rows), len(images) - len(rows)
    labels = pose_labels(len(poses.poses))
    return ImagedMachine(truth, poses, labels, machines, views, kept, left_out)
