"""``legcal camera``."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from legcal.cli.calibrate import MOST_WORKERS
from legcal.cli.options import JsonOption, WorkersOption
from legcal.cli.output import print_json, print_table
from legcal.processors import processors


class Model(StrEnum):
    """How a lens distorts."""

    PLUMB_BOB = "plumb_bob"
    RATIONAL_POLYNOMIAL = "rational_polynomial"
    EQUIDISTANT = "equidistant"


def camera(
    images: Annotated[
        list[str],
        typer.Argument(
            metavar="IMAGES...", help="Photographs of the board: files, folders, patterns."
        ),
    ],
    board: Annotated[
        str,
        typer.Option(
            metavar="SPEC",
            help="chessboard:9x6:25mm (squares), charuco:7x5:40mm:29mm:DICT_4X4_50 (square, "
            "marker), aprilgrid:6x6:88mm:0.3 (gap as a part of a tag), or a YAML file with a block "
            "board.",
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="The camera_info YAML to write.")
    ],
    model: Annotated[
        Model, typer.Option(help="How the lens distorts; equidistant for a fisheye.")
    ] = Model.PLUMB_BOB,
    workers: WorkersOption = None,
    as_json: JsonOption = False,
) -> None:
    """Calibrate a camera from photographs of a chessboard, ChArUco board or AprilGrid."""
    from legcal.camera_calibration.calibrate import calibrate_camera
    from legcal.report.progress_bars import progress_on_stderr

    with progress_on_stderr() as progress:
        found = calibrate_camera(
            images,
            board,
            model=model.value,
            output=output,
            progress=progress,
            workers=workers or min(processors(), MOST_WORKERS),
        )
    if as_json:
        print_json(found.document())
    else:
        from legcal.report.camera_table import camera_table

        print_table(camera_table(found, output))
