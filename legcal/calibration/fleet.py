"""Many machines, each calibrated from its own dataset into its own result folder.

A machine is one piece of work for a process or a worker of a cluster. A result folder that is
complete is the checkpoint of its machine: ``--resume`` reads it instead of calibrating again.
"""

from __future__ import annotations

import json
import math
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
from pydantic import Field

from legcal.calibration.evaluation import evaluate
from legcal.calibration.pipeline import calibrate
from legcal.calibration.result import Calibration
from legcal.calibration.result_folder import RESULT_NAME, load_result
from legcal.cluster import Stamp, stamp_of
from legcal.errors import DatasetError, LegcalError, OutOfResources, UsageError
from legcal.files.folder import TEMPORARY_SUFFIX, OutputKind, check_destination, write_atomically
from legcal.files.schema import Document, Number
from legcal.files.table import Column, format_table, read_table
from legcal.progress import Progress, shown_progress
from legcal.workers import Workers, worker_pool

_CACHE = "use_cache"  # results do not depend on it
FLEET = OutputKind("fleet", "summary.json", "legcal_fleet")
TABLE_NAME = "summary.csv"
_LONGEST_NAME = 255  # [bytes] of a folder
MADE_OF = "made_of.json"  # in the result folder of a machine: its dataset, and what was asked
STAGE = "Calibrating machines"


@dataclass(frozen=True)
class FleetMachine:
    """A machine of a fleet."""

    name: str  # of its result folder
    dataset: Path  # its folder
    earlier: Path | None = None  # result folder that its drift is counted from

    @classmethod
    def of(cls, dataset: Path, name: str = "", earlier: Path | None = None) -> FleetMachine:
        """Return a machine that has the name of its dataset's folder where it has none."""
        return cls(name or _folder_of(dataset).name, dataset, earlier)


class MachineRow(Document):
    """What became of a machine; null where there is nothing to say."""

    name: str
    dataset: str
    status: Literal["trustworthy", "doubtful", "failed"]
    verdict: str  # or why it failed
    kind: str | None = None  # of the error that it failed by
    images: int | None = None
    change_dX_m: Number | None = None  # of the platform against the nominal model, mean
    change_dE_rad: Number | None = None
    sigma_dX_m: Number | None = None  # predicted, of the calibrated platform, mean
    sigma_dE_rad: Number | None = None
    sigma_dX_max_m: Number | None = None
    drift_dX_m: Number | None = None  # of the platform against the earlier result, mean
    drift_dE_rad: Number | None = None
    drift_sigma_dX_m: Number | None = None  # predicted for the drift, of both results
    drift_note: str | None = None  # why there is no drift


class FleetDocument(Document):
    """What became of all machines."""

    legcal_fleet: Literal[1] = 1
    machines: list[MachineRow] = Field(default_factory=list)
    counts: dict[str, int] = Field(default_factory=dict)  # machines by status
    notes: list[str] = Field(default_factory=list)  # on workers that differ


@dataclass(frozen=True)
class FleetOptions:
    """What is asked of every machine, as :func:`legcal.calibrate` takes it."""

    arguments: Mapping[str, Any] = field(default_factory=dict)
    # Called as page(calibration, output, folder): what it writes into the folder appears in output
    page: Callable[[Calibration, Path, Path], None] | None = None

    def made_of(self, machine: FleetMachine) -> str:
        """Return what a result depends on, as it is written beside it."""
        asked = {name: self.arguments[name] for name in sorted(self.arguments.keys() - {_CACHE})}
        found = {"legcal_made_of": 1, "dataset": str(machine.dataset), "options": asked}
        return json.dumps(found, indent=1, default=str) + "\n"


def read_fleet(path: Path) -> list[FleetMachine]:
    """Return the machines of a list: columns ``dataset``, and ``name`` and ``earlier`` or not.

    Paths count from the folder of the list.

    Raises
    ------
    DatasetError
        If it is no such table.
    """
    columns = (
        Column("dataset", "text"),
        Column("name", "text", required=False, blank=True),
        Column("earlier", "text", required=False, blank=True),
    )
    table = read_table(path, "list of machines", "machine", columns, needed="a row a machine")
    table.check()
    rows = zip(*(table.text(name) for name in ("dataset", "name", "earlier")), strict=True)
    return [
        FleetMachine.of(path.parent / dataset, name, path.parent / earlier if earlier else None)
        for dataset, name, earlier in rows
    ]


