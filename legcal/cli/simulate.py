"""``legcal simulate``: its options are the fields of :class:`legcal.simulation.request.Request`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from legcal.cli.options import (
    ClusterOption,
    JsonOption,
    ModelArgument,
    QuietOption,
    declare,
    declared,
    image_workers,
    parameters_of,
    show,
)
from legcal.simulation.request import Request

OutputOption = Annotated[
    Path, typer.Option("--output", "-o", metavar="DATASET", help="The folder to write.")
]
ForceOption = Annotated[
    bool, typer.Option("--force", help="Replace an earlier simulated dataset in that folder.")
]


def simulate(
    model: ModelArgument,
    output: OutputOption,
    force: ForceOption = False,
    cluster: ClusterOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
    **options: Any,
) -> None:
    """Simulate a dataset of a machine whose true model is known, and write it with the truth.

    The default is 45 photographs: 3 views of 15 extreme poses each.
    """
    from legcal.machine.loader import load_mechanism
    from legcal.report.images import simulation_table
    from legcal.simulation.dataset import simulate as run
    from legcal.simulation.dataset import summary_document
    from legcal.simulation.settings import requested

    nominal = load_mechanism(model)
    settings = requested(Request(**options), nominal)
    workers = image_workers(cluster)
    made = run(nominal, output, settings, force=force, workers=workers, progress=not quiet)
    document = summary_document(made)
    show(
        as_json,
        lambda: document,
        lambda: simulation_table(document, to_measure=made.to_measure),
    )


_model, _output, _force, *_usual = parameters_of(simulate)
_level, _seed, *_others = declared(Request)
declare(simulate, [_model, _output, _level, _seed, _force, *_others, *_usual])
