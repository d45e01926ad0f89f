"""The table of the paper's evaluation for people."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from legcal.studies.paper_means import BOUND, Means, PaperMeans
from legcal.studies.paper_text import CONTEXT, PRINTED_AFTER, PRINTED_BEFORE, Printed

LABELS = {  # also of the figure
    "initial": "before",
    "literal": "steps as printed",
    "default": "legcal's steps",
    "fit": "one fit",
    "bound": "Cramer-Rao bound",
}
JOINTS = {"coplanar": "coplanar", "noncoplanar": "non-coplanar"}
_COLUMNS = ("dX [mm]", "dE [deg]", "parameters [mm]", "of bound", "runs")
_LARGE = 10.0  # in the unit of its column


def paper_table(found: PaperMeans, readings: Sequence[str]) -> RenderableType:
    """Return errors before and after calibration, beside the figures that the paper prints."""
    table = Table(box=None, pad_edge=False)
    table.add_column("joints", no_wrap=True)
    for column in _COLUMNS:
        table.add_column(Text(column), justify="right")
    for name in found.truths:
        table.add_row(JOINTS[name])
        for means in found.of(name):
            table.add_row(f" {LABELS[means.estimator]}", *_cells(means))
    table.add_row("paper, as printed")
    table.add_row(" before", *_printed_cells(PRINTED_BEFORE))
    table.add_row(" after", *_printed_cells(PRINTED_AFTER))
    notes = [*_failures(found), CONTEXT, *readings]
    return Group(table, Text(), *(Text(f"- {line}", style="dim") for line in notes))


def _cells(means: Means) -> tuple[str, ...]:
    """Return the figures of a row."""
    if means.n == 0:
        return ("all failed", "", "", "", "0")
    return (
        _with_sigma(1e3 * means.dX, 1e3 * means.dX_uncertainty, digits=3),
        f"{np.degrees(means.dE):.4f}",
        _range(1e3 * means.parameters.min(), 1e3 * means.parameters.max()),
        "1"
        if means.estimator == BOUND
        else _with_sigma(means.of_bound, means.of_bound_uncertainty, digits=2),
        f"{means.n}",
    )


def _printed_cells(printed: Printed) -> tuple[str, ...]:
    """Return the figures of a row that the paper prints."""
    between = "" if printed.parameters_mm is None else _range(*printed.parameters_mm)
    runs = "" if printed.runs is None else f"{printed.runs}"
    return (f"{printed.dX_mm:g}", f"{printed.dE_deg:g}", between, "", runs)


def _range(lowest: float, highest: float) -> str:
    """Return the least and the largest error of a parameter."""
    digits = 3 if highest < _LARGE else 1
    return f"{lowest:.{digits}f} to {highest:.{digits}f}"


def _with_sigma(mean: float, sigma: float, *, digits: int) -> str:
    """Return a mean and its standard deviation; large ones with fewer digits."""
    shown = digits if mean < _LARGE else digits - 2
    return f"{mean:.{shown}f} +- {sigma:.{shown}f}"


def _failures(found: PaperMeans) -> list[str]:
    """Return a sentence for each row that some runs are not in."""
    return [
        f"{LABELS[means.estimator]}, {JOINTS[means.machine]} joints: {failed} of "
        f"{means.n + failed} runs failed ({', '.join(means.failures)}) and are not in the means."
        for means in found.means
        if (failed := sum(means.failures.values()))
    ]
