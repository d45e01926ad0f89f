"""What people read of a look at a dataset: figures, findings with remedies, what comes next."""

from __future__ import annotations

from pathlib import Path

from rich.console import RenderableType
from rich.text import Text

from legcal.calibration.examination import Examination
from legcal.calibration.examination_page import DETECTION_PAGE, tables_of
from legcal.errors import printable
from legcal.report.render import heading, report, text_table

_STYLES = {"note": "green", "warning": "yellow", "error": "red"}


def examination_table(found: Examination, output: Path | None = None) -> RenderableType:
    """Return what ``legcal doctor`` and ``legcal detect`` print; output is what was written."""
    return report(
        heading(printable(found.mechanism), f": {printable(found.dataset)}"),
        *map(text_table, tables_of(found)),
        [
            Text.assemble((f"{one.severity}: ", _STYLES[one.severity]), printable(one.what))
            for one in found.findings
        ],
        [found.sentence, "" if output is None else f"Look at {output / DETECTION_PAGE}."],
    )
