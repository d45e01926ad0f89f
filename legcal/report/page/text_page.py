"""The page of a job without a page of its own: its tables and sentences in the common style."""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from markupsafe import Markup
from rich.console import Group, RenderableType
from rich.table import Table as TextTable
from rich.text import Text as TextLine

from legcal.pages.document import (
    Cell,
    Facts,
    Items,
    Number,
    Page,
    Picture,
    Section,
    Table,
    Text,
    Verdict,
)
from legcal.pages.html import time_of_page
from legcal.version import __version__

_NUMBER = re.compile(r"[+-]?\d+(\.\d+)?(e[+-]?\d+)?")  # start of a cell that sorts by its value
_ITEM = "- "


def text_page(
    title: str,
    text: RenderableType,
    *,
    verdict: Verdict | None = None,
    blocks: Sequence[Any] = (),
    command: str = "",
) -> Page:
    """Return a page with the tables and sentences of a text, followed by further blocks.

    The sentence of the verdict is not repeated.
    """
    when = time_of_page()
    record = {"Version": f"legcal {__version__}", "Command": command or "from Python", "Time": when}
    omitted = verdict.sentence if verdict is not None else ""
    sections = [Section("result", "Result", _blocks(text, omitted))]
    if blocks:
        sections.append(Section("figures", "Figures", blocks))
    sections.append(Section("record", "Reproducibility", [Facts(record)]))
    return Page(title, when, verdict, sections)


def picture(path: Path, caption: str) -> Picture:
    """Return a figure (PNG) as a part of a page."""
    data = base64.b64encode(path.read_bytes()).decode()
    return Picture(Markup(f"data:image/png;base64,{data}"), caption)


def _blocks(text: RenderableType, omitted: str) -> list[Any]:
    """Return the parts of a text as blocks, without an omitted line."""
    blocks: list[Any] = []
    for part in text.renderables if isinstance(text, Group) else [text]:
        if isinstance(part, TextTable):
            blocks.append(_table(part))
            continue
        lines = [line for line in str(part).splitlines() if line.strip() and line != omitted]
        for is_item, group in groupby(lines, lambda line: line.startswith(_ITEM)):
            kind, texts = (
                (Items if is_item else Text),
                [line_of_group.removeprefix(_ITEM) for line_of_group in group],
            )
            if blocks and type(blocks[-1]) is kind:
                texts = [*(blocks.pop().items if is_item else blocks.pop().paragraphs), *texts]
            blocks.append(kind(texts))
    return blocks


def _table(table: TextTable) -> Table:
    columns = [
        f"{'>' if column.justify == 'right' else ''}{column.header}" for column in table.columns
    ]
    by_column = [[str(cell) for cell in column.cells] for column in table.columns]
    rows: list[list[Cell]] = [
        [
            _number(word) if column.startswith(">") else word
            for column, word in zip(columns, row, strict=True)
        ]
        for row in zip(*by_column, strict=True)
    ]
    title = str(table.title) if isinstance(table.title, str | TextLine) else ""
    # Sorting would separate continuation rows and headings from their rows.
    is_flat = all(row[0] and any(row[1:]) for row in zip(*by_column, strict=True))
    return Table(columns, rows, title, sortable=is_flat)


def _number(word: str) -> Cell:
    match = _NUMBER.match(word)
    return Number(float(match[0]) if match else None, word)
