"""Commands on machines and results: make, show, analyse, compare, locate, export."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from legcal.cli.options import (
    ForceOption,
    HandHeldOption,
    JsonOption,
    ModelArgument,
    NoiseOption,
    OnlyOption,
    as_lines,
    print_json,
    print_table,
    serve,
    show,
)
from legcal.errors import UsageError, printable

if TYPE_CHECKING:
    from legcal.machine.model import Machine

_FAMILY = "Dimensions of --family"


def new(
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="DIR", help="The folder of models/ and urdf/."),
    ],
    table: Annotated[
        Path | None,
        typer.Argument(
            metavar="[FILE]",
            help="A YAML or CSV table of the legs, or the configuration of a firmware.",
            show_default=False,
        ),
    ] = None,
    family: Annotated[
        str | None, typer.Option(help="In place of a table: hexapod or delta.")
    ] = None,
    unit: Annotated[str | None, typer.Option(help="Unit of all lengths: mm, m, in.")] = None,
    name: Annotated[str | None, typer.Option(help="Name of the model and its files.")] = None,
    type: Annotated[
        str | None, typer.Option(help="Type of the legs, where the table has none: UPS.")
    ] = None,
    min_length: Annotated[
        float | None,
        typer.Option(help="Shortest length of a leg, where readings are zero."),
    ] = None,
    max_length: Annotated[float | None, typer.Option(help="Longest length of a leg.")] = None,
    leg_radius: Annotated[float | None, typer.Option(help="Radius of tube and rod.")] = None,
    height: Annotated[
        float | None, typer.Option(help="Height of the platform above the base at home.")
    ] = None,
    base_radius: Annotated[
        float | None,
        typer.Option(
            help="Radius of the circle of base joints, or motors.", rich_help_panel=_FAMILY
        ),
    ] = None,
    platform_radius: Annotated[
        float | None,
        typer.Option(help="Radius of the circle of platform joints.", rich_help_panel=_FAMILY),
    ] = None,
    arm_length: Annotated[
        float | None, typer.Option(help="Length of the arms of a delta.", rich_help_panel=_FAMILY)
    ] = None,
    rod_length: Annotated[
        float | None, typer.Option(help="Length of the rods of a delta.", rich_help_panel=_FAMILY)
    ] = None,
    template: Annotated[
        bool,
        typer.Option(
            "--template", help="Write a commented table to start from, of --family or a hexapod."
        ),
    ] = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write a model, YAML and URDF, from a table of joints, a firmware or a few dimensions."""
    from legcal.descriptions.new_model import (
        Dimensions,
        create_model,
        description_of,
        write_template,
    )
    from legcal.machine.inspection import machine_document
    from legcal.report.machine import inspect_table
    from legcal.report.render import report

    dimensions = Dimensions(
        family=family,
        unit=unit,
        name=name,
        type=type,
        min_length=min_length,
        max_length=max_length,
        leg_radius=leg_radius,
        height=height,
        base_radius=base_radius,
        platform_radius=platform_radius,
        arm_length=arm_length,
        rod_length=rod_length,
    )
    if template:
        if table is not None:
            raise UsageError(
                f"The template could not be written: found the table {table} beside --template, "
                "needed one of them; leave out the other."
            )
        written = write_template(output, dimensions, force=force)
        lines = (
            *(f"written: {path}" for path in written),
            "Next:",
            f"  legcal new {shlex.quote(str(written[0]))} -o .",
        )
        show(
            as_json,
            lambda: {"paths": {path.suffix[1:]: str(path) for path in written}},
            lambda: as_lines(lines),
        )
        return
    description: dict[str, Any] = {}

    def shown(machine: Machine, notes: tuple[str, ...]) -> None:
        description.update(machine_document(machine))
        description["diagnostics"] = [*notes, *description["diagnostics"]]
        if not as_json:
            print_table(inspect_table(description))

    created = create_model(description_of(table, dimensions), output, force=force, before=shown)
    paths = {"yaml": str(created.yaml_path), "urdf": str(created.urdf_path)}
    lines = (
        *(f"written: {path}" for path in paths.values()),
        "Next, with a folder of photographs and a table of readings:",
        f"  legcal init PHOTOGRAPHS --readings READINGS.csv --model {shlex.quote(paths['yaml'])} "
        "-o session",
    )
    show(
        as_json,
        lambda: description | {"paths": paths},
        lambda: report(lines),
    )


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
    picture: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.svg", help="Draw the machine at home, its joints numbered, as SVG."
        ),
    ] = None,
    base: Annotated[
        str | None,
        typer.Option(metavar="LINK", help="The base of a URDF or MJCF file that leaves it open."),
    ] = None,
    platform: Annotated[
        str | None,
        typer.Option(metavar="LINK", help="Its platform; one of several mechanisms."),
    ] = None,
    leg_radius: Annotated[
        float | None,
        typer.Option(
            metavar="MM", min=1e-3, help="Radius of the legs that it draws without a cylinder [mm]."
        ),
    ] = None,
) -> None:
    """Show a mechanism as legcal understands it: legs, joints, frames, mobility."""
    from legcal.machine.inspection import machine_document
    from legcal.machine.loader import load_mechanism
    from legcal.machine.model_writer import write_model
    from legcal.machine.picture import MACHINE_PICTURE, draw_machine
    from legcal.report.machine import inspect_table

    if picture is not None:
        if picture.suffix.lower() != ".svg":
            raise UsageError(
                f"{picture}: the picture could not be written: found another ending, needed .svg; "
                "give the name of an SVG file."
            )
        MACHINE_PICTURE.check_place(picture)
    radius = None if leg_radius is None else 1e-3 * leg_radius
    machine = load_mechanism(model, base=base, platform=platform, leg_radius=radius)
    description = machine_document(machine)
    if picture is not None:
        MACHINE_PICTURE.write(picture, draw_machine(machine).markup())
        typer.echo(printable(f"Wrote {picture}."), err=True)
    if write is not None:
        for path in write_model(machine, write):
            typer.echo(printable(f"Wrote {path}."), err=True)
    show(as_json, lambda: description, lambda: inspect_table(description))


