"""Text report of an examination: figures, findings with remedies, next command."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rich.text import Text

from legcal.calibration.detection_folder import DETECTION_PAGE, tables_of
from legcal.calibration.examination import Examination
from legcal.errors import printable
from legcal.pages.document import Table
from legcal.report.render import Report, heading, report

_STYLES = {"note": "green", "warning": "yellow", "error": "red"}


def examination_table(examination: Examination, output: Path | None = None) -> Report:
    """Return the text of ``legcal doctor`` and ``legcal detect``; *output* is the folder."""
    return report(
        heading(printable(examination.mechanism), f": {printable(examination.dataset)}"),
        *map(_with_dashes, tables_of(examination)),
        [
            Text.assemble(
                (f"{finding.severity}: ", _STYLES[finding.severity]), printable(finding.what)
            )
            for finding in examination.findings
        ],
        [examination.sentence, "" if output is None else f"Look at {output / DETECTION_PAGE}."],
    )


def _with_dashes(table: Table) -> Table:
    """Return a table whose empty cells have dashes."""
    texts = [[cell if isinstance(cell, str) else cell.text for cell in row] for row in table.rows]
    return replace(table, rows=[[printable(text) or "-" for text in row] for row in texts])
