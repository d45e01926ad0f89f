"""The page of a job whose text says all: its tables and sentences, in the style of the others."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table as TextTable
from rich.text import Text as TextLine

from legcal.pages import Cell, Facts, Number, Page, Section, Table, Text, Verdict
from legcal.version import __version__

_NUMBER = re.compile(r"[+-]?\d+(\.\d+)?(e[+-]?\d+)?")  # a cell that sorts by its value


def text_page(
    title: str,
    text: RenderableType,
    *,
    verdict: Verdict | None = None,
    blocks: Sequence[Any] = (),
    command: str = "",
) -> Page:
    """Return a page with the tables and sentences of a text, and more blocks after them."""
    when = datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    record = {"Version": f"legcal {__version__}", "Command": command or "from Python", "Time": when}
    sections = [Section("result", "Result", _blocks(text))]
    if blocks:
        sections.append(Section("figures", "Figures", blocks))
    sections.append(Section("record", "Reproducibility", [Facts(record)]))
    return Page(title, when, verdict, sections)


def _blocks(text: RenderableType) -> list[Any]:
    """Return the parts of a text as blocks."""
    found: list[Any] = []
    lines: list[str] = []
    for part in text.renderables if isinstance(text, Group) else [text]:
        if isinstance(part, TextTable):
            if lines:
                found.append(Text(lines))
                lines = []
            found.append(_table(part))
        elif str(part).strip():
            lines += str(part).splitlines()
    return [*found, Text(lines)] if lines else found


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
    title = table.title
    return Table(columns, rows, str(title) if isinstance(title, str | TextLine) else "")


def _number(word: str) -> Cell:
    return Number(float(word) if _NUMBER.fullmatch(word) else None, word)