def calibrate_fleet(
    machines: Sequence[FleetMachine],
    output: str | Path,
    *,
    options: FleetOptions | None = None,
    workers: Workers = 1,
    resume: bool = False,
    progress: Progress = False,
) -> FleetDocument:
    """Calibrate machines, each into a folder of its name, and write a summary of all.

    Parameters
    ----------
    machines : sequence of FleetMachine
        The machines, of different names.
    output : path
        The folder of the fleet.
    options : FleetOptions, optional
        What is asked of every machine.
    workers : int, str or executor
        Calibrate machines there, as :func:`legcal.calibrate` searches images.
    resume : bool
        Take results that stand in the folder, if they are of the same dataset and options, and
        newer than the files of the dataset.
    progress : bool or callable
        True shows a bar on stderr; a function is called as ``progress(stage, done, total)``.

    Returns
    -------
    FleetDocument
        In the order of the machines; those that failed are named and do not stop the others.

    Raises
    ------
    UsageError
        If names are no folders or not different, or the folder holds something else.
    OutOfResources
        If a file cannot be written, or workers are lost; results that are there stay.
    """
    folder = Path(output).absolute()
    machines = [_absolute(machine) for machine in machines]
    _check(machines, folder)
    options = options or FleetOptions()
    found: dict[str, MachineRow] = {}
    if resume:
        found |= {row.name: row for row in map(partial(_kept, options, folder), machines) if row}
    if not (folder / FLEET.marker).exists():
        _write(folder / FLEET.marker, FleetDocument())
    token = stamp_of(folder / FLEET.marker)
    notes: tuple[str, ...] = ()
    with shown_progress(progress) as report:
        report(STAGE, len(found), len(machines))
        left = [machine for machine in machines if machine.name not in found]
        failure = "The machines could not be calibrated"
        if left:
            with worker_pool(workers, failure, in_order=False) as run:
                task = partial(_calibrated, options, folder, token)
                # Where they lie; then those that are sent, since workers lack them.
                for rows in (_where_they_lie(left), _sent(left, found)):
                    for row, files in run(task, rows):
                        if row is None:
                            continue
                        _write_files(folder / row.name, files)
                        found[row.name] = row
                        report(STAGE, len(found), len(machines))
                notes = run.notes
    every = [found[machine.name] for machine in machines]
    document = FleetDocument(
        machines=every, counts=dict(Counter(row.status for row in every)), notes=list(notes)
    )
    _write(folder / TABLE_NAME, document)
    _write(folder / FLEET.marker, document)
    return document


def _absolute(machine: FleetMachine) -> FleetMachine:
    """Return a machine whose files workers in other folders find."""
    earlier = None if machine.earlier is None else machine.earlier.absolute()
    return replace(machine, dataset=_folder_of(machine.dataset), earlier=earlier)


def _folder_of(dataset: Path) -> Path:
    """Return the folder of a dataset, which may be given by its ``dataset.yaml``."""
    folder = Path(os.path.abspath(dataset))  # "." and ".." have no name
    return folder.parent if folder.is_file() else folder


def _check(machines: Sequence[FleetMachine], folder: Path) -> None:
    """Refuse machines that cannot have folders of their own, and a folder of something else."""
    start = "The fleet could not be calibrated: found"
    if not machines:
        raise UsageError(f"{start} no machine, needed one or more; name their datasets.")
    for machine in machines:
        name = machine.name
        is_one = bool(name) and Path(name).name == name and len(os.fsencode(name)) <= _LONGEST_NAME
        if not is_one or name.startswith(".") or name in (FLEET.marker, TABLE_NAME):
            raise UsageError(
                f"{start} the name '{name}' of {machine.dataset}, needed one that a folder can "
                "have; give another in the column name of the list."
            )
    for name, n in Counter(machine.name for machine in machines).items():
        if n > 1:
            raise UsageError(
                f"{start} {n} machines of the name '{name}', needed different ones, as each has "
                "its own folder; give names in the column name of a list (--list)."
            )
    check_destination(folder, FLEET)


