"""Reports: groups of tables and lines, which a terminal shows, or a page in the common style."""

from __future__ import annotations

import platform as system
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from rich.console import Console, ConsoleOptions, RenderableType
from rich.table import Table as RichTable
from rich.text import Text

from legcal.errors import escaped, printable
from legcal.pages.document import (
    Block,
    Cell,
    Facts,
    Light,
    Number,
    Page,
    Section,
    Table,
    Verdict,
    time_of_page,
)
from legcal.pages.document import Text as Paragraphs
from legcal.version import __version__

Part = str | Text | Table
_COLOURS: dict[Light, str] = {"good": "green", "doubtful": "yellow", "bad": "red"}
_COMMAND = "  legcal "
_NAME = 8  # characters of names in a first column that do not break
_NUMBER = re.compile(r"[+-]?\d+(\.\d+)?(e[+-]?\d+)?")  # start of a cell that sorts by its value


@dataclass(frozen=True)
class Report:
    """A report, which rich prints with an empty line between groups."""

    groups: Sequence[Sequence[Text | Table]]

    def __rich_console__(self, _: Console, __: ConsoleOptions) -> Iterator[RenderableType]:
        for k, group in enumerate(self.groups):
            if k:
                yield Text()
            for part in group:
                yield _on_terminal(part) if isinstance(part, Table) else part


def report(*blocks: Part | Report | Sequence[Part] | None) -> Report:
    """Return a report of groups: single parts, several ones, or those of another report."""
    groups: list[Sequence[Text | Table]] = []
    for block in blocks:
        if isinstance(block, Report):
            groups += block.groups
            continue
        parts = [block] if isinstance(block, str | Text | Table) else block or ()
        group = [p if isinstance(p, Table) else safe_text(p) for p in parts if p]
        if group:
            groups.append(group)
    return Report(groups)


def table(
    *columns: str,
    rows: Iterable[Sequence[str]],
    title: str = "",
    least: Mapping[int, int] | None = None,
) -> Table:
    """Return a table; a column whose name begins with ">" holds numbers, flush right.

    ``least`` is the minimum width of columns on a narrow terminal.
    """
    words = [list(row) for row in rows]
    cells = [
        [
            _number(word) if column.startswith(">") else word
            for column, word in zip(columns, row, strict=True)
        ]
        for row in words
    ]
    # Sorting would separate continuation rows and headings from their rows.
    is_flat = all(row[0] and any(row[1:]) for row in words)
    return Table(columns, cells, title, sortable=is_flat, least=least or {})


def heading(name: str, rest: str) -> Text:
    """Return the heading of a report, the name in bold."""
    return Text.assemble((printable(name), "bold"), printable(rest))


def verdict_line(verdict: Verdict) -> Text:
    """Return the sentence of a verdict in its colour."""
    return Text(verdict.sentence, style=f"bold {_COLOURS[verdict.light]}")


def safe_text(text: str | Text) -> Text:
    """Return text without control characters and markup; what is styled is not cut.

    Commands to copy stay on one line.
    """
    if isinstance(text, Text):
        if text.plain != (plain := escaped(text.plain)):
            return Text(plain, style=text.style, overflow=text.overflow)
        return text
    return Text(printable(text), overflow="ignore" if text.startswith(_COMMAND) else None)


def _number(word: str) -> Cell:
    match = _NUMBER.match(word)
    return Number(float(match[0]) if match else None, word)


def _on_terminal(table: Table) -> RichTable:
    """Return a table without lines."""
    text = RichTable(
        title=safe_text(table.title) if table.title else None,
        title_justify="left",
        box=None,
        pad_edge=False,
        padding=(0, 2, 0, 0),
    )
    for k, column in enumerate(table.columns):
        is_number = column.startswith(">")
        words = (column, *(row[k] for row in table.rows)) if k == 0 else ()
        longest = max((len(word) for word in words if isinstance(word, str)), default=0)
        text.add_column(
            safe_text(column.removeprefix(">")),
            justify="right" if is_number else "left",
            overflow="fold",
            no_wrap=is_number,
            min_width=table.least.get(k, min(longest, _NAME)) or None,
        )
    for row in table.rows:
        text.add_row(*(safe_text(cell if isinstance(cell, str) else cell.text) for cell in row))
    return text


def text_page(
    title: str,
    report: Report,
    *,
    verdict: Verdict | None = None,
    blocks: Sequence[Block] = (),
    command: str = "",
) -> Page:
    """Return a page with the tables and sentences of a report, followed by further blocks.

    The sentence of the verdict is not repeated.
    """
    when = time_of_page()
    omitted = verdict.sentence if verdict is not None else ""
    sections = [Section("result", "Result", _blocks(report, omitted))]
    if blocks:
        sections.append(Section("figures", "Figures", blocks))
    sections.append(record_section(command, when, {}))
    return Page(title, when, verdict, sections)


def record_section(command: str, when: str, more: Mapping[str, str]) -> Section:
    """Return the section of a page that says how it was made."""
    version = f"legcal {__version__}, Python {system.python_version()}, {system.machine()}"
    facts = {"Version": version, "Command": command or "from Python", "Time": when, **more}
    return Section("record", "Reproducibility", [Facts(facts)])


def _blocks(report: Report, omitted: str) -> list[Block]:
    """Return the parts of a report as blocks, without an omitted line."""
    blocks: list[Block] = []
    for part in (part for group in report.groups for part in group):
        if isinstance(part, Table):
            blocks.append(part)
            continue
        lines = [line for line in part.plain.splitlines() if line.strip() and line != omitted]
        if blocks and isinstance(before := blocks[-1], Paragraphs):
            lines = [*before.paragraphs, *lines]
            blocks.pop()
        blocks.append(Paragraphs(lines))
    return blocks
