"""``legcal view``."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from legcal.cli.options import print_table
from legcal.errors import printable


def view(
    source: Annotated[
        str,
        typer.Argument(
            metavar="MODEL|RESULT|DATASET",
            help="A mechanism as for inspect, the folder that calibrate wrote, or a dataset.",
        ),
    ],
    dataset: Annotated[
        Path | None,
        typer.Option(help="The dataset of a result or a model, for its poses and photographs."),
    ] = None,
    host: Annotated[
        str, typer.Option(help="Access: 127.0.0.1 for this machine only, 0.0.0.0 for all.")
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="The port; 0 for any that is free.")
    ] = 8080,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the browser.")
    ] = True,
) -> None:
    """Show a machine in the browser, moved by sliders: readings, pose, photographs, uncertainty."""
    from rich.text import Text

    from legcal.viewer.address import Address, check_address
    from legcal.viewer.source import open_source
    from legcal.viewer.window import Window, require_viser

    require_viser()
    address = Address(host, port)
    check_address(address)
    window = Window(open_source(source, dataset), address)
    name = printable(window.source.name)
    print_table(Text(f"{window.address} shows {name}; Ctrl-C ends it.", overflow="fold"))
    if browser:
        open_browser(str(window.address))
    try:
        window.run()
    except KeyboardInterrupt:  # the way to end it
        window.close()


def open_browser(address: str) -> None:
    """Open the browser at an address, where it can have windows."""
    if _has_screen():
        import webbrowser

        webbrowser.open(address)


def _has_screen() -> bool:
    """Return whether a browser with windows can be opened."""
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
