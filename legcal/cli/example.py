"""``legcal example``."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from legcal.cli.options import JsonOption, show


def example(
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="The new folder for it.")
    ],
    as_json: JsonOption = False,
) -> None:
    """Copy the dataset that comes with legcal: a hexapod, 45 photographs (11 MB)."""
    from rich.text import Text

    from legcal.data.example import copy_example
    from legcal.report.render import report

    copy_example(output)
    lines = (
        f"written: {output}",
        f"Next: legcal calibrate {shlex.quote(str(output))} -o calibrated",
    )
    show(
        as_json,
        lambda: {"path": str(output)},
        lambda: report([Text(line, overflow="ignore") for line in lines]),
    )