def _kept(options: FleetOptions, folder: Path, machine: FleetMachine) -> MachineRow | None:
    """Return the row of a machine whose result is there, of its dataset, and newer than that."""
    result = folder / machine.name / RESULT_NAME
    try:
        if (result.parent / MADE_OF).read_text(encoding="utf-8") != options.made_of(machine):
            return None
        made = os.stat(result).st_mtime_ns
        tables = [*machine.dataset.glob("*.yaml"), *machine.dataset.glob("*.csv")]
        if any(os.stat(path).st_mtime_ns > made for path in tables):
            return None
        return _row(machine, result.parent)
    except (OSError, ValueError, DatasetError):
        return None


# On workers

_Row = tuple[FleetMachine, Stamp | None, dict[str, bytes] | None]
"""A machine, the stamp of its dataset file, and its files if they are sent."""


def _where_they_lie(machines: Sequence[FleetMachine]) -> Iterator[_Row]:
    for machine in machines:
        yield machine, stamp_of(machine.dataset / "dataset.yaml"), None


def _sent(machines: Sequence[FleetMachine], found: dict[str, MachineRow]) -> Iterator[_Row]:
    """Yield machines that are not done with all of their files, which are read one by one.

    Those whose files cannot be read have failed.
    """
    for machine in machines:
        if machine.name in found:
            continue
        try:
            files = _files_in(machine.dataset, "dataset/")
            if machine.earlier is not None:
                files |= _files_in(machine.earlier, "earlier/")
        except OSError as error:
            found[machine.name] = _failed(
                machine,
                DatasetError(
                    f"{error.filename}: the file could not be sent to workers: found "
                    f"'{error.strerror}', needed one that can be read; correct its permissions."
                ),
            )
            continue
        yield machine, None, files


