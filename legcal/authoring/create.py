"""The files of a described machine: written complete and loadable, or not at all."""

import os
from dataclasses import dataclass
from pathlib import Path

from legcal.authoring.assembled import Assembled, assemble
from legcal.authoring.machine import Description
from legcal.authoring.writer import urdf_text, yaml_text
from legcal.errors import LegcalError, OutOfResources, UsageError
from legcal.files.atomic import temporary_folder
from legcal.mechanism.load import load_mechanism
from legcal.mechanism.model import Mechanism


@dataclass(frozen=True, eq=False)
class Created:
    """A model that was written.

    Attributes
    ----------
    mechanism : Mechanism
        The model as legcal understands it.
    yaml_path, urdf_path : Path
        Its files.
    """

    mechanism: Mechanism
    yaml_path: Path
    urdf_path: Path


def create_model(described: Description, output: Path, *, force: bool = False) -> Created:
    """Write ``models/NAME.yaml`` and ``urdf/NAME.urdf`` of a machine, and load them.

    Parameters
    ----------
    described : Description
        The machine, of a table or a family.
    output : Path
        The folder that gets ``models`` and ``urdf``; it is made if there is none.
    force : bool
        Replace files that are there.

    Raises
    ------
    ModelError, OutOfClass, DidNotConverge
        If the machine cannot be put together or is outside the method; nothing is left behind.
    UsageError
        If a file is there already and ``force`` is not given, or a folder is.
    OutOfResources
        If the files cannot be written.
    """
    machine = assemble(described)
    paths = model_paths(machine.name, output)
    folders = [str(path) for path in paths if path.is_dir()]
    if folders:
        raise UsageError(
            f"{described.source}: the model '{machine.name}' could not be written: found the "
            f"folder {folders[0]}, needed a place for a file; give another --name or --output."
        )
    there = [str(path) for path in paths if os.path.lexists(path)]
    if there and not force:
        raise UsageError(
            f"{described.source}: the model '{machine.name}' could not be written: found "
            f"{' and '.join(there)} already there, needed new files; give another --name or "
            "--output, or --force to replace them."
        )
    try:
        return _write(machine, described.source, output)
    except OSError as error:
        raise OutOfResources(
            f"{output}: the model could not be written: found '{error.strerror}', needed a folder "
            "that takes it; free space, correct permissions, or choose another --output."
        ) from error


def model_paths(name: str, output: Path) -> tuple[Path, Path]:
    """Return where the YAML and the URDF of a model go."""
    return output / "models" / f"{name}.yaml", output / "urdf" / f"{name}.urdf"


def _write(machine: Assembled, source: str, output: Path) -> Created:
    """Write and load the files aside, then move them to their places."""
    made = [path for path in (output, *output.parents) if not path.exists()]
    output.mkdir(parents=True, exist_ok=True)
    try:
        with temporary_folder(output, machine.name) as aside:
            written = model_paths(machine.name, aside)
            for path, text in zip(written, (yaml_text(machine), urdf_text(machine)), strict=True):
                path.parent.mkdir()
                path.write_bytes(text.encode())
            _load(written[0], aside, source)
            places = model_paths(machine.name, output)
            for path in places:
                if not path.parent.is_dir():
                    path.parent.mkdir()
                    made.insert(0, path.parent)
            for path, place in zip(reversed(written), reversed(places), strict=True):
                os.replace(path, place)  # the YAML last: a URDF alone is no model
    except BaseException:
        for folder in made:
            if folder.is_dir() and not os.listdir(folder):
                folder.rmdir()
        raise
    return Created(load_mechanism(places[0]), *places)


def _load(path: Path, aside: Path, source: str) -> None:
    """Load the files where they were written aside; problems name the source instead."""
    try:
        load_mechanism(path)
    except LegcalError as error:
        told = [p.replace(f"{aside}{os.sep}", f"{source}: ") for p in error.problems]
        raise type(error)(told) from error
