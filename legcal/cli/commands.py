"""The commands other than ``calibrate``, ``simulate`` and ``study``."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from legcal.cli.options import (
    ClusterOption,
    DatasetArgument,
    JsonOption,
    ModelArgument,
    PageOption,
    QuietOption,
    WorkersOption,
    check_page,
    image_workers,
    print_table,
    show,
    write_page,
)
from legcal.errors import UsageError, printable
from legcal.vision.distortion import CameraProgram, DistortionModel

if TYPE_CHECKING:
    from legcal.calibration.detection import Detection
    from legcal.calibration.examination import Examination


def camera(
    images: Annotated[
        list[str],
        typer.Argument(
            metavar="IMAGES...",
            help="Photographs of the board: files, folders, patterns; with --to a camera file, "
            "with --compare two.",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="The camera file to write."),
    ] = None,
    board: Annotated[
        str | None,
        typer.Option(
            metavar="SPEC",
            help="chessboard:9x6:25mm (squares), charuco:7x5:40mm:29mm:DICT_4X4_50 (square, "
            "marker), aprilgrid:6x6:88mm:0.3 (gap as a fraction of a tag), or a YAML file with a "
            "block board, or a target of Kalibr or Basalt.",
        ),
    ] = None,
    model: Annotated[
        DistortionModel | None,
        typer.Option(help="Distortion model; by default chosen by the images."),
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A PNG to write: corners and residuals over the field."),
    ] = None,
    to: Annotated[
        CameraProgram | None,
        typer.Option(help="Convert a camera file of any program into the form of this one."),
    ] = None,
    compare: Annotated[
        bool, typer.Option("--compare", help="Compare two camera files over the image.")
    ] = False,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Calibrate a camera from photographs of a chessboard, ChArUco board or AprilGrid."""
    from rich.text import Text

    from legcal.calibration.camera_calibration.calibration import calibrate_camera
    from legcal.calibration.camera_calibration.projection import compare_cameras
    from legcal.report.machine import camera_table, comparison_table
    from legcal.report.render import report
    from legcal.vision.camera_export import convert_camera
    from legcal.vision.camera_file import read_camera

    if compare:
        others = board, output, model, picture, to
        if len(images) != 2 or any(other is not None for other in others):
            raise UsageError(
                "The cameras could not be compared: found other arguments than two camera files, "
                "needed legcal camera A B --compare; leave out the others."
            )
        comparison = compare_cameras(*(read_camera(Path(image)) for image in images))
        show(as_json, comparison.document, lambda: comparison_table(comparison))
        return
    if output is None:
        raise UsageError(
            "The camera could not be written: found no --output, needed the file to write; add -o "
            "camera_info.yaml."
        )
    if to is not None:
        calibrating = board is not None or model is not None or picture is not None
        if len(images) != 1 or calibrating or as_json:
            raise UsageError(
                "The camera could not be converted: found photographs, --board, --model, --picture "
                "or --json with --to, needed a single camera file; calibrate first, and convert "
                "the result."
            )
        lines = convert_camera(Path(images[0]), to, output)
        print_table(report([Text(line, overflow="fold") for line in lines]))
        return
    if board is None:
        raise UsageError(
            "The camera could not be calibrated: found no --board, needed the board in the "
            "photographs; write --board chessboard:9x6:25mm for one of 9 x 6 squares of 25 mm."
        )
    calibration = calibrate_camera(
        images,
        board,
        model=model,
        output=output,
        picture=picture,
        progress=not quiet,
        workers=image_workers(cluster, workers),
    )
    show(as_json, calibration.document, lambda: camera_table(calibration, output))


