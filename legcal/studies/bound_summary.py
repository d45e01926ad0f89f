"""What the study of the bound hands back: its document, its table, and its page."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from legcal.studies.bound_statistics import BoundStatistics

if TYPE_CHECKING:
    from rich.console import RenderableType


@dataclass(frozen=True, eq=False)
class BoundSummary:
    """The statistics of every machine.

    Attributes
    ----------
    machines : tuple of BoundStatistics
        In the order in which they were asked for.
    readings : tuple of str
        How the experiment was made, one sentence each.
    """

    machines: tuple[BoundStatistics, ...]
    readings: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """Return the document of ``--json``."""
        return {
            "machines": [_document(found) for found in self.machines],
            "met": all(found.is_met for found in self.machines),
            "readings": list(self.readings),
        }

    def table(self) -> RenderableType:
        """Return the table for people."""
        from legcal.studies.bound_table import bound_table

        return bound_table(self.machines, self.readings)

    def files(self) -> dict[str, bytes]:
        """Return the page with every parameter."""
        from legcal.studies.bound_page import bound_page

        return {"bound.md": bound_page(self.machines, self.readings).encode()}


def _document(found: BoundStatistics) -> dict[str, Any]:
    """Return what one machine showed; without a run that did not fail there are no figures."""
    rows = zip(
        found.bound.names,
        found.bound.units,
        found.bound.sigma.tolist(),
        found.ratio.tolist(),
        found.nse.tolist(),
        found.coverage.tolist(),
        found.outside.tolist(),
        strict=True,
    )
    keys = ("name", "unit", "bound", "ratio", "nse", "coverage", "outside_band")
    return {
        "machine": found.machine,
        "met": found.is_met,
        "runs": found.n,
        "failed": sum(found.failures.values()),
        "failures": found.failures,
        "band": list(found.band),
        "pooled": {
            figure.name: {
                "value": figure.value,
                "limits": [figure.low, figure.high],
                "limits_of_chance": figure.by_chance,
                "met": figure.is_met,
            }
            for figure in found.pooled
        },
        "parameters": [dict(zip(keys, row, strict=True)) for row in rows] if found.n else [],
    }
