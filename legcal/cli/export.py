"""``legcal export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from legcal.cli.options import JsonOption, show


def export(
    source: Annotated[
        str,
        typer.Argument(
            metavar="RESULT|MODEL",
            help="The folder that calibrate wrote, or a mechanism as for inspect.",
        ),
    ],
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="FORMAT",
            help="table, csv, json, urdf, mjcf, linuxcnc, klipper, reprapfirmware, marlin, flypt, "
            "python, c, matlab, ros or correction.",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="PATH", help="The file to write; of ros a folder."),
    ],
    inertia: Annotated[
        bool,
        typer.Option(
            "--inertia", help="urdf, ros: give links without inertia a stub, for simulators."
        ),
    ] = False,
    nodes: Annotated[
        int | None,
        typer.Option(help="correction: nodes along each coordinate; by default by freedoms."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace existing files.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Write a calibration or a model for another program or a controller."""
    from rich.text import Text

    from legcal.exports import formats
    from legcal.exports.subject import ExportOptions
    from legcal.report.render import report

    exported = formats.export(
        source,
        to,
        output,
        options=ExportOptions(inertia=inertia, nodes=nodes),
        force=force,
    )
    lines = [f"written: {path}" for path in exported.paths] + list(exported.notes)
    show(
        as_json,
        exported.document,
        lambda: report([Text(line, overflow="fold") for line in lines]),
    )
