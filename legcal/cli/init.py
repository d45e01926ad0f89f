"""``legcal init``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from legcal.cli.options import JsonOption, print_json, print_table


def init(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER",
            help="The photographs, in it or in one folder for each camera position. It is not "
            "changed.",
        ),
    ],
    readings: Annotated[
        Path,
        typer.Option(
            "--readings",
            metavar="FILE",
            help="A CSV with a column for each encoder; optional columns image, view, pose, time.",
        ),
    ],
    model: Annotated[
        str, typer.Option("--model", metavar="MODEL", help="The nominal model, as for inspect.")
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="The dataset folder to write.")
    ],
    camera: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[VIEW=]FILE",
            help="The camera file of all views, or of one (repeat it); by default camera_info.yaml "
            "beside the photographs, else a rough one by the focal length in their EXIF data.",
        ),
    ] = None,
    unit: Annotated[
        str | None,
        typer.Option(
            help="Unit of the readings: m, cm, mm, um; rad, mrad, deg, us for motors that turn; by "
            "default from the headings, else the unit that puts them in the travel."
        ),
    ] = None,
    lengths: Annotated[
        bool, typer.Option("--lengths", help="The table holds whole lengths of legs.")
    ] = False,
    encoder_sigma: Annotated[
        str | None,
        typer.Option(
            help="Sigma of a reading, 2um or 0.5deg; by default the last digit of the table, or "
            "0.5deg for pulses of servos."
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace existing files.")] = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Do not show which reading each image gets.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Make a dataset from a folder of photographs and a table of readings."""
    from legcal.data.new_dataset import SheetOptions, plan_new_dataset, write_new_dataset
    from legcal.report.session import matching_table, written_lines

    options = SheetOptions(
        cameras=camera or (), unit=unit, lengths=lengths, encoder_sigma=encoder_sigma
    )
    dataset = plan_new_dataset(folder, readings, model, output, options)
    if not as_json and not quiet:
        print_table(matching_table(dataset))
    written = write_new_dataset(dataset, force=force)
    if as_json:
        print_json(dataset.document(written))
    else:
        print_table(written_lines(output, written, dataset.machine))
