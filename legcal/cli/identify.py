"""``legcal identify``."""

from __future__ import annotations

from typing import Annotated

import typer

from legcal.cli.options import JsonOption
from legcal.cli.output import print_json, print_table


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
    board: Annotated[
        bool,
        typer.Option(
            "--board",
            help="A calibration board on the base is seen in every image: cameras are tied to "
            "each other.",
        ),
    ] = False,
    hand_held: Annotated[
        bool,
        typer.Option(
            "--hand-held",
            help="Every image of a view is taken from a place of its own; with --board.",
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Say which parameters a calibration can find, and what would mend what is missing."""
    from legcal.identify.request import answer

    views = [text.split(",") for text in view or []]
    report = answer(model, views, images, board=board, hand_held=hand_held)
    if as_json:
        print_json(report.document())
    else:
        from legcal.report.identify_table import identify_table

        print_table(identify_table(report))