def identify(
    model: Annotated[
        str,
        typer.Argument(
            metavar="MODEL|DATASET",
            help="A mechanism as for inspect, or a dataset folder (its own views are analysed).",
        ),
    ],
    view: Annotated[
        list[str] | None,
        typer.Option(
            "--view",
            metavar="LEG,LEG,...",
            help="The legs that one camera position shows; once for each position. Without any, "
            "three positions show all legs.",
        ),
    ] = None,
    images: Annotated[
        int | None, typer.Option(help="Images per view, each at another pose; 15 by default.")
    ] = None,
    board: Annotated[
        bool,
        typer.Option(
            "--board",
            help="A calibration board on the base is seen in every image and relates the cameras "
            "to each other.",
        ),
    ] = False,
    platform_board: Annotated[
        bool,
        typer.Option(
            "--platform-board",
            help="A calibration board on the platform is seen in every image.",
        ),
    ] = False,
    hand_held: HandHeldOption = False,
    noise: NoiseOption = None,
    only: OnlyOption = None,
    as_json: JsonOption = False,
) -> None:
    """Report which parameters are identifiable, and how to make the others so."""
    from legcal.calibration.identify.identifiability import answer
    from legcal.report.machine import identify_table

    views = [text.split(",") for text in view or []]
    identified = answer(
        model,
        views,
        images,
        board=board,
        platform_board=platform_board,
        hand_held=hand_held,
        noise=noise,
        only=only,
    )
    show(as_json, identified.document, lambda: identify_table(identified))


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
    from legcal.calibration import evaluation
    from legcal.report.calibration import accuracy_table

    evaluated = evaluation.evaluate(model, reference, dataset=dataset)
    show(as_json, evaluated.document, lambda: accuracy_table(evaluated))


