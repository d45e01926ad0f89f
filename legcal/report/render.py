"""The renderer of text tables and reports."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from legcal.errors import escaped, printable
from legcal.pages import document

Cells = Sequence[str | Text]


def safe_text(text: str | Text) -> Text:
    """Return text with control characters and markup escaped for the terminal."""
    if isinstance(text, Text):
        if text.plain != (plain := escaped(text.plain)):
            return Text(plain, style=text.style, overflow=text.overflow)
        return text
    return Text(escaped(text))


def table(
    *columns: str,
    rows: Iterable[Cells],
    title: str = "",
    least: Mapping[int, int] | None = None,
) -> Table:
    """Return a plain table; a column whose name begins with ">" holds numbers, flush right.

    ``least`` is the minimum width of columns on a narrow terminal.
    """
    text = Table(
        title=safe_text(title) if title else None,
        title_justify="left",
        box=None,
        pad_edge=False,
        padding=(0, 2, 0, 0),
    )
    for k, column in enumerate(columns):
        is_number = column.startswith(">")
        text.add_column(
            safe_text(column.removeprefix(">")),
            justify="right" if is_number else "left",
            overflow="fold",
            no_wrap=is_number,
            min_width=(least or {}).get(k),
        )
    for row in rows:
        text.add_row(*map(safe_text, row))
    return text


def text_table(page_table: document.Table) -> Table:
    """Return a table of a page as text; empty cells become dashes."""
    rows = [
        [cell if isinstance(cell, str) else cell.text for cell in row] for row in page_table.rows
    ]
    return table(
        *page_table.columns,
        rows=[[printable(text) or "-" for text in row] for row in rows],
        title=page_table.title,
    )


def report(*blocks: str | RenderableType | Sequence[str | RenderableType] | None) -> Group:
    """Return blocks one below the other, an empty line between; a block may have several lines."""
    parts: list[RenderableType] = []
    for block in blocks:
        lines = [block] if isinstance(block, str) or not isinstance(block, Sequence) else [*block]
        parts_of_block = [
            safe_text(line) if isinstance(line, str | Text) else line for line in lines if line
        ]
        if parts_of_block:
            parts += [Text(), *parts_of_block] if parts else parts_of_block
    return Group(*parts)


def heading(name: str, rest: str) -> Text:
    """Return the heading of a report, the name in bold."""
    return Text.assemble((escaped(name), "bold"), escaped(rest))
