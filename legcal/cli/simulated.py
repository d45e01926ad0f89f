"""Commands on machines whose truth is known: ``simulate``, and ``study`` (section 4.3)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from legcal.cli.options import (
    REPORT,
    ClusterOption,
    HandHeldOption,
    JsonOption,
    ModelArgument,
    PageOfResult,
    QuietOption,
    WorkersOption,
    chosen_workers,
    image_workers,
    print_table,
    show,
    write_page,
)


def simulate(
    model: ModelArgument,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DATASET", help="The folder to write.")
    ],
    level: Annotated[
        Literal["photographs", "outlines"],
        typer.Option(help="Rendered photographs, or outlines with noise (observations.csv)."),
    ] = "photographs",
    camera: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FILE|KIND",
            help="Camera file (ROS, OpenCV, Kalibr), or kind of camera: machine-jpeg, webcam, "
            "phone, action or industrial, webcam:60 for another JPEG quality. Once for each.",
            show_default="1024 x 768 px, slight distortion; industrial",
        ),
    ] = None,
    poses: Annotated[
        str | None,
        typer.Option(
            metavar="N|CSV",
            help="Poses for each of the three views, every motor near an end of its travel; or a "
            "table of readings for all views, as for init, in m and rad under the names of joints.",
            show_default="15",
        ),
    ] = None,
    error: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND=SIZE",
            help="Errors of the true machine relative to the model: joints, base-joints, "
            "platform-joints, offsets, lengths (2mm), axes, twists (0.1deg), radii (0mm); uniform "
            "in +-SIZE, or SIZE:normal; none for no errors. May be repeated.",
            show_default="joints, offsets, lengths=2mm; axes, twists=0.1deg",
        ),
    ] = None,
    board: Annotated[
        str | None,
        typer.Option(
            metavar="KIND|FILE",
            help="A calibration board on the base: chessboard, charuco or aprilgrid, of a size "
            "that fits the machine, or a YAML with the block board of a dataset.",
            show_default="none",
        ),
    ] = None,
    hand_held: HandHeldOption = False,
    plan: Annotated[
        Path | None,
        typer.Option(
            metavar="SESSION",
            help="Instead of poses and cameras: a session from legcal plan, with tripods off by "
            "its tolerances.",
        ),
    ] = None,
    seed: Annotated[
        int, typer.Option(help="Random seed; equal seeds give equal datasets, to the last bit.")
    ] = 0,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Simulate a dataset of a machine with a known true model, and write it with the truth.

    The default is 45 photographs: 3 views of 15 extreme poses each. Python has more choices
    (legcal.SimulationSettings).
    """
    from legcal.machine.loader import load_mechanism
    from legcal.report.session import simulation_table
    from legcal.simulation.dataset import simulate as run
    from legcal.simulation.dataset import summary_document
    from legcal.simulation.settings import requested

    nominal = load_mechanism(model)
    settings = requested(
        nominal,
        level=level,
        camera=camera or (),
        poses=poses,
        error=error or (),
        board=board,
        hand_held=hand_held,
        plan=plan,
        seed=seed,
    )
    used = image_workers(cluster, workers)
    made = run(nominal, output, settings, workers=used, progress=not quiet)
    document = summary_document(made)
    show(
        as_json,
        lambda: document,
        lambda: simulation_table(document, to_measure=made.to_measure),
    )


study = typer.Typer(
    help="Validate the method on many simulated machines whose truth is known.",
    no_args_is_help=True,
)


@study.command()
def paper(
    runs: Annotated[int, typer.Option(help="Number of runs.")] = 100,
    seed: Annotated[int, typer.Option(help="Seed of all runs.")] = 0,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="OUT",
            help="Folder for the document and the figures.",
        ),
    ] = None,
    radians: Annotated[
        bool, typer.Option("--radians", help="Take the angles of Table 1 as radians, as printed.")
    ] = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Repeat section 4.3 of the paper: calibrations of a 6-SPU, before and after."""
    from markupsafe import Markup

    from legcal.pages.document import Drawing
    from legcal.report.session import study_table
    from legcal.simulation.observe import TableNoise
    from legcal.simulation.paper import PaperStudy, run_study
    from legcal.workers import processors

    def make_page(document: dict[str, Any], folder: Path) -> None:
        figure = Markup((folder / "fig4.svg").read_text(encoding="utf-8"))
        title, text = "The paper's simulation", study_table(document)
        write_page(folder / REPORT, title, text, blocks=[Drawing(figure)])

    noise, page = TableNoise.in_radians() if radians else TableNoise(), PageOfResult(make_page)
    document = run_study(
        PaperStudy(noise),
        runs,
        seed=seed,
        workers=chosen_workers(cluster, workers, processors()),
        output=output,
        progress=not quiet,
        beside=page,
    )
    page.print_failure()
    show(as_json, lambda: document, lambda: study_table(document))
    if output is not None and not as_json:
        print_table(f"\nDocument and figures: {output}")