def detect(
    dataset: DatasetArgument,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="OUT",
            help="The folder to write: observations.csv, index.html and every image with its "
            "outlines.",
        ),
    ],
    edit: Annotated[
        bool,
        typer.Option(
            "--edit",
            help="Then serve the page to the browser of this machine. It shows the legs projected "
            "with the cameras estimated from clicked joints; clicks are saved in the dataset.",
        ),
    ] = False,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="The port of --edit; 0 for any that is free.")
    ] = 0,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run doctor, and show the outlines of the legs over the images for correction.

    Exit 1 if a camera could not be placed or no outline can be used.
    """
    from legcal.calibration import doctor as job
    from legcal.data.dataset import load_dataset
    from legcal.report.session import examination_table

    if edit:
        from legcal.viewer.address import Address, check_address
        from legcal.viewer.click_server import HOST

        check_address(Address(HOST, port))
    examination = job.doctor(
        load_dataset(dataset, check_clicks=False) if edit else dataset,
        output=output,
        progress=not quiet,
        workers=image_workers(cluster, workers),
    )
    show(as_json, examination.document, lambda: examination_table(examination, output))
    if edit and examination.detection is not None:
        _serve_clicks(examination, examination.detection, output, port)
    if any(view.problem for view in examination.views) or not examination.n_used:
        raise typer.Exit(1)


def _serve_clicks(examination: Examination, detection: Detection, folder: Path, port: int) -> None:
    """Serve the page of a detection until it is interrupted."""
    from legcal.cli.view import open_browser
    from legcal.viewer.click_server import ClickServer

    server = ClickServer(examination, detection, folder, port)
    typer.echo(f"Click joints at {server.address}; press Ctrl-C to stop.", err=True)
    open_browser(str(server.address))
    with suppress(KeyboardInterrupt):  # the way to end it
        server.run()


def doctor(
    dataset: DatasetArgument,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Check a dataset for anything that would prevent calibration, including common mistakes.

    Exit 0 if it is ready, 1 for problems, 2 if files cannot be used.
    """
    from legcal.calibration import doctor as job
    from legcal.report.session import examination_table

    examination = job.doctor(dataset, progress=not quiet, workers=image_workers(cluster, workers))
    show(as_json, examination.document, lambda: examination_table(examination))
    if not examination.is_ready:
        raise typer.Exit(1 if examination.is_usable else 2)


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
            "the smallest sufficient sets of views are recommended.",
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
    hand_held: Annotated[
        bool,
        typer.Option(
            "--hand-held",
            help="Hand-held camera: a new pose for every image of a view; with --board and --view.",
        ),
    ] = False,
    noise: Annotated[
        Path | None,
        typer.Option(
            metavar="RESULT", help="Take the errors of outlines from this earlier result."
        ),
    ] = None,
    page: PageOption = None,
    as_json: JsonOption = False,
) -> None:
    """Report which parameters are identifiable, and how to make the others so."""
    from legcal.calibration.identify.identifiability import answer
    from legcal.report.identify import identify_table, identify_verdict

    check_page(page)
    views = [text.split(",") for text in view or []]
    identified = answer(
        model,
        views,
        images,
        board=board,
        platform_board=platform_board,
        hand_held=hand_held,
        noise=noise,
    )
    verdict = identify_verdict(identified)
    write_page(page, f"Identifiability of {model}", identify_table(identified), verdict)
    show(as_json, identified.document, lambda: identify_table(identified))


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
        typer.Option(
            help="Sigma of each coordinate of a position, 0.02mm; by default from the residuals."
        ),
    ] = None,
    angle_sigma: Annotated[
        str | None,
        typer.Option(help="Sigma of an orientation, 0.01deg; by default from the residuals."),
    ] = None,
    encoder_sigma: Annotated[
        str | None,
        typer.Option(help="Sigma of a reading, 2um, or 0.01deg for motors that turn; default 0."),
    ] = None,
    tool_position: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z",
            help="Tool in the platform, in metres, where the measured poses do not determine it; "
            "0,0,0 by default.",
        ),
    ] = None,
    world_link: Annotated[str, typer.Option(help="With --urdf: name of the world link.")] = (
        "world"
    ),
    tool_link: Annotated[str, typer.Option(help="With --urdf: name of the tool link.")] = "tool",
    page: PageOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find the base in the world and the tool in the platform from measured tool poses."""
    from legcal.calibration.location import locate
    from legcal.calibration.location.document import (
        LOCATION_FILE,
        location_document,
        write_location,
    )
    from legcal.calibration.location.urdf import write_located_model
    from legcal.files.quantity import ANGLE, LENGTH, parse_quantity
    from legcal.machine.loader import load_mechanism
    from legcal.report.machine import location_table

    if urdf is None and (world_link, tool_link) != ("world", "tool"):
        raise UsageError(
            "The names of the links could not be used: found them without --urdf, needed the "
            "folder of the model to write; name it or leave the names out."
        )

    def quantity(text: str | None, units: Mapping[str, float], option: str) -> float | None:
        return None if text is None else parse_quantity(text, units, option)

    check_page(page)
    LOCATION_FILE.check_place(output)
    machine = load_mechanism(model)
    location = locate.locate(
        machine,
        poses,
        position_sigma=quantity(position_sigma, LENGTH, "--position-sigma"),
        angle_sigma=quantity(angle_sigma, ANGLE, "--angle-sigma"),
        encoder_sigma=encoder_sigma or 0.0,
        tool_position=None if tool_position is None else _point(tool_position),
    )
    written = []
    if urdf is not None:
        paths = write_located_model(machine, location, urdf, world=world_link, tool=tool_link)
        written += [str(path) for path in paths]
    write_location(location, output)
    written.append(str(output))
    title = f"Base and tool of {machine.name}"
    write_page(page, title, location_table(location, written))
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