def _files_in(folder: Path, name: str = "") -> dict[str, bytes]:
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return {name + path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def _write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files; ``result.json``, which says that all are there, comes last."""
    for name, content in sorted(files.items(), key=lambda file: file[0] == RESULT_NAME):
        path = folder / name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, content)
        except OSError as error:
            raise _not_written(path, error) from error


def _calibrated(
    options: FleetOptions, folder: Path, token: Stamp | None, row: _Row
) -> tuple[MachineRow | None, dict[str, bytes]]:
    """Return what became of a machine, None if its files are not here; and its result if sent."""
    machine, stamp, files = row
    if files is None:
        stamps = stamp_of(folder / FLEET.marker), stamp_of(machine.dataset / "dataset.yaml")
        if stamps != (token, stamp):
            return None, {}
        return _calibrate(options, machine, folder / machine.name, machine), {}
    with TemporaryDirectory(suffix=TEMPORARY_SUFFIX) as temporary:
        here_in = Path(temporary)
        (here_in / "dataset").mkdir()
        _write_files(here_in, files)
        earlier = None if machine.earlier is None else here_in / "earlier"
        local = replace(machine, dataset=here_in / "dataset", earlier=earlier)
        found = _calibrate(options, local, here_in / "result", machine)
        made = _files_in(here_in / "result")
        there, here = str(machine.dataset).encode(), str(local.dataset).encode()
        return found, {name: content.replace(here, there) for name, content in made.items()}


def _calibrate(
    options: FleetOptions, machine: FleetMachine, output: Path, named: FleetMachine
) -> MachineRow:
    """Calibrate a machine; a refusal is what became of it, and no other error is."""
    try:

        def beside(found: Calibration, folder: Path) -> None:
            if options.page is not None:
                options.page(found, output, folder)
            (folder / MADE_OF).write_text(options.made_of(named), encoding="utf-8")

        calibrate(machine.dataset, output=output, beside=beside, **options.arguments)
        row = _row(machine, output)
    except OutOfResources:
        raise
    except LegcalError as error:
        return _failed(named, error, str(machine.dataset))
    return row.model_copy(update={"dataset": str(named.dataset)})


def _failed(machine: FleetMachine, error: LegcalError, there: str = "") -> MachineRow:
    """Return the row of a machine that failed; its dataset was *there* meanwhile."""
    here = str(machine.dataset)
    return MachineRow(
        name=machine.name,
        dataset=here,
        status="failed",
        verdict=str(error).replace(there or here, here),
        kind=type(error).__name__,
    )


def _row(machine: FleetMachine, output: Path) -> MachineRow:
    """Return the row of a machine with a result."""
    result = load_result(output).result
    numbers: dict[str, Any] = {}
    if (platform := result.platform) is not None:
        names = ("change_dX_m", "change_dE_rad", "sigma_dX_m", "sigma_dE_rad", "sigma_dX_max_m")
        numbers |= {name: getattr(platform, name) for name in names}
    if machine.earlier is not None:
        numbers |= _drift(output, machine.earlier)
    return MachineRow(
        name=machine.name,
        dataset=str(machine.dataset),
        status="trustworthy" if result.trustworthy else "doubtful",
        verdict=result.verdict,
        images=None if result.observations is None else result.observations.images,
        **numbers,
    )


def _drift(output: Path, earlier: Path) -> dict[str, float | str]:
    """Return how far the platform is from where the earlier result has it, or why nobody knows."""
    try:
        before, now = load_result(earlier), load_result(output)
        apart = evaluate(now.machine, before.machine)
    except LegcalError as error:
        return {"drift_note": str(error)}
    if len(apart.displacement) == 0:
        return {"drift_note": "The motors do not determine the platform."}
    found: dict[str, float | str] = {
        "drift_dX_m": float(apart.displacement.mean()),
        "drift_dE_rad": float(apart.rotation.mean()),
    }
    platforms = [one.result.platform for one in (before, now)]
    sigmas = [(one.workspace or one).sigma_dX_m for one in platforms if one is not None]
    if len(sigmas) == 2:
        found["drift_sigma_dX_m"] = math.hypot(*sigmas)
    return found


# The summary

_DEG = float(np.degrees(1.0))
_COLUMNS: dict[str, tuple[str, float]] = {
    "change_mm": ("change_dX_m", 1e3), "change_deg": ("change_dE_rad", _DEG),
    "sigma_mm": ("sigma_dX_m", 1e3), "sigma_deg": ("sigma_dE_rad", _DEG),
    "sigma_max_mm": ("sigma_dX_max_m", 1e3),
    "drift_mm": ("drift_dX_m", 1e3), "drift_deg": ("drift_dE_rad", _DEG),
    "drift_sigma_mm": ("drift_sigma_dX_m", 1e3),
}  # fmt: skip


def fleet_columns() -> list[str]:
    """Return the heading of the summary."""
    return ["name", "status", "images", *_COLUMNS, "verdict", "dataset"]


def fleet_cells(row: MachineRow) -> list[str]:
    """Return a row of the summary in mm and degrees."""
    values = [(getattr(row, name), factor) for name, factor in _COLUMNS.values()]
    numbers = ["" if value is None else f"{factor * value:.6g}" for value, factor in values]
    images = "" if row.images is None else str(row.images)
    verdict = " ".join(row.verdict.split())
    return [row.name, row.status, images, *numbers, verdict, row.dataset]


def _write(path: Path, document: FleetDocument) -> None:
    """Write the summary, as a table or a document."""
    if path.suffix == ".csv":
        text = format_table(fleet_columns(), map(fleet_cells, document.machines))
    else:
        text = json.dumps(document.document(), indent=1, allow_nan=False) + "\n"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, text.encode())
    except OSError as error:
        raise _not_written(path, error) from error


def _not_written(path: Path, error: OSError) -> OutOfResources:
    return OutOfResources(
        f"{path}: the file could not be written: found '{error.strerror}', needed a folder that "
        "takes it; free some space and start the same command with --resume."
    )
