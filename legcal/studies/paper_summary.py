"""What the paper's evaluation hands back: its document, its table and its figure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from legcal.studies.paper_means import INITIAL, PaperMeans
from legcal.studies.paper_text import (
    CONTEXT,
    IN_DEGREES,
    IN_RADIANS,
    PRINTED_AFTER,
    PRINTED_BEFORE,
    READINGS,
)

if TYPE_CHECKING:
    from rich.console import RenderableType


@dataclass(frozen=True, eq=False)
class PaperSummary:
    """The paper's evaluation, before and after, for every estimator.

    Attributes
    ----------
    found : PaperMeans
        The means over all runs.
    in_radians : bool
        Whether Table 1 was read in radians.
    """

    found: PaperMeans
    in_radians: bool

    @property
    def readings(self) -> tuple[str, ...]:
        """How the paper's text was read where it leaves a choice."""
        return (IN_RADIANS if self.in_radians else IN_DEGREES, *READINGS)

    def document(self) -> dict[str, Any]:
        """Return the document of ``--json``."""
        found = self.found
        return {
            "rows": [means.document() for means in found.means if means.estimator != INITIAL],
            "initial": [means.document() for means in found.means if means.estimator == INITIAL],
            "names": list(found.names),
            "true_values_mm": {name: (1e3 * xi).tolist() for name, xi in found.truths.items()},
            "as_printed": {
                "initial": PRINTED_BEFORE.document(),
                "calibrated": PRINTED_AFTER.document(),
                "note": CONTEXT,
            },
            "readings": list(self.readings),
        }

    def table(self) -> RenderableType:
        """Return the table for people."""
        from legcal.studies.paper_table import paper_table

        return paper_table(self.found, self.readings)

    def files(self) -> dict[str, bytes]:
        """Return figure 4, to look at in a browser and as a picture."""
        from legcal.studies.paper_figure import figure_as_html, figure_as_png

        return {"fig4.html": figure_as_html(self.found), "fig4.png": figure_as_png(self.found)}
