"""``legcal new``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from legcal.cli.options import JsonOption
from legcal.cli.output import print_json, print_table


def new(
    table: Annotated[
        Path | None,
        typer.Argument(
            metavar="[TABLE]", help="A YAML or CSV table of the legs.", show_default=False
        ),
    ] = None,
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="DIR", help="The folder of models/ and urdf/."),
    ] = ...,  # type: ignore[assignment]
    family: Annotated[
        str | None, typer.Option(help="Instead of a table: number and type of legs, 6-UPS.")
    ] = None,
    unit: Annotated[str | None, typer.Option(help="Unit of all lengths: mm or m.")] = None,
    name: Annotated[str | None, typer.Option(help="Name of the model and its files.")] = None,
    base_radius: Annotated[float | None, typer.Option(help="Circle of the base joints.")] = None,
    platform_radius: Annotated[
        float | None, typer.Option(help="Circle of the platform joints.")
    ] = None,
    height: Annotated[float | None, typer.Option(help="Of the platform over the base.")] = None,
    base_spread: Annotated[
        float | None, typer.Option(help="Angle in a pair of base joints (6 legs), in degrees: 30.")
    ] = None,
    platform_spread: Annotated[
        float | None, typer.Option(help="Angle in a pair of platform joints: 30.")
    ] = None,
    turn: Annotated[
        float | None,
        typer.Option(help="Of the platform about z, in degrees: 0; planar 30."),
    ] = None,
    offset: Annotated[float | None, typer.Option(help="Leg length at reading zero.")] = None,
    travel: Annotated[
        tuple[float, float] | None, typer.Option(help="Lowest and highest reading.")
    ] = None,
    leg_radius: Annotated[float | None, typer.Option(help="Radius of tube and rod.")] = None,
    tilt: Annotated[
        float | None,
        typer.Option(help="Of R and U axes from their default, in degrees: 0."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace files that are there.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Write a model, YAML and URDF, from a table of joints or a few dimensions."""
    from legcal.authoring.create import create_model
    from legcal.authoring.request import described
    from legcal.mechanism.inspect import describe

    dimensions = {
        "base_radius": base_radius,
        "platform_radius": platform_radius,
        "height": height,
        "base_spread": base_spread,
        "platform_spread": platform_spread,
        "turn": turn,
        "offset": offset,
        "travel": travel,
        "leg_radius": leg_radius,
        "tilt": tilt,
    }
    asked = described(table, family=family, unit=unit, name=name, dimensions=dimensions)
    created = create_model(asked, output, force=force)
    description = describe(created.mechanism)
    if as_json:
        paths = {"yaml": str(created.yaml_path), "urdf": str(created.urdf_path)}
        print_json(description | {"paths": paths})
    else:
        from rich.text import Text

        from legcal.report.inspect_table import inspect_table

        print_table(inspect_table(description))
        print_table(Text(f"\nwritten: {created.yaml_path} {created.urdf_path}", overflow="ignore"))
