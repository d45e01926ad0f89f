"""Text report of an examination: figures, findings with remedies, next command."""

from __future__ import annotations

from pathlib import Path

from rich.console import RenderableType
from rich.text import Text

from legcal.calibration.examination import Examination
from legcal.calibration.examination_page import DETECTION_PAGE, tables_of
from legcal.errors import printable
from legcal.report.render import heading, report, text_table

_STYLES = {"note": "green", "warning": "yellow", "error": "red"}


def examination_table(examination: Examination, output: Path | None = None) -> RenderableType:
    """Return the text of ``legcal doctor`` and ``legcal detect``; *output* is the folder."""
    return report(
        heading(printable(examination.mechanism), f": {printable(examination.dataset)}"),
        *map(text_table, tables_of(examination)),
        [
            Text.assemble(
                (f"{finding.severity}: ", _STYLES[finding.severity]), printable(finding.what)
            )
            for finding in examination.findings
        ],
        [examination.sentence, "" if output is None else f"Look at {output / DETECTION_PAGE}."],
    )
