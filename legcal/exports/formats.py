"""The table of formats, and writing their files completely or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from legcal.errors import OutOfClass, UsageError
from legcal.exports.correction import correction_files, correction_refusal
from legcal.exports.firmware import (
    firmware_files,
    firmware_refusal,
    flypt_files,
    flypt_refusal,
    hexapod_refusal,
    linuxcnc_files,
)
from legcal.exports.kinematics_code import c_files, kinematics_refusal, matlab_files, python_files
from legcal.exports.parameter_files import csv_files, json_files, table_files
from legcal.exports.robot_files import mjcf_files, mjcf_refusal, ros_files, urdf_files
from legcal.exports.subject import RESULT_NAME, Rendered, Subject, load_subject
from legcal.files.folder import OutputFile, OutputKind, result_folder
from legcal.files.schema import Document, Number, SparseDocument
from legcal.machine.model import Machine

if TYPE_CHECKING:
    from legcal.calibration.result_folder import EarlierResult

Render = Callable[..., Rendered]


@dataclass(frozen=True)
class Format:
    """A format: its renderer and its restrictions."""

    render: Render  # files from a subject and the requested path
    # reason for refusing a machine, or None
    refusal: Callable[[Subject], str | None] = lambda _: None
    is_folder: bool = False
    has_nodes: bool = False  # whether it is rendered with a number of nodes, if one is given


FORMATS: dict[str, Format] = {
    "table": Format(table_files),
    "csv": Format(csv_files),
    "json": Format(json_files),
    "urdf": Format(urdf_files),
    "mjcf": Format(mjcf_files, mjcf_refusal),
    "linuxcnc": Format(linuxcnc_files, hexapod_refusal),
    **{
        name: Format(partial(firmware_files, name), partial(firmware_refusal, name))
        for name in ("klipper", "reprapfirmware", "marlin")
    },
    "flypt": Format(flypt_files, flypt_refusal),
    "python": Format(python_files, kinematics_refusal),
    "c": Format(c_files, kinematics_refusal),
    "matlab": Format(matlab_files, kinematics_refusal),
    "ros": Format(ros_files, is_folder=True),
    "correction": Format(correction_files, correction_refusal, has_nodes=True),
}
_FILE = OutputFile("the export", "export", "", "a new file or --force")
_FOLDER = OutputKind("export", "", "")


@dataclass(frozen=True)
class Exported:
    """The written files."""

    format: str
    paths: tuple[Path, ...]
    notes: tuple[str, ...]
    figures: dict[str, Any]

    def document(self) -> dict[str, Any]:
        """Return the document of ``legcal export --json``."""
        written = [str(path) for path in self.paths]
        return ExportDocument(
            format=self.format, written=written, **self.figures, notes=list(self.notes)
        ).document()


class Residual(Document):
    """Errors of the platform between the nodes of a table."""

    rms_dX_m: Number
    max_dX_m: Number
    rms_dE_rad: Number
    max_dE_rad: Number


class Remaining(Document):
    """Errors of a firmware over the workspace [mm]."""

    rms: Number
    max: Number


class ExportDocument(SparseDocument):
    """The document of ``legcal export --json``: files, and figures of a correction or firmware."""

    format: str
    written: list[str]
    coordinates: list[str] | None = None
    nodes: int | None = None
    residual: Residual | None = None  # with the corrected commands
    uncorrected: Residual | None = None
    tested: int | None = None  # number of tested middles of cells
    remaining_mm: Remaining | None = None  # with the written numbers of a firmware
    nominal_mm: Remaining | None = None  # with those of the nominal model
    notes: list[str]


def export(
    source: str | Path | Machine | EarlierResult | Subject,
    to: str,
    path: str | Path,
    *,
    nodes: int | None = None,
    force: bool = False,
) -> Exported:
    """Write a model or a result in another format.

    Parameters
    ----------
    source : path, name, Machine or EarlierResult
        A result folder, its ``result.json``, what :func:`legcal.load_result` returned, or a
        mechanism.
    to : str
        One of ``FORMATS``.
    path : path
        The file to write, or the folder for ``ros``.
    nodes : int, optional
        Nodes of a ``correction`` along each coordinate.
    force : bool
        Replace existing files.

    Raises
    ------
    UsageError
        If the format is unknown, has no nodes, or the path cannot be written.
    OutOfClass
        If the format does not support the type of machine.
    """
    if to not in FORMATS:
        raise UsageError(
            f"The export could not be written: found the format '{to}', needed one of "
            f"{', '.join(FORMATS)}; give one of them with --to."
        )
    format, with_nodes = FORMATS[to], [name for name in FORMATS if FORMATS[name].has_nodes]
    if nodes is not None and to not in with_nodes:
        raise UsageError(
            f"--nodes could not be used: found it with --to {to}, needed "
            f"{' or '.join(with_nodes)}; leave it out."
        )
    destination = Path(path)
    if str(path) == "":
        raise UsageError(
            "The export could not be written: found an empty text, needed the path of a file."
        )
    if not format.is_folder:
        _FILE.check_place(destination, force=force)
    subject = source if isinstance(source, Subject) else load_subject(source)
    refusal = format.refusal(subject)
    if refusal is not None:
        raise OutOfClass(
            f"{subject.given}: --to {to} could not be written: {refusal}; this machine has "
            f"{', '.join(formats_of(subject))}."
        )
    options = {} if nodes is None else {"nodes": nodes}
    rendered = format.render(subject, destination, **options)
    places = tuple(
        destination / name
        if format.is_folder
        else destination.with_name(destination.name + name)  # a picture stands beside
        for name in rendered.files
    )
    _keep_sources(subject, places)
    if format.is_folder:
        _write_folder(destination, rendered.files, force=force)
    else:
        for place in places:
            _FILE.check_place(place, force=force)
        for place, content in zip(places, rendered.files.values(), strict=True):
            _FILE.write(place, content, force=force)
    return Exported(to, places, (*subject.warning, *rendered.notes), dict(rendered.figures))


def formats_of(subject: Subject) -> tuple[str, ...]:
    """Return the formats that support the type of machine."""
    return tuple(name for name, format in FORMATS.items() if format.refusal(subject) is None)


def _keep_sources(subject: Subject, places: Sequence[Path]) -> None:
    """Refuse to replace the exported files."""
    sources = [subject.machine.yaml_path, subject.machine.urdf_path]
    if subject.result is not None:
        sources.append(subject.result.folder / RESULT_NAME)
    for place in places:
        there = [source for source in sources if os.path.exists(source) and os.path.exists(place)]
        if any(os.path.samefile(source, place) for source in there):
            raise UsageError(
                f"{place}: the export could not be written: found a file of {subject.given}, which "
                "is exported, needed another one; give another path."
            )


def _write_folder(destination: Path, files: Mapping[str, bytes], *, force: bool) -> None:
    there = [name for name in files if os.path.lexists(destination / name)]
    if there and not force:
        raise UsageError(
            f"{destination}: the export could not be written: found {' and '.join(there)} already "
            "there, needed a new folder or --force; give another folder."
        )
    with result_folder(destination, _FOLDER) as folder:
        for name, content in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
