"""The table of the study of the bound for people."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from legcal.studies.bound_statistics import BoundStatistics
from legcal.studies.outline_figures import figure_remarks

COLUMNS = ("runs", "each/bound", "all/bound", "nse", "covered", "verdict")


def bound_table(machines: Sequence[BoundStatistics], readings: Sequence[str]) -> RenderableType:
    """Return one row a machine, and what is to be said of them."""
    table = Table(box=None, pad_edge=False)
    table.add_column("machine", no_wrap=True)
    for column in COLUMNS:
        table.add_column(Text(column), justify="right", no_wrap=True)
    for found in machines:
        table.add_row(found.machine, *cells(found))
    notes = [line for found in machines for line in remarks(found)] + [*readings]
    return Group(table, Text(), *(Text(f"- {line}", style="dim") for line in notes))


def cells(found: BoundStatistics) -> tuple[str, ...]:
    """Return the figures of a machine in the order of ``COLUMNS``."""
    if found.n == 0:
        return ("0", "", "", "", "", "all failed")
    ratio, nse, coverage = (figure.value for figure in found.pooled)
    return (
        f"{found.n}",
        f"{found.ratio.min():.3f} to {found.ratio.max():.3f}",
        f"{ratio:.3f}",
        f"{nse:.3f}",
        f"{100.0 * coverage:.1f} %",
        "met" if found.is_met else "not met",
    )


def remarks(found: BoundStatistics) -> list[str]:
    """Return what else is to be said of a machine, one sentence each."""
    said = []
    if found.failures:
        kinds = ", ".join(f"{count} {kind}" for kind, count in found.failures.items())
        said.append(f"{found.machine}: {kinds}: runs that failed are in no figure.")
    if found.n == 0:
        return said
    low, high = found.band
    names = [f"{found.bound.names[i]} {found.ratio[i]:.3f}" for i in found.outside.nonzero()[0]]
    told = f"outside are {', '.join(names)}" if names else "no parameter is outside"
    said.append(
        f"{found.machine}: 99.9 % of all ratios of {found.n} runs are within {low:.3f} to "
        f"{high:.3f} at the bound; {told}."
    )
    return said + figure_remarks(found.machine, found.n, found.pooled)
