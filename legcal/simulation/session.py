"""What ``legcal simulate`` tells about the dataset that it wrote."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from legcal.data import Measurements
from legcal.errors import OutOfResources, UsageError
from legcal.files import output_path
from legcal.geometry import Array, Image
from legcal.machine import Mechanism, load_mechanism, write_model
from legcal.progress import Report, no_progress
from legcal.simulation.board import without_pose
from legcal.simulation.folder import (
    SIMULATED,
    TRUTH,
    TRUTH_NAME,
    check_dataset_destination,
    dataset_folder,
    files_in,
    write_session,
    write_truth,
)
from legcal.simulation.imaged_machine import image_machine
from legcal.simulation.poses import are_extreme
from legcal.simulation.recording import recorded, write_tables
from legcal.simulation.rendering.appearance import Appearance
from legcal.simulation.rendering.scene import Scene, prepare_scene
from legcal.simulation.settings import Level, SimulationSettings, whole_number
from legcal.simulation.solids import PlacedSolid, PosedMachine
from legcal.simulation.truth import write_true_model
from legcal.simulation.visibility import Images, Viewpoint
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


_STREAMS = ("errors", "poses", "cameras", "readings", "hints", "observations", "photographs",
            "corners")  # fmt: skip


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
    n_extreme : int
        Poses with every motor near an end of its travel.
    """

    folder: Path
    level: Level
    nominal: Mechanism
    truth: Mechanism
    truth_path: Path
    measurements: Measurements
    seen: Array
    left_out: int
    n_extreme: int


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
    destination = output_path(output, SIMULATED)
    whole_number("workers", workers, 1)
    check_dataset_destination(destination, force=force)
    nominal = model if isinstance(model, Mechanism) else load_mechanism(model)
    _check_readings(nominal, settings)
    chance = _streams(settings.seed)
    with dataset_folder(destination, force=force) as folder:
        yaml_path, _ = write_model(nominal, folder)
        truth = write_true_model(nominal, settings.errors, chance["errors"], folder / TRUTH)
        imaged = image_machine(truth, nominal, settings, chance, progress)
        m = recorded(imaged, settings, chance)
        board = None if imaged.board is None else imaged.board.document()
        told = board if settings.board_pose else without_pose(board)
        model_name = yaml_path.relative_to(folder).as_posix()
        write_session(folder, nominal, model_name, m, groups=imaged.groups, board=told)
        write_tables(folder, imaged, m, settings, chance)
        if settings.level is Level.PHOTOGRAPHS:
            take_photographs(
                folder, m.image, imaged.images, imaged.machines, imaged.views,
                settings.appearance, chance["photographs"], workers, progress,
            )  # fmt: skip
        files = [*files_in(folder), TRUTH_NAME]
        write_truth(
            folder / TRUTH_NAME, settings, truth, imaged.views, imaged.poses,
            imaged.labels, files, board,
        )  # fmt: skip
    readings = imaged.poses.readings[np.unique(imaged.images.pose)]
    return SimulatedDataset(
        folder=destination,
        level=settings.level,
        nominal=nominal,
        truth=truth,
        truth_path=destination / TRUTH / "models" / truth.yaml_path.name,
        measurements=m,
        seen=np.array([[leg.is_seen for leg in shown] for shown in imaged.images.shown]),
        left_out=imaged.left_out,
        n_extreme=int(np.sum(are_extreme(truth, readings))),
    )


def _check_readings(nominal: Mechanism, settings: SimulationSettings) -> None:
    """Refuse errors of readings that are larger than what is read."""
    travel = min((np.ptp(nominal.legs[j].travel) for j in nominal.motors), default=np.inf)
    if settings.readings.size > travel:
        raise UsageError(
            f"The readings could not be simulated: found errors of {settings.readings.size:g} m, "
            f"needed at most the shortest travel of a motor, {travel:g} m; give them with the "
            "unit that is meant."
        )


def _streams(seed: int) -> dict[str, np.random.Generator]:
    """Return a source of chance for every purpose."""
    children = np.random.SeedSequence(seed).spawn(len(_STREAMS))
    return {
        name: np.random.default_rng(child) for name, child in zip(_STREAMS, children, strict=True)
    }


def summary_document(made: SimulatedDataset) -> dict[str, Any]:
    """Return the document of ``legcal simulate --json``."""
    views = {}
    for v, view in enumerate(made.measurements.views):
        rows = made.measurements.view == v
        seen = made.seen[rows].sum(axis=0).tolist()
        legs = dict(zip(made.nominal.leg_names, seen, strict=True))
        views[view.name] = {"images": int(np.sum(rows)), "legs": legs}
    return {
        "dataset": str(made.folder),
        "level": made.level.value,
        "mechanism": made.nominal.name,
        "truth": str(made.truth_path),
        "images": made.measurements.n_rows,
        "poses": made.measurements.n_poses,
        "extreme_poses": made.n_extreme,
        "left_out": made.left_out,
        "views": views,
    }


def summary_table(made: SimulatedDataset) -> RenderableType:
    """Return what was simulated as people read it: how many images of a view show each leg."""
    document = summary_document(made)
    size = f"{_count(document['images'], 'image')} of {_count(document['poses'], 'pose')}"
    heading = Text.assemble((document["mechanism"], "bold"), f": {document['level']}, {size}")
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("view", overflow="fold")
    table.add_column("images", justify="right")
    for name in made.nominal.leg_names:
        table.add_column(Text(name), justify="right")
    for name, view in document["views"].items():
        counts = [str(n) for n in view["legs"].values()]
        table.add_row(Text(name), str(view["images"]), *counts)
    folder = shlex.quote(str(made.folder))
    lines = [
        "Images of each view that show 40 % of a leg or more in one piece.",
        *([_left_out(made.left_out)] if made.left_out else []),
        f"{made.n_extreme} of {made.measurements.n_poses} poses have every motor near an end of "
        "its travel.",
        f"\nwritten: {made.folder}",
        f"the true model: {made.truth_path}",
        f"calibrate with: legcal calibrate {folder} -o OUT",
        f"judge with: legcal evaluate OUT/calibrated.yaml {shlex.quote(str(made.truth_path))}",
        *([f"measure noise with: legcal noise {folder}"] if _is_repeated(made) else []),
    ]
    return Group(heading, Text(), table, Text(), *(Text(s, overflow="fold") for s in lines))


def _is_repeated(made: SimulatedDataset) -> bool:
    """Say whether there are several photographs of a pose in a view."""
    m = made.measurements
    places = set(zip(m.view.tolist(), m.pose.tolist(), strict=True))
    return made.level is Level.PHOTOGRAPHS and len(places) < m.n_rows


def _left_out(n: int) -> str:
    """Return how many images are left out, in words."""
    return (
        "1 image shows no leg and is left out."
        if n == 1
        else f"{n} images show no leg and are left out."
    )


def _count(n: int, what: str) -> str:
    """Return a number of things."""
    return f"{n} {what}{'s' * (n != 1)}"
