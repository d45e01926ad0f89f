"""``legcal simulate``: its options are the fields of :class:`legcal.simulation.Request`."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from legcal.cli.options import (
    ClusterOption,
    JsonOption,
    ModelArgument,
    QuietOption,
    image_workers,
    show,
)
from legcal.simulation import Request

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
    from legcal.machine import load_mechanism
    from legcal.report import simulation_table
    from legcal.simulation import requested, summary_document
    from legcal.simulation import simulate as run

    nominal = load_mechanism(model).require_rigid_platform()
    settings = requested(Request(**options), nominal)
    workers = image_workers(cluster)
    made = run(nominal, output, settings, force=force, workers=workers, progress=not quiet)
    document, repeated = summary_document(made), options["images"] > 1
    show(
        as_json,
        lambda: document,
        lambda: simulation_table(document, repeated=repeated, to_measure=made.to_measure),
    )


def _requested() -> Iterator[inspect.Parameter]:
    """Return the fields of a request as parameters of a command."""
    types = get_type_hints(Request)
    for field in fields(Request):
        how = dict(field.metadata["option"])
        option = typer.Option(*how.pop("flags"), **how)
        yield inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=field.default,
            annotation=Annotated[types[field.name], option],
        )


def _declare() -> None:
    """Give the command the signature that Typer reads: its own options in the order of the help."""
    own = inspect.signature(simulate, eval_str=True).parameters
    level, seed, *others = _requested()
    order = [own["model"], own["output"], level, seed, own["force"], *others]
    order += [own["quiet"], own["as_json"]]
    parameters = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in order]
    simulate.__annotations__ = {p.name: p.annotation for p in parameters}
    vars(simulate)["__signature__"] = inspect.Signature(parameters)


_declare()
