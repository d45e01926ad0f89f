"""A whole dataset of a simulated machine: nominal model in, dataset and truth out (section 4.3)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from legcal.errors import UsageError
from legcal.geometry.types import Array
from legcal.mechanism.load import load_mechanism
from legcal.mechanism.model import Mechanism
from legcal.observations.measurements import Measurements
from legcal.progress import Report, no_progress
from legcal.report.destination import output_path
from legcal.report.model_files import write_model
from legcal.simulation.dataset_files import write_session, write_truth
from legcal.simulation.extremes import are_extreme
from legcal.simulation.folder import (
    SIMULATED,
    TRUTH,
    TRUTH_NAME,
    check_dataset_destination,
    dataset_folder,
    files_in,
)
from legcal.simulation.imaged_machine import image_machine
from legcal.simulation.photographs import take_photographs
from legcal.simulation.placed_board import without_pose
from legcal.simulation.recording import recorded, write_tables
from legcal.simulation.settings import Level, SimulationSettings, whole_number
from legcal.simulation.truth import write_true_model

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
