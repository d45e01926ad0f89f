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
        help="A mechanism YAML, a URDF with its YAML beside it, or the name of a shipped model.",
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
def inspect(model: ModelArgument, as_json: JsonOption = False) -> None:
    """Show a mechanism as legcal understands it: legs, joints, frames, mobility."""
    from legcal.mechanism.inspect import describe
    from legcal.mechanism.load import load_mechanism

    description = describe(load_mechanism(model))
    if as_json:
        _print_json(description)
    else:
        from legcal.report.inspect_table import inspect_table

        _print(inspect_table(description))


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
