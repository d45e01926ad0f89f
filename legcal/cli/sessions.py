"""Commands on sessions: camera, plan, photographs and recordings to a dataset, its examination."""

from __future__ import annotations

import shlex
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from legcal.cli.options import (
    ClusterOption,
    DatasetArgument,
    DatasetOutputOption,
    ForceOption,
    HandHeldOption,
    JsonOption,
    LengthsOption,
    ModelArgument,
    ModelOption,
    NoiseOption,
    OnlyOption,
    QuietOption,
    WorkersOption,
    as_lines,
    command_line,
    image_workers,
    open_browser,
    print_table,
    serve,
    show,
)
from legcal.errors import UsageError
from legcal.vision.distortion import CameraProgram, DistortionModel

if TYPE_CHECKING:
    from legcal.planning.session import Plan


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
    from legcal.calibration.camera_calibration.calibration import calibrate_camera
    from legcal.calibration.camera_calibration.projection import compare_cameras
    from legcal.report.machine import camera_table, comparison_table
    from legcal.vision.camera_file import convert_camera, read_camera

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
        print_table(as_lines(lines))
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


def plan(
    model: ModelArgument,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="SESSION", help="The folder to write.")
    ],
    images: Annotated[
        int | None,
        typer.Option(help="Total number of photographs (in identify: per view); default 45."),
    ] = None,
    images_per_view: Annotated[
        int | None, typer.Option(help="Photographs of each view, in place of --images.")
    ] = None,
    cameras: Annotated[
        int | None, typer.Option(help="Number of camera positions; default 3.")
    ] = None,
    target: Annotated[
        str | None,
        typer.Option(
            metavar="LENGTH",
            help="Use the fewest photographs expected to reach this platform error, 0.05mm "
            "(instead of --images).",
        ),
    ] = None,
    noise: NoiseOption = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="The camera file, which the session gets; by default that of --given, else a "
            "camera of 1024 x 768 px, 43 deg wide.",
        ),
    ] = None,
    bounds: Annotated[
        str | None,
        typer.Option(
            metavar="X0:X1,Y0:Y1,Z0:Z1",
            help="Where cameras may stand in the base link: -2m:2m,-2m:2m,0m:1.5m.",
        ),
    ] = None,
    given: Annotated[
        Path | None,
        typer.Option(metavar="DATASET", help="Existing dataset to extend."),
    ] = None,
    board: Annotated[
        str | None,
        typer.Option(
            metavar="SPEC",
            help="A calibration board on the base in every image, as for legcal camera; the plan "
            "states its pose.",
        ),
    ] = None,
    hand_held: HandHeldOption = False,
    only: OnlyOption = None,
    seed: Annotated[int, typer.Option(help="Random seed.")] = 0,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Plan a session: poses and camera positions that determine a machine best."""
    from legcal.calibration.joint_fit.predicted import DEFAULT_NOISE
    from legcal.files.quantity import LENGTH, parse_quantity
    from legcal.planning import request
    from legcal.planning.places import parse_bounds
    from legcal.planning.session import CAMERA, check_session, write_session
    from legcal.report.plan import plan_files, plan_table

    check_session(output)
    session = request.plan(
        model,
        images=images,
        images_per_view=images_per_view,
        cameras=cameras,
        target=None if target is None else parse_quantity(target, LENGTH, "--target"),
        camera=camera,
        noise=DEFAULT_NOISE if noise is None else noise,
        bounds=None if bounds is None else parse_bounds(bounds),
        given=given,
        board=board,
        hand_held=hand_held,
        only=only,
        seed=seed,
        workers=image_workers(cluster, workers),
        progress=not quiet,
    )
    files = plan_files(session, _previews(session), command_line())
    if camera is not None:  # with the covariance and the record of its calibration
        files = {**files, CAMERA: camera.read_bytes()}
    write_session(session, output, pictures=files)
    show(as_json, session.document, lambda: plan_table(session, output))


def shoot(
    session: Annotated[
        Path,
        typer.Argument(
            metavar="SESSION", help="The folder of legcal plan, or a dataset to add photographs to."
        ),
    ],
    watch: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Take new photographs from this folder, such as one that a phone synchronises; "
            "they are copied.",
        ),
    ] = None,
    camera: Annotated[
        int | None,
        typer.Option(metavar="NUMBER", help="Take them with this camera of the computer: 0."),
    ] = None,
    target: Annotated[
        str | None,
        typer.Option(
            metavar="LENGTH",
            help="Go on, beyond the plan if need be, until this platform error is predicted, "
            "0.05mm.",
        ),
    ] = None,
    port: Annotated[
        int | None,
        typer.Option(
            min=0, max=65535, help="Serve the same as a page on this port; 0 for any that is free."
        ),
    ] = None,
) -> None:
    """Guide a session: name the next pose, check each photograph, and predict the error so far."""
    import threading

    from legcal.files.quantity import LENGTH, parse_quantity
    from legcal.planning.shooting import GuidedSession
    from legcal.recordings.frames import LiveCamera, WatchedFolder
    from legcal.viewer.server import LOCAL, Address, check_address
    from legcal.viewer.shooting import WORDS, Dialogue, DialogueServer

    if (watch is None) == (camera is None):
        raise UsageError(
            f"No photograph could arrive: found {'neither' if watch is None else 'both'} of "
            "--watch and --camera, needed one; give --watch FOLDER, or --camera 0."
        )
    guided = GuidedSession(
        session,
        target=None if target is None else parse_quantity(target, LENGTH, "--target"),
    )
    lens = guided.dataset.measurements.views[0].camera
    source = (
        LiveCamera(camera or 0, lens.width, lens.height) if watch is None else WatchedFolder(watch)
    )
    dialogue = Dialogue(guided, source, typer.echo)

    def listen() -> None:
        with suppress(OSError, ValueError):  # there may be no terminal
            for line in sys.stdin or ():
                dialogue.words.put(line)

    typer.echo(f"Words: {WORDS}.")
    threading.Thread(target=listen, daemon=True).start()
    if port is not None:
        check_address(Address(LOCAL, port))
        server = DialogueServer(dialogue, port)
        threading.Thread(target=server.run, daemon=True).start()
        typer.echo(f"The same as a page: {server.address}")
        open_browser(str(server.address))
    try:
        is_complete = dialogue.run()
    finally:
        if isinstance(source, LiveCamera):
            source.close()
    if is_complete:
        typer.echo(f"legcal calibrate {shlex.quote(str(session))} -o calibrated")


def _previews(plan: Plan) -> dict[str, bytes]:
    """Return a small rendered photograph of each view, by its name."""
    from legcal.simulation.session import preview

    views = plan.views[:1] if plan.hand_held else plan.views
    return {
        view.name: preview(plan.machine, plan.camera, view.T_base_camera, view.poses, plan.board)
        for view in views
    }


def init(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER",
            help="The photographs, in it or in one folder for each camera position. It is not "
            "changed.",
        ),
    ],
    readings: Annotated[
        Path,
        typer.Option(
            "--readings",
            metavar="FILE",
            help="A CSV with a column for each encoder; optional columns image, view, pose, time.",
        ),
    ],
    model: ModelOption,
    output: DatasetOutputOption,
    camera: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[VIEW=]FILE",
            help="The camera file of all views, or of one (repeat it); by default camera_info.yaml "
            "beside the photographs, else a rough one by the focal length in their EXIF data.",
        ),
    ] = None,
    unit: Annotated[
        str | None,
        typer.Option(
            help="Unit of the readings: m, cm, mm, um; rad, mrad, deg, us for motors that turn; by "
            "default from the headings, else the unit that puts them in the travel."
        ),
    ] = None,
    lengths: LengthsOption = False,
    encoder_sigma: Annotated[
        str | None,
        typer.Option(
            help="Sigma of a reading, 2um or 0.5deg; by default the last digit of the table, or "
            "0.5deg for pulses of servos."
        ),
    ] = None,
    board: Annotated[
        str | None,
        typer.Option(metavar="SPEC", help="The board on the base, as for legcal camera."),
    ] = None,
    hand_held: HandHeldOption = False,
    force: ForceOption = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Do not show which reading each image gets.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Make a dataset from a folder of photographs and a table of readings."""
    from legcal.data.new_dataset import SheetOptions, plan_new_dataset, write_new_dataset
    from legcal.report.session import matching_table, written_lines

    options = SheetOptions(
        cameras=camera or (),
        unit=unit,
        lengths=lengths,
        encoder_sigma=encoder_sigma,
        board=board,
        hand_held=hand_held,
    )
    dataset = plan_new_dataset(folder, readings, model, output, options)
    if not as_json and not quiet:
        print_table(matching_table(dataset))
    written = write_new_dataset(dataset, force=force)
    show(
        as_json,
        lambda: dataset.document(written),
        lambda: written_lines(output, written, dataset.machine),
    )


