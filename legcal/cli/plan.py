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
    cameras: Annotated[int | None, typer.Option(help="Camera places; 3.")] = None,
    target: Annotated[
        str | None,
        typer.Option(
            metavar="LENGTH",
            help="Instead of --images: the fewest with which this error of the platform is "
            "expected, 0.05mm.",
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
    seed: Annotated[int, typer.Option(help="Random seed.")] = 0,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Plan a session: poses and camera places that determine a machine best."""
    from legcal.files.quantity import LENGTH, parse_quantity
    from legcal.planning import request
    from legcal.planning.information import DEFAULT_NOISE
    from legcal.planning.places import parse_bounds
    from legcal.planning.session import check_session, write_session
    from legcal.report.plan import plan_files, plan_table
    from legcal.signals import held_back_signals, is_waiting

    check_session(output)
    with held_back_signals(first_alone=True):  # Ctrl-C ends the search: the best so far is written
        found = request.plan(
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
        pictures = plan_files(found, _previews(found), command_line())
        write_session(found, output, pictures=pictures)
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