def locate(
    model: ModelArgument,
    poses: Annotated[
        Path,
        typer.Argument(metavar="POSES", help="A CSV of readings and tool poses in the world."),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="The YAML to write.")
    ],
    position_sigma: Annotated[
        str | None,
        typer.Option(
            help="Sigma of each coordinate of a position, 0.02mm; by default from the residuals."
        ),
    ] = None,
    angle_sigma: Annotated[
        str | None,
        typer.Option(help="Sigma of an orientation, 0.01deg; by default from the residuals."),
    ] = None,
    tool_position: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z",
            help="Tool in the platform, in metres, where the measured poses do not determine it; "
            "0,0,0 by default.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Find the base in the world and the tool in the platform from measured tool poses."""
    from legcal.calibration.location import locate
    from legcal.calibration.location.document import (
        LOCATION_FILE,
        location_document,
        write_location,
    )
    from legcal.calibration.location.tool_poses import read_tool_poses
    from legcal.files.quantity import ANGLE, LENGTH, parse_quantity
    from legcal.machine.loader import load_mechanism
    from legcal.report.machine import location_table, poses_table

    def quantity(text: str | None, units: Mapping[str, float], option: str) -> float | None:
        return None if text is None else parse_quantity(text, units, option)

    LOCATION_FILE.check_place(output)
    machine = load_mechanism(model)
    measured = read_tool_poses(poses, machine)
    if not as_json:
        print_table(poses_table(measured))
    location = locate.locate(
        machine,
        measured,
        position_sigma=quantity(position_sigma, LENGTH, "--position-sigma"),
        angle_sigma=quantity(angle_sigma, ANGLE, "--angle-sigma"),
        tool_position=None if tool_position is None else _point(tool_position),
    )
    write_location(location, output)
    written = [str(output)]
    show(
        as_json,
        lambda: location_document(location) | {"written": written},
        lambda: location_table(location, written),
    )
    if not location.trustworthy:
        raise typer.Exit(1)


def _point(text: str) -> list[float]:
    """Return three lengths, in metres or with their units."""
    from legcal.files.quantity import read_value

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


def export(
    source: Annotated[
        str,
        typer.Argument(
            metavar="RESULT|MODEL",
            help="The folder that calibrate wrote, or a mechanism as for inspect.",
        ),
    ],
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="FORMAT",
            help="table, csv, json, urdf, mjcf, linuxcnc, klipper, reprapfirmware, marlin, flypt, "
            "python, c, matlab, ros or correction.",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="PATH", help="The file to write; of ros a folder."),
    ],
    nodes: Annotated[
        int | None,
        typer.Option(help="correction: nodes along each coordinate; by default by freedoms."),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write a calibration or a model for another program or a controller."""
    from legcal.exports import formats

    exported = formats.export(source, to, output, nodes=nodes, force=force)
    lines = [f"written: {path}" for path in exported.paths] + list(exported.notes)
    show(
        as_json,
        exported.document,
        lambda: as_lines(lines),
    )


def view(
    source: Annotated[
        str,
        typer.Argument(
            metavar="MODEL|RESULT|DATASET",
            help="A mechanism as for inspect, the folder that calibrate wrote, or a dataset.",
        ),
    ],
    dataset: Annotated[
        Path | None,
        typer.Option(help="The dataset of a result or a model, for its poses and photographs."),
    ] = None,
    host: Annotated[
        str, typer.Option(help="Access: 127.0.0.1 for this machine only, 0.0.0.0 for all.")
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="The port; 0 for any that is free.")
    ] = 8080,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the browser.")
    ] = True,
) -> None:
    """Show a machine in the browser, moved by sliders: readings, pose, photographs, uncertainty."""
    from rich.text import Text

    from legcal.viewer.server import Address, check_address
    from legcal.viewer.source import open_source
    from legcal.viewer.view_server import ViewServer

    address = Address(host, port)
    check_address(address)
    server = ViewServer(open_source(source, dataset), address)
    name = printable(server.source.name)
    print_table(Text(f"{server.address} shows {name}; Ctrl-C ends it.", overflow="fold"))
    serve(server, browser=browser)


def example(
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="The new folder for it.")
    ],
    as_json: JsonOption = False,
) -> None:
    """Copy the dataset that comes with legcal: a hexapod, 45 photographs (11 MB)."""
    from legcal.data.new_dataset import copy_example

    copy_example(output)
    lines = (
        f"written: {output}",
        "Next:",
        f"  legcal calibrate {shlex.quote(str(output))} -o calibrated",
    )
    show(
        as_json,
        lambda: {"path": str(output)},
        lambda: as_lines(lines),
    )


def schema(
    name: Annotated[
        str | None,
        typer.Argument(metavar="[NAME]", help="The format; without it their names are listed."),
    ] = None,
) -> None:
    """Print the JSON Schema of a file or document, for editors and programs that check them."""
    from legcal.files.folder import schema_content, schema_names
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
