"""``legcal plan``."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from legcal.cli.options import (
    ClusterOption,
    JsonOption,
    ModelArgument,
    QuietOption,
    WorkersOption,
    command_line,
    image_workers,
    show,
)
from legcal.errors import printable

if TYPE_CHECKING:
    from legcal.planning.planned_session import Plan


def plan(
    model: ModelArgument,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="SESSION", help="The folder to write.")
    ],
    images: Annotated[
        int | None,
        typer.Option(help="Photographs to take in all (in identify: per view); 45."),
    ] = None,
    images_per_view: Annotated[
        int | None, typer.Option(help="Photographs of each view, in place of --images.")
    ] = None,
    cameras: Annotated[
        int | None, typer.Option(help="Camera places; 3, or all of --places if these are fewer.")
    ] = None,
    target: Annotated[
        str | None,
        typer.Option(
            metavar="LENGTH",
            help="Instead of --images: the fewest with which this error of the platform is "
            "expected, 0.05mm.",
        ),
    ] = None,
    criterion: Annotated[
        str,
        typer.Option(
            metavar="mean|worst|d|parameters",
            help="What to make small: the error of the platform over the workspace on average or "
            "at worst, the determinant of the covariance, or sigmas of --parameter.",
        ),
    ] = "mean",
    parameter: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="A parameter to know well, with --criterion parameters; may be repeated.",
        ),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Camera file; by default that of --given, or 1024 x 768 px, 43 deg wide.",
        ),
    ] = None,
    noise: Annotated[
        Path | None,
        typer.Option(
            metavar="RESULT",
            help="Errors of outlines as an earlier result has them.",
        ),
    ] = None,
    bounds: Annotated[
        str | None,
        typer.Option(
            metavar="X0:X1,Y0:Y1,Z0:Z1",
            help="Where cameras may stand in the base link: -2m:2m,-2m:2m,0m:1.5m.",
        ),
    ] = None,
    places: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Places of tripods to choose from, a YAML with places: {NAME: {xyz, quat_xyzw}}, "
            "without quat_xyzw turned to the machine; or the views of a cameras file, dataset, "
            "result or plan.",
        ),
    ] = None,
    given: Annotated[
        Path | None,
        typer.Option(metavar="DATASET", help="What was shot already: plan what to add."),
    ] = None,
    board: Annotated[
        str | None,
        typer.Option(
            metavar="SPEC",
            help="A calibration board on the base in every image, as for legcal camera; the plan "
            "says where it lies.",
        ),
    ] = None,
    hand_held: Annotated[
        bool,
        typer.Option("--hand-held", help="Every image from a place of its own; with --board."),
    ] = False,
    model_error: Annotated[
        str, typer.Option(help="How far joints and offsets of the machine are off at most.")
    ] = "2mm",
    encoder_sigma: Annotated[
        str | None,
        typer.Option(
            help="Sigma of a reading; by default that of --given, or 2um, of motors that turn "
            "0.1mrad, of hobby servos 0.5deg.",
            show_default=False,
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Random seed.")] = 0,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier plan there.")] = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Plan a session: poses and camera places that determine a machine best."""
    from legcal.files.quantity import LENGTH, parse_quantity
    from legcal.planning import request
    from legcal.planning.information import DEFAULT_NOISE
    from legcal.planning.places import USUAL, parse_bounds
    from legcal.planning.session import check_session, write_session
    from legcal.report.plan import plan_files, plan_table
    from legcal.signals import held_back_signals, is_waiting

    def length(text: str | None, option: str) -> float | None:
        return None if text is None else parse_quantity(text, LENGTH, option)

    check_session(output, force=force)
    error = length(model_error, "--model-error") or 0.0
    with held_back_signals(first_alone=True):  # Ctrl-C ends the search: the best so far is written
        found = request.plan(
            model,
            images=images,
            images_per_view=images_per_view,
            cameras=cameras,
            target=length(target, "--target"),
            criterion=criterion,
            parameters=parameter or (),
            camera=camera,
            noise=DEFAULT_NOISE if noise is None else noise,
            encoder_sigma=encoder_sigma,
            bounds=None if bounds is None else parse_bounds(bounds),
            places=places,
            given=given,
            board=board,
            hand_held=hand_held,
            setting=replace(USUAL, length=error),
            seed=seed,
            workers=image_workers(cluster, workers),
            progress=not quiet,
            stop=is_waiting,
        )
        pictures = plan_files(found, _previews(found), command_line())
        write_session(found, output, force=force, pictures=pictures)
        if is_waiting() and sys.stderr is not None:
            text = f"The session was written to {output}, with the best plan found before the stop."
            sys.stderr.write(f"legcal: {printable(text)}\n")
    show(as_json, found.document, lambda: plan_table(found, output))


def _previews(plan: Plan) -> dict[str, bytes]:
    """Return a small rendered photograph of each view, by its name."""
    from legcal.simulation.previews import preview

    views = plan.views[:1] if plan.hand_held else plan.views
    return {
        view.name: preview(plan.machine, plan.camera, view.T_base_camera, view.poses, plan.board)
        for view in views
    }
