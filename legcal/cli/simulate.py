"""``legcal simulate``."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from legcal.cli.calibrate import MOST_WORKERS
from legcal.cli.options import JsonOption, ModelArgument
from legcal.cli.output import print_json, print_table
from legcal.cli.processors import processors


class LevelChoice(StrEnum):
    """What the dataset gives a calibration to work on."""

    AXES = "axes"
    OUTLINES = "outlines"
    PHOTOGRAPHS = "photographs"


class SamplingChoice(StrEnum):
    """How poses are drawn."""

    EXTREME = "extreme"
    WORKSPACE = "workspace"


class AngleChoice(StrEnum):
    """How the angles of Table 1 are read."""

    DEGREES = "degrees"
    RADIANS = "radians"


_MACHINE, _MOTION, _CAMERAS = "The true machine", "Poses and images", "Cameras"
_NOISE, _LOOK = "Noise", "Photographs"


def simulate(
    model: ModelArgument,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DATASET", help="The folder to write.")
    ],
    level: Annotated[
        LevelChoice,
        typer.Option(
            help="Rendered photographs; outlines with noise in pixels (observations.csv); or leg "
            "axes with the noise of the paper's Table 1 (axes.csv)."
        ),
    ] = LevelChoice.PHOTOGRAPHS,
    seed: Annotated[
        int, typer.Option(help="The same seed gives the same dataset, to the last bit.")
    ] = 0,
    force: Annotated[
        bool, typer.Option("--force", help="Replace an earlier simulated dataset in that folder.")
    ] = False,
    error: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND=SIZE",
            help="How far the true machine is from the model: joints, base-joints, "
            "platform-joints, offsets, lengths (2mm), axes, twists (0.1deg); uniform in +-SIZE, "
            "or SIZE:normal; none for no errors. May be repeated.",
            rich_help_panel=_MACHINE,
            show_default="joints, offsets, lengths=2mm; axes, twists=0.1deg",
        ),
    ] = None,
    coplanar: Annotated[
        bool,
        typer.Option(
            "--coplanar",
            help="Keep joints in the plane that they are nominally in.",
            rich_help_panel=_MACHINE,
        ),
    ] = False,
    poses: Annotated[
        str,
        typer.Option(
            metavar="N|CSV",
            help="Poses for each view; or a CSV of readings in metres, the motors' joints in its "
            "header, for all views.",
            rich_help_panel=_MOTION,
        ),
    ] = "15",
    sampling: Annotated[
        SamplingChoice,
        typer.Option(
            help="Every motor near an end of its travel, or anywhere.", rich_help_panel=_MOTION
        ),
    ] = SamplingChoice.EXTREME,
    shared_poses: Annotated[
        bool | None,
        typer.Option(
            "--shared-poses/--own-poses",
            help="All views see the same poses (several cameras at once), or each its own (one "
            "camera that is moved).",
            rich_help_panel=_MOTION,
            show_default="own",
        ),
    ] = None,
    images: Annotated[
        int, typer.Option(help="Images of each pose in each view.", rich_help_panel=_MOTION)
    ] = 1,
    views: Annotated[
        int | None,
        typer.Option(
            help="Cameras around the machine, where its legs are seen well.",
            rich_help_panel=_CAMERAS,
            show_default="3",
        ),
    ] = None,
    cameras: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Instead: a YAML with views: {NAME: {T_base_camera: {xyz, quat_xyzw}, camera}}.",
            rich_help_panel=_CAMERAS,
        ),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Camera file (ROS, OpenCV, Kalibr).",
            rich_help_panel=_CAMERAS,
            show_default="1024 x 768 px, slight distortion",
        ),
    ] = None,
    hints: Annotated[
        bool,
        typer.Option(
            "--hints/--no-hints",
            help="Tell roughly where cameras stand (15 mm, 1.5 deg), and the legs of each view.",
            rich_help_panel=_CAMERAS,
        ),
    ] = True,
    pixel_noise: Annotated[
        str,
        typer.Option(
            metavar="SIGMA",
            help="Of each edge point of an outline.",
            rich_help_panel=_NOISE,
        ),
    ] = "0.1px",
    table_noise: Annotated[
        AngleChoice,
        typer.Option(help="How the angles of Table 1 are read.", rich_help_panel=_NOISE),
    ] = AngleChoice.DEGREES,
    encoder_noise: Annotated[
        str,
        typer.Option(
            metavar="SIGMA", help="Of readings; 3um:uniform for +-3um.", rich_help_panel=_NOISE
        ),
    ] = "2um",
    appearance: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="A YAML of lights, background, clutter, sensor and more.",
            rich_help_panel=_LOOK,
        ),
    ] = None,
    blur: Annotated[
        float | None,
        typer.Option(metavar="PX", help="Sigma of the lens's blur.", rich_help_panel=_LOOK),
    ] = None,
    clutter: Annotated[
        int | None,
        typer.Option(help="Rods, boxes and balls in the background.", rich_help_panel=_LOOK),
    ] = None,
    bits: Annotated[
        int | None, typer.Option(help="Bits of a pixel, 8 or 16.", rich_help_panel=_LOOK)
    ] = None,
    colour: Annotated[
        bool | None,
        typer.Option("--colour/--grey", help="Colour or grey.", rich_help_panel=_LOOK),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Simulate a dataset of a machine whose true model is known, and write it with the truth.

    The default is 45 photographs: 3 views of 15 extreme poses each.
    """
    from legcal.report.progress_bars import progress_on_stderr
    from legcal.simulation.request import requested
    from legcal.simulation.simulate import simulate as run
    from legcal.simulation.summary import summary_document, summary_table

    settings = requested(
        level=level.value,
        poses=poses,
        sampling=sampling.value,
        shared_poses=shared_poses,
        images=images,
        views=views,
        cameras=cameras,
        camera=camera,
        errors=error or (),
        coplanar=coplanar,
        pixel_noise=pixel_noise,
        table_noise=table_noise.value,
        encoder_noise=encoder_noise,
        hints=hints,
        seed=seed,
        appearance=appearance,
        look={"blur": blur, "clutter": clutter, "bits": bits, "colour": colour},
    )
    with progress_on_stderr() as progress:
        made = run(
            model,
            output,
            settings,
            force=force,
            workers=min(processors(), MOST_WORKERS),
            progress=progress,
        )
    if as_json:
        print_json(summary_document(made))
    else:
        print_table(summary_table(made))
