"""What people read of a fleet: machine by machine, and why those that failed did."""

from __future__ import annotations

from pathlib import Path

from rich.console import RenderableType

from legcal.calibration.fleet import FleetDocument, fleet_cells, fleet_columns
from legcal.report.render import report, table

_MOST_ROWS = 60  # the files have all of them
_SHOWN = ("name", "status", "images", "change_mm", "sigma_mm", "drift_mm", "drift_sigma_mm")


def fleet_table(document: FleetDocument, output: Path) -> RenderableType:
    """Return the summary of a fleet."""
    columns = fleet_columns()
    shown = [columns.index(name) for name in _SHOWN]
    headings = [columns[k] if k < 2 else f">{columns[k]}" for k in shown]
    first = document.machines[:_MOST_ROWS]
    rows = [tuple(fleet_cells(row)[k] for k in shown) for row in first]
    failed = [row for row in document.machines if row.status == "failed"]
    lines = [f"{row.name} failed: {row.verdict}" for row in failed[:_MOST_ROWS]]
    lines += [f"{row.name}: no drift. {row.drift_note}" for row in first if row.drift_note]
    lines += [f"Note: {note}" for note in document.notes]
    counts = ", ".join(f"{n} {status}" for status, n in sorted(document.counts.items()))
    n = len(document.machines)
    lines.append(f"{n} machine{'s' * (n != 1)}: {counts}. All of it: {output}/summary.csv.")
    return report(table(*headings, rows=rows), lines)
