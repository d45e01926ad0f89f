"""``legcal schema``."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from legcal.cli.options import print_json
from legcal.errors import UsageError


def schema(
    name: Annotated[
        str | None,
        typer.Argument(metavar="[NAME]", help="The format; without it their names are listed."),
    ] = None,
) -> None:
    """Print the JSON Schema of a file or document, for editors and programs that check them."""
    from legcal.files.published import schema_content, schema_names
    from legcal.files.schema import closest

    names = schema_names()
    if name is None:
        typer.echo("\n".join(names))
    elif name in names:
        print_json(json.loads(schema_content(name)))
    else:
        raise UsageError(
            f"The schema could not be printed: found no format '{name}', needed one of those that "
            f"have a schema; {closest(name, names)}"
        )
