"""``legcal study``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from legcal.cli.options import JsonOption
from legcal.cli.output import print_json, print_table
from legcal.cli.processors import processors


def study(
    name: Annotated[
        str,
        typer.Argument(metavar="NAME", help="Which study: paper (its section 4.3)."),
    ],
    runs: Annotated[int, typer.Option(help="Number of runs.")] = 100,
    seed: Annotated[int, typer.Option(help="Seed of all runs.")] = 0,
    workers: Annotated[
        int | None,
        typer.Option(help="Processes; all cores without it. Results do not depend on it."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="OUT",
            help="Folder for the runs, the document and the figures. A study that was stopped "
            "goes on from what is there.",
        ),
    ] = None,
    radians: Annotated[
        bool,
        typer.Option("--radians", help="paper: take the angles of Table 1 as radians, as printed."),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Measure on many simulated machines what is claimed; their truth is known."""
    from legcal.report.progress_bars import progress_on_stderr
    from legcal.studies.catalogue import study_named
    from legcal.studies.runner import run_study

    chosen = study_named(name, radians=radians)
    with progress_on_stderr() as progress:
        result = run_study(
            chosen,
            runs,
            seed=seed,
            workers=processors() if workers is None else workers,
            output=output,
            progress=progress,
        )
    if as_json:
        print_json(result.document())
    else:
        from rich.console import Group
        from rich.text import Text

        where = [Text(f"\nRuns, document and figures: {output}")] if output is not None else []
        print_table(Group(result.summary.table(), *where))
