"""Arguments and options that several commands share."""

from typing import Annotated

import typer

ModelArgument = Annotated[
    str,
    typer.Argument(
        metavar="MODEL",
        help="A mechanism YAML, a URDF, an MJCF file, a robot.yaml folder or a shipped name.",
    ),
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print one JSON document on stdout and nothing else there.")
]
WorkersOption = Annotated[
    int | None,
    typer.Option(min=1, help="Processes that search images; by default as many as calibrate."),
]
