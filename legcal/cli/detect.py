"""``legcal detect``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from legcal.cli.calibrate import MOST_WORKERS
from legcal.cli.options import JsonOption, WorkersOption
from legcal.cli.output import print_json, print_table
from legcal.processors import processors


def detect(
    dataset: Annotated[
        Path, typer.Argument(metavar="DATASET", help="The folder that holds dataset.yaml.")
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="OUT",
            help="The folder to write: observations.csv, index.html and every image with what was "
            "found in it.",
        ),
    ],
    workers: WorkersOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find the outlines of the legs and show them over the images, to see what went wrong."""
    from legcal.detecting import detect as run
    from legcal.overlays.folder import detection_document, picture_names
    from legcal.report.progress_bars import progress_on_stderr

    with progress_on_stderr() as progress:
        found = run(
            dataset,
            output=output,
            progress=progress,
            workers=workers or min(processors(), MOST_WORKERS),
        )
    document = detection_document(found, picture_names(found))
    if as_json:
        print_json(document)
    else:
        from legcal.overlays.table import detection_table

        print_table(detection_table(document, output))
    if found.unplaced or document["used"] == 0:
        raise typer.Exit(1)
