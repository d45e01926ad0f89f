"""``legcal inspect``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from legcal.cli.options import JsonOption, ModelArgument
from legcal.cli.output import print_json, print_table


def inspect(
    model: ModelArgument,
    as_json: JsonOption = False,
    write: Annotated[
        Path | None,
        typer.Option(
            "--write",
            metavar="DIR",
            help="Write the model down as DIR/models/NAME.yaml and DIR/urdf/NAME.urdf.",
        ),
    ] = None,
) -> None:
    """Show a mechanism as legcal understands it: legs, joints, frames, mobility."""
    from legcal.mechanism.inspect import describe
    from legcal.mechanism.load import load_mechanism

    mechanism = load_mechanism(model)
    description = describe(mechanism)
    if write is not None:
        from legcal.report.model_files import write_model

        for path in write_model(mechanism, write):
            typer.echo(f"Wrote {path}.", err=True)
    if as_json:
        print_json(description)
    else:
        from legcal.report.inspect_table import inspect_table

        print_table(inspect_table(description))
