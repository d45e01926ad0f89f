"""The command line: parses, calls, prints. What the commands do lives elsewhere.

Heavy imports happen inside the commands, so that ``legcal --help`` answers at once.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated

import typer

from legcal.cli.calibrate import calibrate
from legcal.cli.commands import camera, detect, evaluate, identify, inspect, locate, new, noise
from legcal.cli.options import print_failure
from legcal.cli.simulate import simulate
from legcal.cli.study import study
from legcal.errors import LegcalError, UsageError
from legcal.signals import stopped_by_signals
from legcal.version import __version__

ISSUES = "the issue tracker of legcal"
INTERRUPTED = 130
NO_COMMAND = "Nothing was done: found no command, needed one of those above."

app = typer.Typer(
    name="legcal",
    help="Calibrate parallel robots from photographs of their legs.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _print_version(is_given: bool) -> None:
    if is_given:
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


for command in (
    inspect,
    camera,
    identify,
    detect,
    calibrate,
    evaluate,
    locate,
    new,
    noise,
    simulate,
):
    app.command()(command)
app.add_typer(study, name="study")


def _refuse_empty(words: Sequence[str]) -> None:
    """Refuse an empty word, which as a path would mean the current folder."""
    for before, word in pairwise(["legcal", *words]):
        if word == "" or (word.startswith("--") and word.find("=") == len(word) - 1):
            raise UsageError(
                f"The command could not be run: found an empty text after '{word or before}', "
                "needed a name or a value; see that every variable in the command is set."
            )


def main() -> None:
    """Run the command line and exit with 0, 1 (data), 2 (use), 3 (internal) or 130 (stopped)."""
    # Thousands of small matrices: threads inside a product only get in each other's way.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    usage_error: type[Exception] = typer.BadParameter.__bases__[0]
    as_json = "--json" in sys.argv
    try:
        with stopped_by_signals():
            _refuse_empty(sys.argv[1:])
            code = app(standalone_mode=False)
    except LegcalError as error:
        print_failure(type(error).__name__, str(error), as_json=as_json)
        code = error.exit_code
    except usage_error as error:
        message = getattr(error, "format_message", error.__str__)()
        print_failure("UsageError", message or NO_COMMAND, as_json=as_json)
        code = 2
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except Exception as error:  # the one place that may: the boundary to the shell
        traceback.print_exc()
        print_failure(
            "InternalError",
            f"This is a mistake in legcal {__version__}, not in your data: "
            f"{type(error).__name__}: {error}; please report it with the "
            f"lines above to {ISSUES}.",
            as_json=as_json,
        )
        code = 3
    if code == INTERRUPTED:  # typer turns the interrupt of a command into this code
        print_failure("Interrupted", "Stopped before the end.", as_json=as_json)
    sys.exit(code if isinstance(code, int) else 0)
