"""Options of a command as the fields of a dataclass: what reads them declares them, once.

Nothing but the standard library is imported here, so that help and completion answer at once.
"""

from __future__ import annotations

from typing import Any


def option(
    text: str,
    panel: str | None = None,
    *,
    flags: tuple[str, ...] = (),  # as typer.Option takes them; by default of the field's name
    metavar: str | None = None,
    shown: str | None = None,  # as the default, where None stands for it
) -> dict[str, Any]:
    """Return the metadata of a field that is an option: what the command line knows beside it."""
    how = {"flags": flags, "help": text, "rich_help_panel": panel, "metavar": metavar}
    if shown is not None:
        how["show_default"] = shown
    return {"option": how}


def flag(name: str) -> str:
    """Return the option of a field without flags of its own."""
    return f"--{name.replace('_', '-')}"
