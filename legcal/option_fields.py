"""Options of a command as the fields of a dataclass, declared once beside the code that uses them.

Only the standard library is imported here, so that help and completion answer at once.
"""

from __future__ import annotations

from typing import Any


def option(
    text: str,
    panel: str | None = None,
    *,
    flags: tuple[str, ...] = (),  # for typer.Option; by default from the name of the field
    metavar: str | None = None,
    shown: str | None = None,  # text for a default of None
) -> dict[str, Any]:
    """Return the metadata of a field that is an option of the command line."""
    keywords = {"flags": flags, "help": text, "rich_help_panel": panel, "metavar": metavar}
    if shown is not None:
        keywords["show_default"] = shown
    return {"option": keywords}


def flag(name: str) -> str:
    """Return the option of a field without explicit flags."""
    return f"--{name.replace('_', '-')}"
