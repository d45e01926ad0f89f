"""``legcal plan``."""

from __future__ import annotations

import sys
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
    from legcal.planning.session import Plan


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
    noise: Annotated[
        Path | None,
        typer.Option(
            metavar="RESULT",
            help="Take the errors of outlines from this earlier result.",
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
    hand_held: Annotated[
        bool,
        typer.Option(
            "--hand-held", help="Hand-held camera: a new pose for every image; with --board."
        ),
    ] = False,
    seed: Annotated[int, typer.Option(help="Random seed.")] = 0,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Plan a session: poses and camera positions that determine a machine best."""
    from legcal.calibration.joint_fit.predicted_noise import DEFAULT_NOISE
    from legcal.files.quantity import LENGTH, parse_quantity
    from legcal.planning import request
    from legcal.planning.places import parse_bounds
    from legcal.planning.session import check_session, write_session
    from legcal.report.plan import plan_files, plan_table
    from legcal.signals import held_back_signals, is_waiting

    check_session(output)
    with held_back_signals(first_alone=True):  # Ctrl-C ends the search: the best so far is written
        session = request.plan(
            model,
            images=images,
            images_per_view=images_per_view,
            cameras=cameras,
            target=None if target is None else parse_quantity(target, LENGTH, "--target"),
            noise=DEFAULT_NOISE if noise is None else noise,
            bounds=None if bounds is None else parse_bounds(bounds),
            given=given,
            board=board,
            hand_held=hand_held,
            seed=seed,
            workers=image_workers(cluster, workers),
            progress=not quiet,
            stop=is_waiting,
        )
        pictures = plan_files(session, _previews(session), command_line())
        write_session(session, output, pictures=pictures)
        if is_waiting() and sys.stderr is not None:
            text = f"The session was written to {output}, with the best plan found before the stop."
            sys.stderr.write(f"legcal: {printable(text)}\n")
    show(as_json, session.document, lambda: plan_table(session, output))


def _previews(plan: Plan) -> dict[str, bytes]:
    """Return a small rendered photograph of each view, by its name."""
    from legcal.simulation.session import preview

    views = plan.views[:1] if plan.hand_held else plan.views
    return {
        view.name: preview(plan.machine, plan.camera, view.T_base_camera, view.poses, plan.board)
        for view in views
    }
