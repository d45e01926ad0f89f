"""``legcal locate``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from legcal.cli.options import JsonOption, ModelArgument
from legcal.cli.output import print_json, print_table
from legcal.errors import UsageError


def locate(
    model: ModelArgument,
    poses: Annotated[
        Path,
        typer.Argument(metavar="POSES", help="A CSV of readings and tool poses in the world."),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="The YAML to write.")
    ] = ...,  # type: ignore[assignment]
    urdf: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Write models/ and urdf/ with world and tool in them."),
    ] = None,
    position_sigma: Annotated[
        str | None,
        typer.Option(help="Of a measured position, a component: 0.02mm; else from the residuals."),
    ] = None,
    angle_sigma: Annotated[
        str | None,
        typer.Option(help="Of a measured orientation: 0.01deg; else from the residuals."),
    ] = None,
    encoder_sigma: Annotated[str | None, typer.Option(help="Of a reading: 2um; 0 else.")] = None,
    tool_position: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z",
            help="Of the tool in the platform [m], taken where the machine leaves it open; 0,0,0 "
            "else.",
        ),
    ] = None,
    world_link: Annotated[str, typer.Option(help="Of --urdf: the name of the world link.")] = (
        "world"
    ),
    tool_link: Annotated[str, typer.Option(help="Of --urdf: the name of the tool link.")] = "tool",
    as_json: JsonOption = False,
) -> None:
    """Find the base in the world and the tool in the platform from measured tool poses."""
    from legcal.files.quantity import ANGLE, LENGTH, parse_quantity
    from legcal.location.document import LOCATION_FILE, location_document, write_location
    from legcal.location.locate import locate as run
    from legcal.location.urdf_frames import write_located_model
    from legcal.mechanism.load import load_mechanism

    if urdf is None and (world_link, tool_link) != ("world", "tool"):
        raise UsageError(
            "The names of the links could not be used: found them without --urdf, needed the "
            "folder of the model to write; name it or leave the names out."
        )

    def quantity(text: str | None, units: Mapping[str, float], what: str) -> float | None:
        return None if text is None else parse_quantity(text, units, what)

    LOCATION_FILE.check_place(output)
    mechanism = load_mechanism(model)
    location = run(
        mechanism,
        poses,
        position_sigma=quantity(position_sigma, LENGTH, "--position-sigma"),
        angle_sigma=quantity(angle_sigma, ANGLE, "--angle-sigma"),
        encoder_sigma=quantity(encoder_sigma, LENGTH, "--encoder-sigma") or 0.0,
        tool_position=None if tool_position is None else _point(tool_position),
    )
    written = []
    if urdf is not None:
        paths = write_located_model(mechanism, location, urdf, world=world_link, tool=tool_link)
        written += [str(path) for path in paths]
    write_location(location, output)
    written.append(str(output))
    if as_json:
        print_json(location_document(location) | {"written": written})
    else:
        from legcal.location.table import location_table

        print_table(location_table(location, written))
    if not location.trustworthy:
        raise typer.Exit(1)


def _point(text: str) -> list[float]:
    """Return three lengths, in metres or with their units."""
    from legcal.files.stated import read_value

    try:
        values = [read_value(part) for part in text.split(",")]
    except ValueError as error:
        raise UsageError(f"--tool-position could not be used: {error}") from error
    if len(values) != 3 or any(value.dimension not in ("", "m") for value in values):
        raise UsageError(
            f"--tool-position could not be used: found '{text}', needed three lengths x,y,z in the "
            "platform; write them like 0,0,0.05 or 0mm,0mm,50mm."
        )
    return [value.value for value in values]
