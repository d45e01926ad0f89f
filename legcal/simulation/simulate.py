"""A whole dataset of a simulated machine: nominal model in, dataset and truth out (section 4.3)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from legcal.dataset.folder import OBSERVATIONS_NAME
from legcal.geometry.types import Array
from legcal.mechanism.load import load_mechanism
from legcal.mechanism.model import Mechanism
from legcal.observations.axes_file import write_axis_table
from legcal.observations.measurements import Measurements, View
from legcal.observations.table import write_observations
from legcal.progress import Report, no_progress
from legcal.report.model_files import write_model
from legcal.simulation.camera_places import places_around
from legcal.simulation.cameras import mild_lens
from legcal.simulation.cameras_file import read_cameras
from legcal.simulation.commanded_poses import commanded_poses
from legcal.simulation.dataset_files import (
    image_names,
    measurements_of,
    pose_labels,
    write_session,
    write_truth,
)
from legcal.simulation.dressing import dressed
from legcal.simulation.folder import (
    AXES_NAME,
    TRUTH,
    TRUTH_NAME,
    check_dataset_destination,
    dataset_folder,
    files_in,
)
from legcal.simulation.hints import rough_pose
from legcal.simulation.images import Images, Viewpoint, take_images
from legcal.simulation.motion import SimulatedPoses, given_poses
from legcal.simulation.parameter_errors import Distribution
from legcal.simulation.photographs import take_photographs
from legcal.simulation.posed_machine import PosedMachine, pose_machine
from legcal.simulation.settings import Level, SimulationSettings
from legcal.simulation.tables import axes_of_images, outlines_of_images
from legcal.simulation.truth import write_true_model
from legcal.vision.camera_file import read_camera

_OFTEN = 0.5  # of the photographs of a view that show a leg which its hint names
_STREAMS = ("errors", "poses", "cameras", "readings", "hints", "observations", "photographs")


@dataclass(frozen=True, eq=False)
class SimulatedDataset:
    """What was written.

    Attributes
    ----------
    folder : Path
        The dataset.
    level : Level
        What it gives a calibration to work on.
    nominal, truth : Mechanism
        The model of the dataset, and the machine that was measured.
    truth_path : Path
        The YAML of the true model.
    measurements : Measurements
        The rows.
    seen : (n_rows, n_legs) array of bool
        Which legs each image shows.
    left_out : int
        Images that show no leg, which a dataset of axes or outlines has no row for.
    """

    folder: Path
    level: Level
    nominal: Mechanism
    truth: Mechanism
    truth_path: Path
    measurements: Measurements
    seen: Array
    left_out: int


def simulate(
    model: str | Path | Mechanism,
    output: str | Path,
    settings: SimulationSettings | None = None,
    *,
    force: bool = False,
    workers: int = 1,
    progress: Report = no_progress,
) -> SimulatedDataset:
    """Write a dataset of a machine that differs from its nominal model by drawn errors.

    The same settings give the same files, to the last bit, on one machine. What is drawn for one
    purpose does not depend on the others: two levels with one seed show the same machine in the
    same poses.

    Parameters
    ----------
    model : str, Path or Mechanism
        The nominal model, as :func:`legcal.load_mechanism` takes it.
    output : path
        The folder of the dataset.
    settings : SimulationSettings, optional
        What to simulate.
    force : bool
        Replace an earlier simulated dataset.
    workers : int
        Render photographs in that many processes.
    progress : callable
        Called as ``progress(stage, done, total)``.

    Returns
    -------
    SimulatedDataset

    Raises
    ------
    UsageError
        If the output holds something else, or a camera is inside the machine.
    ModelError, DatasetError, OutOfClass
        If a file is malformed or not covered.
    DidNotConverge
        If the machine does not reach such poses.
    NotVisible
        If a view shows no leg. Nothing is written in any of these cases.
    """
    settings = settings or SimulationSettings()
    destination = Path(output)
    check_dataset_destination(destination, force=force)
    nominal = model if isinstance(model, Mechanism) else load_mechanism(model)
    chance = _streams(settings.seed)
    with dataset_folder(destination, force=force) as folder:
        yaml_path, _ = write_model(nominal, folder)
        truth = write_true_model(nominal, settings.errors, chance["errors"], folder / TRUTH)
        session = _session(truth, nominal, settings, chance, progress)
        m = _measurements(session, settings, chance)
        write_session(folder, nominal, yaml_path.relative_to(folder).as_posix(), m)
        _write_observations(folder, session, m, settings, chance)
        if settings.level is Level.PHOTOGRAPHS:
            take_photographs(
                folder, m.image, session.images, session.machines, session.views,
                settings.appearance, chance["photographs"], workers, progress,
            )  # fmt: skip
        files = [*files_in(folder), TRUTH_NAME]
        write_truth(
            folder / TRUTH_NAME, settings, truth, session.views, session.poses,
            session.labels, files,
        )  # fmt: skip
    images = session.images
    seen = np.array([[leg.is_seen for leg in shown] for shown in images.shown])
    name = f"models/{truth.yaml_path.name}"
    return SimulatedDataset(
        destination, settings.level, nominal, truth, destination / TRUTH / name, m, seen,
        session.left_out,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Session:
    """A true machine in its poses, before its cameras."""

    truth: Mechanism
    poses: SimulatedPoses
    labels: tuple[str, ...]
    machines: tuple[PosedMachine, ...]
    views: tuple[Viewpoint, ...]
    images: Images
    left_out: int


def _streams(seed: int) -> dict[str, np.random.Generator]:
    """Return a source of chance for every purpose."""
    children = np.random.SeedSequence(seed).spawn(len(_STREAMS))
    return {
        name: np.random.default_rng(child) for name, child in zip(_STREAMS, children, strict=True)
    }


def _session(
    truth: Mechanism,
    nominal: Mechanism,
    settings: SimulationSettings,
    chance: dict[str, np.random.Generator],
    progress: Report,
) -> _Session:
    """Return the machine in its poses and what its cameras show of it."""
    camera = mild_lens() if settings.camera is None else read_camera(settings.camera)
    given = None if isinstance(settings.views, int) else read_cameras(settings.views, camera)
    n_views = settings.views if isinstance(settings.views, int) else len(given or ())
    shared = settings.shared_poses or isinstance(settings.poses, Path)
    progress("Poses", 0, 1)
    if isinstance(settings.poses, Path):
        poses = given_poses(truth, settings.poses)
    else:
        n_poses = settings.poses * (1 if shared else n_views)
        poses = commanded_poses(truth, nominal, n_poses, chance["poses"], settings.sampling)
    progress("Poses", 1, 1)
    # Meshes lie beside the nominal URDF, of which that of the true machine is a copy.
    shown = replace(truth, urdf=replace(truth.urdf, path=nominal.urdf.path))
    machines = pose_machine(truth, dressed(shown), poses)
    progress("Cameras", 0, 1)
    if given is None:
        places = places_around(truth, machines, [camera] * n_views, chance["cameras"])
        views = tuple(Viewpoint(f"c{v + 1}", camera, T) for v, T in enumerate(places))
    else:
        views = tuple(Viewpoint(name, *place) for name, place in given.items())
    images = take_images(truth.legs, machines, views, settings.images, shared_poses=shared)
    progress("Cameras", 1, 1)
    rows = list(range(len(images)))
    if settings.level is not Level.PHOTOGRAPHS:
        rows = [row for row in rows if images.seen(row)]
    return _Session(
        truth, poses, pose_labels(len(poses)), machines, views, images.chosen(rows),
        len(images) - len(rows),
    )  # fmt: skip


def _measurements(
    session: _Session, settings: SimulationSettings, chance: dict[str, np.random.Generator]
) -> Measurements:
    """Return the rows of the dataset: readings with their errors, and what is told of cameras."""
    legs, images = session.truth.leg_names, session.images
    # Tables say themselves what is seen; in photographs nobody looks for a leg that often hides.
    least = _OFTEN if settings.level is Level.PHOTOGRAPHS else 0.0
    views = []
    for v, view in enumerate(session.views):
        T = rough_pose(view.T_base_camera, chance["hints"])
        shown = tuple(legs[j] for j in images.seen_in_view(v, least))
        hint = shown if 0 < len(shown) < len(legs) else None
        hints = (T, hint) if settings.hints else (None, None)
        views.append(View(view.name, view.camera, *hints))
    q, size = session.poses.readings, settings.readings.size
    if settings.readings.distribution is Distribution.UNIFORM:
        q = q + chance["readings"].uniform(-size, size, q.shape)
    else:
        q = q + size * chance["readings"].normal(size=q.shape)
    names = [""] * len(images)
    if settings.level is Level.PHOTOGRAPHS:
        names = image_names(images, session.views, session.labels)
    return measurements_of(images, views, session.labels, names, q, settings.encoder_sigma)


def _write_observations(
    folder: Path,
    session: _Session,
    m: Measurements,
    settings: SimulationSettings,
    chance: dict[str, np.random.Generator],
) -> None:
    """Write the tables that the level asks for, and the exact outlines beside the truth."""
    images, machines, views = session.images, session.machines, session.views
    legs = session.truth.leg_names
    exact = outlines_of_images(images, machines, views, 0.0, None)
    write_observations(folder / TRUTH / "outlines.csv", exact, m, legs)
    if settings.level is Level.OUTLINES:
        noisy = outlines_of_images(
            images, machines, views, settings.sigma_px, chance["observations"]
        )
        write_observations(folder / OBSERVATIONS_NAME, noisy, m, legs)
    elif settings.level is Level.AXES:
        axes = axes_of_images(images, machines, views, settings.table, chance["observations"])
        write_axis_table(folder / AXES_NAME, axes.row, axes.leg, axes.values, axes.sigmas, m, legs)
