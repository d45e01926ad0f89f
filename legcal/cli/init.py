"""``legcal init``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

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
            "beside the photographs.",
        ),
    ] = None,
    unit: Annotated[
        str | None,
        typer.Option(
            help="Unit of the readings: m, cm, mm, um, of motors that turn rad, mrad, deg, us; by "
            "default as the headings say, else the one in which they lie in the travel."
        ),
    ] = None,
    servo: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[JOINT=]CENTRE,US_PER_DEG",
            help="Pulses of hobby servos: 1500,11.1 for all, or of one (repeat it); negative us "
            "for one degree where longer pulses turn it backwards. By default as the model says.",
        ),
    ] = None,
    lengths: Annotated[
        bool, typer.Option("--lengths", help="The table holds whole lengths of legs.")
    ] = False,
    views: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,NAME,...",
            help="Use only these views (folders of FOLDER).",
        ),
    ] = None,
    view_pattern: Annotated[
        str | None,
        typer.Option(
            metavar="PATTERN",
            help="Which part of the file names is the view, where all photographs are in one "
            "folder: '{view}_*' for left_012.jpg, '*-{view}' for 012-left.jpg.",
        ),
    ] = None,
    match: Annotated[
        Literal["name", "time", "order"] | None,
        typer.Option(
            help="How photographs and rows are matched; by default by names, else by times, else "
            "in order."
        ),
    ] = None,
    encoder_sigma: Annotated[
        str | None,
        typer.Option(
            help="Sigma of a reading, 2um or 0.5deg; by default the last digit of the table, of "
            "pulses of servos 0.5deg."
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show the matching and write nothing.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace files that are there.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Make a dataset from a folder of photographs and a table of readings."""
    from legcal.data.new_dataset import plan_new_dataset, write_new_dataset
    from legcal.report.new_dataset import matching_table, written_lines

    found = plan_new_dataset(
        folder,
        readings,
        model,
        output,
        cameras=camera or (),
        unit=unit,
        lengths=lengths,
        views=[] if views is None else views.split(","),
        view_pattern=view_pattern,
        by=match,
        encoder_sigma=encoder_sigma,
        servos=servo or (),
    )
    if not as_json:
        print_table(matching_table(found))
    written = [] if dry_run else write_new_dataset(found, force=force)
    if as_json:
        print_json(found.document(written))
    elif written:
        print_table(written_lines(output, written, found.machine))
