"""The page of a job without a page of its own: its tables and sentences in the common style."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from markupsafe import Markup

from legcal.pages.document import (
    Facts,
    Items,
    Page,
    Picture,
    Section,
    Table,
    Text,
    Verdict,
)
from legcal.pages.html import time_of_page
from legcal.report.render import Report
from legcal.version import __version__

_ITEM = "- "


def text_page(
    title: str,
    report: Report,
    *,
    verdict: Verdict | None = None,
    blocks: Sequence[Any] = (),
    command: str = "",
) -> Page:
    """Return a page with the tables and sentences of a report, followed by further blocks.

    The sentence of the verdict is not repeated.
    """
    when = time_of_page()
    record = {"Version": f"legcal {__version__}", "Command": command or "from Python", "Time": when}
    omitted = verdict.sentence if verdict is not None else ""
    sections = [Section("result", "Result", _blocks(report, omitted))]
    if blocks:
        sections.append(Section("figures", "Figures", blocks))
    sections.append(Section("record", "Reproducibility", [Facts(record)]))
    return Page(title, when, verdict, sections)


def picture(path: Path, caption: str) -> Picture:
    """Return a figure (PNG) as a part of a page."""
    data = base64.b64encode(path.read_bytes()).decode()
    return Picture(Markup(f"data:image/png;base64,{data}"), caption)


def _blocks(report: Report, omitted: str) -> list[Any]:
    """Return the parts of a report as blocks, without an omitted line."""
    blocks: list[Any] = []
    for part in (part for group in report.groups for part in group):
        if isinstance(part, Table):
            blocks.append(part)
            continue
        lines = [line for line in part.plain.splitlines() if line.strip() and line != omitted]
        for is_item, group in groupby(lines, lambda line: line.startswith(_ITEM)):
            kind, texts = (
                (Items if is_item else Text),
                [line_of_group.removeprefix(_ITEM) for line_of_group in group],
            )
            if blocks and type(blocks[-1]) is kind:
                texts = [*(blocks.pop().items if is_item else blocks.pop().paragraphs), *texts]
            blocks.append(kind(texts))
    return blocks
