"""The page of a job whose text says all: its tables and sentences, in the style of the others."""

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

_NUMBER = re.compile(r"[+-]?\d+(\.\d+)?(e[+-]?\d+)?")  # that begins a cell: it sorts by its value
_ITEM = "- "


def text_page(
    title: str,
    text: RenderableType,
    *,
    verdict: Verdict | None = None,
    blocks: Sequence[Any] = (),
    command: str = "",
) -> Page:
    """Return a page with the tables and sentences of a text, and more blocks after them.

    A sentence that the verdict says stands there alone.
    """
    when = time_of_page()
    record = {"Version": f"legcal {__version__}", "Command": command or "from Python", "Time": when}
    said = verdict.sentence if verdict is not None else ""
    sections = [Section("result", "Result", _blocks(text, said))]
    if blocks:
        sections.append(Section("figures", "Figures", blocks))
    sections.append(Section("record", "Reproducibility", [Facts(record)]))
    return Page(title, when, verdict, sections)


def picture(path: Path, caption: str) -> Picture:
    """Return a figure (PNG) as a part of a page."""
    data = base64.b64encode(path.read_bytes()).decode()
    return Picture(Markup(f"data:image/png;base64,{data}"), caption)


def _blocks(text: RenderableType, said: str) -> list[Any]:
    """Return the parts of a text as blocks, without a line that is said already."""
    found: list[Any] = []
    for part in text.renderables if isinstance(text, Group) else [text]:
        if isinstance(part, TextTable):
            found.append(_table(part))
            continue
        lines = [line for line in str(part).splitlines() if line.strip() and line != said]
        for is_item, group in groupby(lines, lambda line: line.startswith(_ITEM)):
            kind, texts = (Items if is_item else Text), [one.removeprefix(_ITEM) for one in group]
            if found and type(found[-1]) is kind:
                texts = [*(found.pop().items if is_item else found.pop().paragraphs), *texts]
            found.append(kind(texts))
    return found


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
    # Rows that belong to one above them, and headings among rows, would lose their place.
    is_flat = all(row[0] and any(row[1:]) for row in zip(*by_column, strict=True))
    return Table(columns, rows, title, sortable=is_flat)


def _number(word: str) -> Cell:
    found = _NUMBER.match(word)
    return Number(float(found[0]) if found else None, word)
