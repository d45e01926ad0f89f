"""``legcal evaluate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from legcal.cli.options import JsonOption, ModelArgument
from legcal.cli.output import print_json, print_table


def evaluate(
    model: ModelArgument,
    reference: Annotated[
        str, typer.Argument(metavar="REFERENCE", help="The model to compare with, often the truth.")
    ],
    dataset: Annotated[
        Path | None,
        typer.Option(
            "--dataset",
            metavar="DATASET",
            help="Compare at the readings of this dataset instead of 100 random poses.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare two models: platform errors of eq (20), and every parameter."""
    from legcal.report.accuracy import evaluate as run

    evaluation = run(model, reference, dataset=dataset)
    if as_json:
        print_json(evaluation.document())
    else:
        from legcal.report.accuracy_table import accuracy_table

        print_table(accuracy_table(evaluation))
