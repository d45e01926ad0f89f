"""The page of the study of the classes: its two tables in Markdown, and why estimators failed."""

from __future__ import annotations

from collections.abc import Sequence

from legcal.studies.classes_statistics import ClassStatistics
from legcal.studies.classes_table import NOTES, platform_cells, remarks, worth_cells


def classes_page(machines: Sequence[ClassStatistics], readings: Sequence[str]) -> str:
    """Return the page."""
    said = [line for found in machines for line in remarks(found)]
    return "\n".join(
        [
            "# Machines of every class, calibrated",
            "",
            "Written by `legcal study classes`.",
            "",
            "## What the fit is worth",
            "",
            "| machine | directions determined | runs | error / bound "
            "| normalised squared error | 95 % intervals that hold the truth | verdict |",
            "|---|---|---|---|---|---|---|",
            *(f"| {' | '.join((found.machine, *worth_cells(found)))} |" for found in machines),
            "",
            "## Errors of the platform, mm and deg",
            "",
            "| machine | nominal model | four steps as printed | four steps, legcal's criteria "
            "| one fit of everything |",
            "|---|---|---|---|---|",
            *(f"| {' | '.join((found.machine, *platform_cells(found)))} |" for found in machines),
            "",
            *(f"- {line}" for line in (*NOTES, *readings)),
            "",
            *(["## What failed, and what else is to be said", ""] if said else []),
            *(f"- {line}" for line in said),
            *([""] if said else []),
        ]
    )
