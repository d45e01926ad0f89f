"""``legcal calibrate``."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from legcal.cli.options import JsonOption
from legcal.cli.output import print_json, print_table
from legcal.cli.processors import processors

MOST_WORKERS = 4  # processes that search images; each takes about 150 MB


class Criteria(StrEnum):
    """What the four steps minimise."""

    DEFAULT = "default"
    LITERAL = "literal"


_PARAMETERS = "Parameters by name (or a pattern: '*.offset'); each may be repeated"


def calibrate(
    dataset: Annotated[
        Path, typer.Argument(metavar="DATASET", help="The folder that holds dataset.yaml.")
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUT", help="The result folder to write.")
    ],
    as_json: JsonOption = False,
    criteria: Annotated[
        Criteria,
        typer.Option(help="What the four steps minimise: legcal's criteria, or the paper's."),
    ] = Criteria.DEFAULT,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Detect again, even where a cached detection fits.")
    ] = False,
    prior: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE+-SIGMA",
            help="What is known already: leg1.length=0.4200+-0.0001, or 420+-0.1mm.",
            rich_help_panel=_PARAMETERS,
        ),
    ] = None,
    fix: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[=VALUE]",
            help="Leave as the model has it, or at a value.",
            rich_help_panel=_PARAMETERS,
        ),
    ] = None,
    free: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Look for what is fixed otherwise (camera, twists), and for radii without a "
            "prior.",
            rich_help_panel=_PARAMETERS,
        ),
    ] = None,
) -> None:
    """Compute the calibrated model from images and encoder readings."""
    from legcal.pipeline import calibrate as run
    from legcal.report.progress_bars import progress_on_stderr
    from legcal.report.result import result_document

    with progress_on_stderr() as progress:
        calibration = run(
            dataset,
            output=output,
            progress=progress,
            criteria=criteria.value,
            use_cache=not fresh,
            workers=min(processors(), MOST_WORKERS),
            priors=prior or (),
            fixed=fix or (),
            free=free or (),
        )
    if as_json:
        print_json(result_document(calibration))
    else:
        from legcal.report.summary import summary

        print_table(summary(calibration, output))
    if not calibration.verdict.trustworthy:
        raise typer.Exit(1)
