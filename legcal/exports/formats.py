"""The table of formats, and writing their files completely or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
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
from legcal.exports.subject import RESULT_NAME, ExportOptions, Rendered, Subject, load_subject
from legcal.files.folder import OutputFile, OutputKind, result_folder
from legcal.files.schema import Document, Number, SparseDocument
from legcal.machine.model import Machine

if TYPE_CHECKING:
    from legcal.calibration.result_folder import EarlierResult

Render = Callable[[Subject, ExportOptions, Path], Rendered]


@dataclass(frozen=True)
class Format:
    """A format: its renderer, its restrictions and its options."""

    render: Render  # files from a subject, options and the requested path
    # reason for refusing a machine, or None
    refusal: Callable[[Subject], str | None] = lambda _: None
    is_folder: bool = False
    options: tuple[str, ...] = ()  # supported fields of ExportOptions


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
    "correction": Format(correction_files, correction_refusal, options=("nodes",)),
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
    options: ExportOptions | None = None,
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
    options : ExportOptions, optional
        Options of some formats.
    force : bool
        Replace existing files.

    Raises
    ------
    UsageError
        If the format is unknown, does not have an option, or the path cannot be written.
    OutOfClass
        If the format does not support the type of machine.
    """
    given = ExportOptions() if options is None else options
    format = _format(to)
    _check_options(to, format, given)
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
    rendered = format.render(subject, given, destination)
    places = [_beside(destination, file.name) for file in rendered.files]
    if format.is_folder:
        places = [destination / file.name for file in rendered.files]
    _keep_sources(subject, places)
    if format.is_folder:
        paths = _write_folder(destination, rendered, force=force)
    else:
        paths = tuple(places)
        for place in paths:
            _FILE.check_place(place, force=force)
        for place, file in zip(paths, rendered.files, strict=True):
            _FILE.write(place, file.content, force=force)
    return Exported(to, paths, rendered.notes, dict(rendered.figures))


def _beside(destination: Path, ending: str) -> Path:
    """Return the place of a file of an export: a picture stands beside, under its name."""
    return destination.with_name(destination.name + ending) if ending else destination


def formats_of(subject: Subject) -> tuple[str, ...]:
    """Return the formats that support the type of machine."""
    return tuple(name for name, format in FORMATS.items() if format.refusal(subject) is None)


def _format(to: str) -> Format:
    """Return a format by name."""
    if to not in FORMATS:
        raise UsageError(
            f"The export could not be written: found the format '{to}', needed one of "
            f"{', '.join(FORMATS)}; give one of them with --to."
        )
    return FORMATS[to]


def _check_options(to: str, format: Format, given: ExportOptions) -> None:
    """Refuse options that the format does not support."""
    nothing = ExportOptions()
    for name in vars(nothing):
        if getattr(given, name) != getattr(nothing, name) and name not in format.options:
            takes = [
                other for other, other_format in FORMATS.items() if name in other_format.options
            ]
            raise UsageError(
                f"--{name} could not be used: found it with --to {to}, needed "
                f"{' or '.join(takes)}; leave it out."
            )


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


def _write_folder(destination: Path, rendered: Rendered, *, force: bool) -> tuple[Path, ...]:
    names = [Path(file.name) for file in rendered.files]
    there = [str(name) for name in names if os.path.lexists(destination / name)]
    if there and not force:
        raise UsageError(
            f"{destination}: the export could not be written: found {' and '.join(there)} already "
            "there, needed a new folder or --force; give another folder."
        )
    with result_folder(destination, _FOLDER) as folder:
        for name, file in zip(names, rendered.files, strict=True):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(file.content)
    return tuple(destination / name for name in names)
