"""``legcal noise``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from legcal.cli.calibrate import MOST_WORKERS
from legcal.cli.options import JsonOption
from legcal.cli.output import print_json, print_table
from legcal.processors import processors


def noise(
    dataset: Annotated[
        Path, typer.Argument(metavar="DATASET", help="A dataset with several images of each pose.")
    ],
    as_json: JsonOption = False,
) -> None:
    """Estimate how precisely images tell where legs are, from repeated images of the same poses."""
    from legcal.repeatability.noise import measure_noise
    from legcal.report.progress_bars import progress_on_stderr

    with progress_on_stderr() as progress:
        found = measure_noise(dataset, progress=progress, workers=min(processors(), MOST_WORKERS))
    if as_json:
        from legcal.repeatability.document import noise_document

        print_json(noise_document(found))
    else:
        from legcal.report.noise_table import noise_table

        print_table(noise_table(found))
