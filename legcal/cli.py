"""The command line: parses, calls, prints. What the commands do lives elsewhere.

Heavy imports happen inside the commands, so that ``legcal --help`` answers at once.
"""

from __future__ import annotations

import json
import os
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from legcal.errors import LegcalError, OutOfResources
from legcal.signals import stopped_by_signals
from legcal.version import __version__

if TYPE_CHECKING:
    from rich.console import RenderableType

ISSUES = "the issue tracker of legcal"
INTERRUPTED = 130
MOST_WORKERS = 4  # processes that search images; each takes about 150 MB


class Criteria(StrEnum):
    """What the four steps minimise."""

    DEFAULT = "default"
    LITERAL = "literal"


app = typer.Typer(
    name="legcal",
    help="Calibrate parallel robots from photographs of their legs.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

ModelArgument = Annotated[
    str,
    typer.Argument(
        metavar="MODEL",
        help="A mechanism YAML, a URDF, an MJCF file, a robot.yaml folder or a shipped name.",
    ),
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print one JSON document on stdout and nothing else there.")
]


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"legcal {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    """Calibrate parallel robots from photographs of their legs."""


@app.command()
def inspect(
    model: ModelArgument,
    as_json: JsonOption = False,
    write: Annotated[
        Path | None,
        typer.Option(
            "--write",
            metavar="DIR",
            help="Write the model down as DIR/models/NAME.yaml and DIR/urdf/NAME.urdf.",
        ),
    ] = None,
) -> None:
    """Show a mechanism as legcal understands it: legs, joints, frames, mobility."""
    from legcal.mechanism.inspect import describe
    from legcal.mechanism.load import load_mechanism

    mechanism = load_mechanism(model)
    description = describe(mechanism)
    if write is not None:
        from legcal.report.model_files import write_model

        for path in write_model(mechanism, write):
            typer.echo(f"Wrote {path}.", err=True)
    if as_json:
        _print_json(description)
    else:
        from legcal.report.inspect_table import inspect_table

        _print(inspect_table(description))


@app.command()
def identify(
    model: Annotated[
        str,
        typer.Argument(
            metavar="MODEL|DATASET",
            help="A mechanism as for inspect, or a dataset folder, whose own views are judged.",
        ),
    ],
    view: Annotated[
        list[str] | None,
        typer.Option(
            "--view",
            metavar="LEG,LEG,...",
            help="The legs that one camera position shows; once for each position. Without any, "
            "the smallest sets of views that suffice are recommended.",
        ),
    ] = None,
    images: Annotated[
        int | None, typer.Option(help="Images a view, each of another pose; 15 without it.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Say which parameters a calibration can find, and what would mend what is missing."""
    from legcal.identify.request import answer

    report = answer(model, [text.split(",") for text in view or []], images)
    if as_json:
        _print_json(report.document())
    else:
        from legcal.report.identify_table import identify_table

        _print(identify_table(report))


@app.command()
def calibrate(
    dataset: Annotated[
        Path, typer.Argument(metavar="DATASET", help="The folder that holds dataset.yaml.")
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUT", help="The result folder to write.")
    ],
    as_json: JsonOption = False,
    criteria: Annotated[
        Criteria,
        typer.Option(help="What the four steps minimise: legcal's criteria, or the paper's."),
    ] = Criteria.DEFAULT,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Detect again, even where a cached detection fits.")
    ] = False,
) -> None:
    """Compute the calibrated model from images and encoder readings."""
    from legcal.pipeline import calibrate as run
    from legcal.report.progress_bars import progress_on_stderr
    from legcal.report.result import result_document

    with progress_on_stderr() as progress:
        calibration = run(
            dataset,
            output=output,
            progress=progress,
            criteria=criteria.value,
            use_cache=not fresh,
            workers=min(_processors(), MOST_WORKERS),
        )
    if as_json:
        _print_json(result_document(calibration))
    else:
        from legcal.report.summary import summary

        _print(summary(calibration, output))
    if not calibration.verdict.trustworthy:
        raise typer.Exit(1)


