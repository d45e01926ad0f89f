"""``legcal import``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from legcal.cli.options import JsonOption, QuietOption, print_json, print_table


def import_(
    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="RECORDING...",
            help="A video, a ROS bag (.bag, .mcap, folder) or a folder of images with times for "
            "each camera position; views are named after them. Of a bag with several cameras the "
            "topic of one: BAG:/left/image_raw.",
        ),
    ],
    model: Annotated[
        str, typer.Option("--model", metavar="MODEL", help="The nominal model, as for inspect.")
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="The dataset folder to write.")
    ],
    camera: Annotated[
        list[str],
        typer.Option(
            metavar="[VIEW=]FILE", help="The camera file of all views, or of one (repeat it)."
        ),
    ],
    readings: Annotated[
        list[Path] | None,
        typer.Option(
            "--readings",
            metavar="FILE",
            help="A CSV with a column time and one for each encoder: for all recordings, or one "
            "for each in their order; bags may hold joint states instead.",
        ),
    ] = None,
    lengths: Annotated[
        bool, typer.Option("--lengths", help="The table holds whole lengths of legs.")
    ] = False,
    offset: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS",
            help="Camera clock minus reading clock; by default estimated from the motion.",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace existing files.")] = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Make a dataset from recordings of a machine that rests at each pose."""
    from legcal.progress import shown_progress
    from legcal.recordings.importing import import_recordings, plan_import
    from legcal.report.session import import_table, written_lines

    with shown_progress(not quiet) as progress:
        plan = plan_import(
            sources,
            model,
            output,
            readings=readings or (),
            cameras=camera,
            lengths=lengths,
            offset=offset,
            progress=progress,
        )
    if not as_json:
        print_table(import_table(plan))
    with shown_progress(not quiet) as progress:
        written = import_recordings(plan, force=force, progress=progress)
    if as_json:
        print_json(plan.document(written))
    else:
        print_table(written_lines(output, written, plan.machine))
