"""A true machine in its poses, the cameras that look at it, and what their images show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.mechanism.configurations import Configurations
from legcal.mechanism.model import Mechanism
from legcal.progress import Report
from legcal.simulation.cameras import mild_lens
from legcal.simulation.cameras_file import read_cameras, read_lens
from legcal.simulation.commanded_poses import commanded_poses
from legcal.simulation.dataset_files import pose_labels
from legcal.simulation.dressing import dressed
from legcal.simulation.images import Images, Viewpoint, take_images
from legcal.simulation.motion import given_poses
from legcal.simulation.placed_board import PlacedBoard
from legcal.simulation.posed_machine import PosedMachine, pose_machine
from legcal.simulation.settings import Level, SimulationSettings
from legcal.simulation.viewing import look_at_machine, numbered
from legcal.vision.camera import Camera


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
    board : PlacedBoard or None
        The calibration board on the base.
    groups : tuple of str
        The view of ``dataset.yaml`` that each camera belongs to where cameras are in the hand;
        empty where they stand.
    """

    truth: Mechanism
    poses: Configurations
    labels: tuple[str, ...]
    machines: tuple[PosedMachine, ...]
    views: tuple[Viewpoint, ...]
    images: Images
    left_out: int
    board: PlacedBoard | None = None
    groups: tuple[str, ...] = ()


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
    cameras, places = _cameras(settings)
    n_views = len(cameras)
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
    viewing = look_at_machine(
        truth, machines, settings, cameras, places,
        shared=shared, chance=chance, progress=progress,
    )  # fmt: skip
    views = viewing.views
    if settings.level is Level.PHOTOGRAPHS:
        views = _encoding(views, settings.appearance.gamma, settings.tell_gamma)
    in_hand = len(viewing.groups) > 0
    images = take_images(
        truth.legs, viewing.machines, views, settings.images,
        shared_poses=shared and not in_hand, progress=progress,
    )  # fmt: skip
    images = replace(images, pose=images.pose % len(machines))
    rows = list(range(len(images)))
    if settings.level is not Level.PHOTOGRAPHS:
        rows = [row for row in rows if images.seen(row)]
    kept, left_out = images.chosen(rows), len(images) - len(rows)
    if in_hand:
        kept, views, groups = numbered(kept, views, viewing.groups)
        viewing = replace(viewing, groups=groups)
    labels = pose_labels(len(poses.poses))
    machines = viewing.machines[: len(machines)]
    return ImagedMachine(
        truth, poses, labels, machines, views, kept, left_out, viewing.board, viewing.groups
    )


def _cameras(
    settings: SimulationSettings,
) -> tuple[dict[str, Camera], dict[str, RigidTransform]]:
    """Return the camera of each view, and where each stands if that is given."""
    camera = mild_lens() if settings.camera is None else read_lens(settings.camera)
    if isinstance(settings.views, int):
        return {f"c{v + 1}": camera for v in range(settings.views)}, {}
    given = read_cameras(settings.views, camera)
    cameras = {name: lens for name, (lens, _) in given.items()}
    return cameras, {name: T for name, (_, T) in given.items()}


def _encoding(views: tuple[Viewpoint, ...], gamma: float, is_told: bool) -> tuple[Viewpoint, ...]:
    """Return views whose cameras encode light in their grey levels, as their makers say or not."""
    cameras = {
        id(view.camera): replace(view.camera, gamma=gamma, gamma_is_told=is_told) for view in views
    }
    return tuple(replace(view, camera=cameras[id(view.camera)]) for view in views)