@app.command()
def evaluate(
    model: ModelArgument,
    reference: Annotated[
        str, typer.Argument(metavar="REFERENCE", help="The model to compare with, often the truth.")
    ],
    dataset: Annotated[
        Path | None,
        typer.Option(
            "--dataset",
            metavar="DATASET",
            help="Compare at the readings of this dataset instead of 100 random poses.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare two models: platform errors of eq (20), and every parameter."""
    from legcal.report.accuracy import evaluate as run

    evaluation = run(model, reference, dataset=dataset)
    if as_json:
        _print_json(evaluation.document())
    else:
        from legcal.report.accuracy_table import accuracy_table

        _print(accuracy_table(evaluation))


@app.command()
def new(
    table: Annotated[
        Path | None,
        typer.Argument(
            metavar="[TABLE]", help="A YAML or CSV table of the legs.", show_default=False
        ),
    ] = None,
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="DIR", help="The folder of models/ and urdf/."),
    ] = ...,  # type: ignore[assignment]
    family: Annotated[
        str | None, typer.Option(help="Instead of a table: number and type of legs, 6-UPS.")
    ] = None,
    unit: Annotated[str | None, typer.Option(help="Unit of all lengths: mm or m.")] = None,
    name: Annotated[str | None, typer.Option(help="Name of the model and its files.")] = None,
    base_radius: Annotated[float | None, typer.Option(help="Circle of the base joints.")] = None,
    platform_radius: Annotated[
        float | None, typer.Option(help="Circle of the platform joints.")
    ] = None,
    height: Annotated[float | None, typer.Option(help="Of the platform over the base.")] = None,
    base_spread: Annotated[
        float | None, typer.Option(help="Angle in a pair of base joints (6 legs), in degrees: 30.")
    ] = None,
    platform_spread: Annotated[
        float | None, typer.Option(help="Angle in a pair of platform joints: 30.")
    ] = None,
    turn: Annotated[
        float | None,
        typer.Option(help="Of the platform about z, in degrees: 0; planar 30."),
    ] = None,
    offset: Annotated[float | None, typer.Option(help="Leg length at reading zero.")] = None,
    travel: Annotated[
        tuple[float, float] | None, typer.Option(help="Lowest and highest reading.")
    ] = None,
    leg_radius: Annotated[float | None, typer.Option(help="Radius of tube and rod.")] = None,
    tilt: Annotated[
        float | None,
        typer.Option(help="Of R and U axes from their default, in degrees: 0."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace files that are there.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Write a model, YAML and URDF, from a table of joints or a few dimensions."""
    from legcal.authoring.create import create_model
    from legcal.authoring.request import described
    from legcal.mechanism.inspect import describe

    dimensions = {
        "base_radius": base_radius,
        "platform_radius": platform_radius,
        "height": height,
        "base_spread": base_spread,
        "platform_spread": platform_spread,
        "turn": turn,
        "offset": offset,
        "travel": travel,
        "leg_radius": leg_radius,
        "tilt": tilt,
    }
    asked = described(table, family=family, unit=unit, name=name, dimensions=dimensions)
    created = create_model(asked, output, force=force)
    description = describe(created.mechanism)
    if as_json:
        paths = {"yaml": str(created.yaml_path), "urdf": str(created.urdf_path)}
        _print_json(description | {"paths": paths})
    else:
        from rich.text import Text

        from legcal.report.inspect_table import inspect_table

        _print(inspect_table(description))
        _print(Text(f"\nwritten: {created.yaml_path} {created.urdf_path}", overflow="ignore"))


def _processors() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _print(renderable: RenderableType) -> None:
    from rich.console import Console

    with _writing_to_stdout():
        Console(highlight=False).print(renderable)
        sys.stdout.flush()


def _print_json(document: dict[str, Any]) -> None:
    with _writing_to_stdout():
        sys.stdout.write(json.dumps(document, allow_nan=False) + "\n")
        sys.stdout.flush()


@contextmanager
def _writing_to_stdout() -> Iterator[None]:
    """Say what keeps the output from being written; a reader that has left is none of that."""
    found = "that it is closed"
    if sys.stdout is not None:
        try:
            yield
            return
        except BrokenPipeError:
            raise
        except OSError as error:
            found = f"'{error.strerror}'"
            _leave_stdout()
    raise OutOfResources(
        f"The output could not be printed: found {found}, needed a stdout that takes it; send it "
        "elsewhere."
    )


def _leave_stdout() -> None:
    """Let what is left in the buffer of stdout go nowhere, so that nothing fails there again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.stdout = None


def _fail(kind: str, message: str, *, as_json: bool) -> None:
    if as_json:
        with suppress(OutOfResources):
            _print_json({"error": {"kind": kind, "message": message}})
            return
    if sys.stderr is not None:
        sys.stderr.write(f"legcal: {message}\n")


def main() -> None:
    """Run the command line and exit with 0, 1 (data), 2 (use), 3 (internal) or 130 (stopped)."""
    # Thousands of small matrices: threads inside a product only get in each other's way.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    usage_error: type[Exception] = typer.BadParameter.__bases__[0]
    as_json = "--json" in sys.argv
    try:
        with stopped_by_signals():
            code = app(standalone_mode=False)
    except LegcalError as error:
        _fail(type(error).__name__, str(error), as_json=as_json)
        code = error.exit_code
    except usage_error as error:
        _fail("UsageError", getattr(error, "format_message", error.__str__)(), as_json=as_json)
        code = 2
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except Exception as error:  # the one place that may: the boundary to the shell
        traceback.print_exc()
        _fail(
            "InternalError",
            f"This is a mistake in legcal {__version__}, not in your data: "
            f"{type(error).__name__}: {error}; please report it with the "
            f"lines above to {ISSUES}.",
            as_json=as_json,
        )
        code = 3
    if code == INTERRUPTED:  # typer turns the interrupt of a command into this code
        _fail("Interrupted", "Stopped before the end.", as_json=as_json)
    sys.exit(code if isinstance(code, int) else 0)
