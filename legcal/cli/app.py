"""The command line: parses, calls, prints. The work of the commands is elsewhere.

Heavy imports happen inside the commands, so that ``legcal --help`` answers at once, and a command
loads no other.
"""

from __future__ import annotations

import os
import sys
import traceback
import warnings
from collections.abc import Sequence
from importlib import import_module
from itertools import pairwise
from typing import Annotated, Any

import typer
from typer.core import TyperArgument, TyperCommand, TyperGroup

from legcal.cli.options import print_failure
from legcal.errors import LegcalError, UsageError, printable
from legcal.signals import INTERRUPTED, raise_if_stopped
from legcal.version import __version__

ISSUES = "the issue tracker of legcal"
NO_COMMAND = "No command given: choose one of those above."


class _PlainHelp:
    """Help by panels in plain text, which loads neither rich nor pydantic."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters; flags that are not given are false."""
        parameters: list[Any] = super().get_params(ctx)  # type: ignore[misc]
        for parameter in parameters:
            if getattr(parameter, "is_flag", False) and parameter.default is None:
                parameter.default = False  # pydantic would be loaded to convert None
        return parameters

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write options, and the commands of a group, by panel."""
        panels: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
        for parameter in self.get_params(ctx):
            panel = "Arguments" if isinstance(parameter, TyperArgument) else "Options"
            if (record := parameter.get_help_record(ctx)) is not None:
                panels.setdefault(parameter.rich_help_panel or panel, []).append(record)
        for name, command in getattr(self, "commands", {}).items():
            text = command.get_short_help_str(1000)
            panels.setdefault(command.rich_help_panel or "Commands", []).append((name, text))
        for panel, rows in panels.items():
            if rows:
                with formatter.section(panel):
                    formatter.write_dl(rows)


class _Command(_PlainHelp, TyperCommand):
    pass


class _Group(_PlainHelp, TyperGroup):
    pass


def _print_version(is_given: bool) -> None:
    if is_given:
        typer.echo(f"legcal {__version__}")
        raise typer.Exit


def _root(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    """Calibrate parallel robots from photographs of their legs."""


# By panel of the help, and the module that has them
COMMANDS: dict[str, dict[str, tuple[str, ...]]] = {
    "Your machine": {"machines": ("new", "inspect", "identify")},
    "Photographs": {"sessions": ("camera", "plan", "shoot", "init", "import", "doctor", "detect")},
    "Calibrate": {"calibrate": ("calibrate",)},
    "Results": {"machines": ("evaluate", "locate", "export", "view")},
    "No machine yet": {"machines": ("example",), "simulated": ("simulate",)},
    "For programs": {"machines": ("schema",), "simulated": ("study",)},
}


def commands(words: Sequence[str] = ()) -> typer.Typer:
    """Return the command line: of all commands, or of the one that the words begin with."""
    app = typer.Typer(
        name="legcal",
        help="Calibrate parallel robots from photographs of their legs.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        cls=_Group,
        rich_markup_mode=None,
    )
    app.callback()(_root)
    known = [
        (panel, module, name)
        for panel, modules in COMMANDS.items()
        for module, names in modules.items()
        for name in names
    ]
    for panel, module, name in [one for one in known if one[2] in words[:1]] or known:
        loaded = import_module(f"legcal.cli.{module}")
        if isinstance(found := getattr(loaded, {"import": "import_"}.get(name, name)), typer.Typer):
            app.add_typer(found, name=name, cls=_Group, rich_help_panel=panel)
        else:
            app.command(name, cls=_Command, rich_help_panel=panel)(found)
    return app


def _refuse_empty(words: Sequence[str]) -> None:
    """Refuse an empty word, which as a path would mean the current folder."""
    for before, word in pairwise(["legcal", *words]):
        if word == "" or (word.startswith("--") and word.find("=") == len(word) - 1):
            raise UsageError(
                f"The command could not be run: found an empty text after '{word or before}', "
                "needed a name or a value; see that every variable in the command is set."
            )


_GONE = {
    "calibrate": {
        "--fix": "write --set NAME, or --set NAME=VALUE",
        "--free": "write --set NAME=free",
        "--prior": "write --set NAME=VALUE±SIGMA",
    },
    "locate": {
        "--urdf": "write T_world_base and T_platform_tool of the -o FILE into the URDF, as fixed "
        "joints"
    },
}


def _refuse_gone(words: Sequence[str]) -> None:
    """Refuse options that are gone, with what takes their place."""
    gone = _GONE.get(words[0], {}) if words else {}
    options = dict.fromkeys(word.partition("=")[0] for word in words)
    problems = [
        f"{option} of legcal {words[0]} is gone: {gone[option]}."
        for option in options
        if option in gone
    ]
    if problems:
        raise UsageError(problems)


def _with_remedy(error: Exception) -> str:
    """Return the message of typer on options and arguments, with a remedy."""
    message = str(getattr(error, "format_message", error.__str__)()).replace("Value error, ", "")
    if message.startswith("Usage:"):  # the help of a group without a command
        print(message, file=sys.stderr)
        return NO_COMMAND
    context = getattr(error, "ctx", None)
    command = " ".join(["legcal", *context.command_path.split()[1:]]) if context else "legcal"
    return (
        f"The command could not be run: {message.rstrip('.')}; {command} --help lists what it "
        "takes."
    )


def _print_warning(message: Warning | str, *_others: object, **_more: object) -> None:
    """Print a warning on stderr in one line."""
    if sys.stderr is not None:
        sys.stderr.write(f"legcal: {printable(str(message))}\n")


def run(*, as_json: bool) -> int:
    """Run the command line and return 0, 1 (data), 2 (use) or 3 (internal)."""
    # Thousands of small matrices: threads inside a product would only block each other.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    # Plugins of pydantic are not needed here, and the search for them covers all packages.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    warnings.showwarning = _print_warning
    usage_error: type[Exception] = typer.BadParameter.__bases__[0]
    try:
        _refuse_empty(sys.argv[1:])
        _refuse_gone(sys.argv[1:])
        code = commands(sys.argv[1:])(standalone_mode=False, prog_name="legcal")
    except typer.Abort as error:
        raise KeyboardInterrupt from error
    except Exception as error:  # allowed only here, at the boundary to the shell
        raise_if_stopped()  # libraries turn interrupts into other errors
        if isinstance(error, LegcalError):
            kind = type(error).__name__
            print_failure(
                kind,
                str(error),
                as_json=as_json,
                problems=error.documents(),
                diagnosis=error.diagnosis,
                notes=error.notes,
            )
            return error.exit_code
        if isinstance(error, usage_error):
            print_failure("UsageError", _with_remedy(error), as_json=as_json)
            return 2
        print(*map(printable, traceback.format_exc().split("\n")), sep="\n", file=sys.stderr)
        print_failure(
            "InternalError",
            f"This is a mistake in legcal {__version__}, not in your data: "
            f"{type(error).__name__}: {error}; please report it with the "
            f"lines above to {ISSUES}.",
            as_json=as_json,
        )
        return 3
    if code == INTERRUPTED:  # typer turns the interrupt of a command into this code
        raise KeyboardInterrupt
    return code if isinstance(code, int) else 0
