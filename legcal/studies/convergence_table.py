"""The table of the study of convergence for people."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from legcal.studies.convergence_outcomes import Outcomes
from legcal.studies.convergence_record import FAR

_COLUMNS = ("right", "refused", "wrong", "before", "after", "1 sigma", "verdict")


def convergence_table(machines: Sequence[Outcomes], readings: Sequence[str]) -> RenderableType:
    """Return one row a machine, and what is to be said of them."""
    table = Table(box=None, pad_edge=False)
    table.add_column("machine", no_wrap=True)
    for column in _COLUMNS:
        table.add_column(Text(column), justify="right", no_wrap=True)
    for found in machines:
        table.add_row(found.machine, *_cells(found))
    notes = [
        f"right: every parameter is within {FAR:g} of the standard deviations that the fit states, "
        "and the platform within as many of those that follow. Refused: the fit ends with an "
        "error. Wrong: with a sigma that is too small.",
        "before, after, 1 sigma: displacement of the platform at the poses measured, root mean "
        "square over all fits that ended [mm]: of the nominal model, of the fitted one, and what "
        "the fit predicts of that.",
        *(_refusals(found) for found in machines if found.refused),
        *readings,
    ]
    return Group(table, Text(), *(Text(f"- {line}", style="dim") for line in notes))


def _cells(found: Outcomes) -> tuple[str, ...]:
    """Return the figures of a machine in the order of the columns."""
    counts = (f"{found.right}", f"{sum(found.refused.values())}", f"{found.wrong}")
    verdict = "met" if found.is_met else "not met"
    if found.right + found.wrong == 0:
        return (*counts, "", "", "", verdict)
    before, after, predicted = (
        1e3 * float(x[0]) for x in (found.before, found.after, found.predicted)
    )
    return (*counts, f"{before:.2f}", f"{after:.4f}", f"{predicted:.4f}", verdict)


def _refusals(found: Outcomes) -> str:
    """Return how fits of a machine were refused, in a sentence."""
    kinds = ", ".join(f"{count} {kind}" for kind, count in found.refused.items())
    return f"{found.machine}: refused with {kinds}."
