"""``legcal plan``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from legcal.cli.options import JsonOption, ModelArgument, QuietOption, show


def plan(
    model: ModelArgument,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="SESSION", help="The folder to write.")
    ],
    images: Annotated[
        int | None,
        typer.Option(help="Photographs of the whole session (in identify: per view); 45."),
    ] = None,
    images_per_view: Annotated[
        int | None, typer.Option(help="Photographs of each view, in place of --images.")
    ] = None,
    cameras: Annotated[int, typer.Option(help="Camera places.")] = 3,
    criterion: Annotated[
        str,
        typer.Option(
            metavar="mean|worst|d|parameters",
            help="What to make small: the error of the platform over the workspace on average or "
            "at worst, the determinant of the covariance, or sigmas of --parameter.",
        ),
    ] = "mean",
    parameter: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="A parameter to know well; repeat it.")
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Camera file; 1024 x 768 px, 43 deg wide by default."),
    ] = None,
    bounds: Annotated[
        str | None,
        typer.Option(
            metavar="X0:X1,Y0:Y1,Z0:Z1",
            help="Where cameras may stand in the base link: -2m:2m,-2m:2m,0m:1.5m.",
        ),
    ] = None,
    encoder_sigma: Annotated[str, typer.Option(help="Sigma of a reading.")] = "2um",
    seed: Annotated[int, typer.Option(help="Of all that is drawn.")] = 0,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier plan there.")] = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Plan a session: poses and camera places that determine a machine best."""
    from legcal import planning, report
    from legcal.files import LENGTH, parse_quantity
    from legcal.signals import held_back_signals, is_waiting

    planning.check_session(output, force=force)
    sigma_q = parse_quantity(encoder_sigma, LENGTH, "--encoder-sigma")
    where = None if bounds is None else planning.parse_bounds(bounds)
    with held_back_signals():
        found = planning.plan(
            model,
            images=images,
            images_per_view=images_per_view,
            cameras=cameras,
            criterion=criterion,
            parameters=parameter or (),
            camera=camera,
            encoder_sigma=sigma_q,
            bounds=where,
            seed=seed,
            progress=not quiet,
            stop=is_waiting,
        )
        planning.write_session(found, output, force=force)
    show(as_json, found.document, lambda: report.plan_table(found, output))
