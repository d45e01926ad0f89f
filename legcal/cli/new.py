"""``legcal new``: most of its options are the fields of ``Dimensions``."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Any

import typer

from legcal.cli.options import JsonOption, declare, declared, parameters_of, show
from legcal.errors import UsageError
from legcal.machine.dimensions import Dimensions


def new(
    table: Annotated[
        Path | None,
        typer.Argument(
            metavar="[FILE]",
            help="A YAML or CSV table of the legs, or the configuration of a firmware.",
            show_default=False,
        ),
    ] = None,
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="DIR", help="The folder of models/ and urdf/."),
    ] = ...,  # type: ignore[assignment]
    template: Annotated[
        bool,
        typer.Option(
            "--template", help="Write a commented table to start from, of --family or a hexapod."
        ),
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace existing files.")] = False,
    as_json: JsonOption = False,
    **options: Any,
) -> None:
    """Write a model, YAML and URDF, from a table of joints, a firmware or a few dimensions."""
    from rich.text import Text

    from legcal.machine.family import description_of, write_template
    from legcal.machine.inspection import machine_document
    from legcal.machine.model_builder import create_model
    from legcal.report.machine import inspect_table
    from legcal.report.render import report

    dimensions = Dimensions(**options)
    if template:
        if table is not None:
            raise UsageError(
                f"The template could not be written: found the table {table} beside --template, "
                "needed one of them; leave out the other."
            )
        written = write_template(output, dimensions, force=force)
        lines = (
            f"written: {' '.join(map(str, written))}",
            f"Next: legcal new {shlex.quote(str(written[0]))} -o .",
        )
        show(
            as_json,
            lambda: {"paths": {path.suffix[1:]: str(path) for path in written}},
            lambda: report([Text(line, overflow="ignore") for line in lines]),
        )
        return
    model = description_of(table, dimensions)
    created = create_model(model, output, force=force)
    description = machine_document(created.machine)
    description["diagnostics"] = [*model.notes, *description["diagnostics"]]
    paths = {"yaml": str(created.yaml_path), "urdf": str(created.urdf_path)}
    written_line = f"written: {paths['yaml']} {paths['urdf']}"
    show(
        as_json,
        lambda: description | {"paths": paths},
        lambda: report(inspect_table(description), Text(written_line, overflow="ignore")),
    )


_table, _output, *_others = parameters_of(new)
declare(new, [_table, _output, *declared(Dimensions), *_others])
