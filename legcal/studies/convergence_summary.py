"""What the study of convergence hands back: its document and its table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from legcal.studies.convergence_outcomes import Outcomes

if TYPE_CHECKING:
    from rich.console import RenderableType


@dataclass(frozen=True, eq=False)
class ConvergenceSummary:
    """The outcomes of every machine.

    Attributes
    ----------
    machines : tuple of Outcomes
        In the order in which they were asked for.
    readings : tuple of str
        How the experiment was made, one sentence each.
    """

    machines: tuple[Outcomes, ...]
    readings: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """Return the document of ``--json``."""
        return {
            "machines": [found.document() for found in self.machines],
            "met": all(found.is_met for found in self.machines),
            "readings": list(self.readings),
        }

    def table(self) -> RenderableType:
        """Return the table for people."""
        from legcal.studies.convergence_table import convergence_table

        return convergence_table(self.machines, self.readings)

    def files(self) -> dict[str, bytes]:
        """Return nothing: there is no figure."""
        return {}