def import_(
    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="RECORDING...",
            help="A video, a ROS bag (.bag, .mcap, folder) or a folder of images with times for "
            "each camera position; views are named after them. Of a bag with several cameras the "
            "topic of one: BAG:/left/image_raw.",
        ),
    ],
    model: ModelOption,
    output: DatasetOutputOption,
    camera: Annotated[
        list[str],
        typer.Option(
            metavar="[VIEW=]FILE", help="The camera file of all views, or of one (repeat it)."
        ),
    ],
    readings: Annotated[
        list[Path] | None,
        typer.Option(
            "--readings",
            metavar="FILE",
            help="A CSV with a column time and one for each encoder: for all recordings, or one "
            "for each in their order; bags may hold joint states instead.",
        ),
    ] = None,
    lengths: LengthsOption = False,
    offset: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS",
            help="Camera clock minus reading clock; by default estimated from the motion.",
        ),
    ] = None,
    force: ForceOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Make a dataset from recordings of a machine that rests at each pose."""
    from legcal.progress import shown_progress
    from legcal.recordings.importing import plan_import, write_import
    from legcal.report.session import import_table, written_lines

    with shown_progress(not quiet) as progress:
        plan = plan_import(
            sources,
            model,
            output,
            readings=readings or (),
            cameras=camera,
            lengths=lengths,
            offset=offset,
            progress=progress,
        )
    if not as_json:
        print_table(import_table(plan))
    with shown_progress(not quiet) as progress:
        written = write_import(plan, force=force, progress=progress)
    show(
        as_json,
        lambda: plan.document(written),
        lambda: written_lines(output, written, plan.machine),
    )


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
        from legcal.viewer.server import LOCAL, Address, check_address

        check_address(Address(LOCAL, port))
    examination = job.doctor(
        load_dataset(dataset, check_clicks=False) if edit else dataset,
        output=output,
        progress=not quiet,
        workers=image_workers(cluster, workers),
    )
    show(as_json, examination.document, lambda: examination_table(examination, output))
    if edit and examination.detection is not None:
        from legcal.viewer.click_server import ClickServer

        server = ClickServer(examination, examination.detection, output, port)
        typer.echo(f"Click joints at {server.address}; press Ctrl-C to stop.", err=True)
        serve(server)
    if any(view.problem for view in examination.views) or not examination.n_used:
        raise typer.Exit(1)
