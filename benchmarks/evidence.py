"""Write the tables of docs/evidence.md from recorded figures: ``python benchmarks/evidence.py``.

``evidence.jsonl`` beside this file has one object a line, a row of a table: ``table`` (its name in
the page), ``title``, ``command`` and ``date`` (how and when it was recorded) and ``cells``, by
column. A new measurement replaces the rows of its table. The page holds the text. A table stands in
it between ``<!-- table: NAME -->`` and ``<!-- end -->`` (``NAME without COLUMN, COLUMN``: of less
interest), or a paragraph cites it by its name in code type: then all figures of the paragraph must
be in the rows that it cites. ``--check`` says whether the page is what the records give.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path
from typing import Any

RECORDS = Path(__file__).with_suffix(".jsonl")
PAGE = Path(__file__).parents[1] / "docs/evidence.md"
_PLACE = re.compile(r"<!-- table: (\S+)(?: without (.+?))? -->\n.*?<!-- end -->", re.DOTALL)
_PARAGRAPH = re.compile(r"\n\n|\n(?=- )")
_FIGURE = re.compile(r"(?<![\w.])\d+(?:[.,]\d+)*")


def records() -> dict[str, list[dict[str, Any]]]:
    """Return the rows of each table, in the order of the file."""
    tables: dict[str, list[dict[str, Any]]] = {}
    for line in RECORDS.read_text(encoding="utf-8").splitlines():
        row = json.loads(line)
        tables.setdefault(row["table"], []).append(row)
    return tables


def table_text(rows: list[dict[str, Any]], without: list[str]) -> str:
    """Return a table in Markdown but for some columns, with its command and date above."""
    columns = list(rows[0]["cells"])
    if any(list(row["cells"]) != columns for row in rows) or not {*without} <= {*columns}:
        raise ValueError(f"rows of the table {rows[0]['table']} have other columns")
    columns = [column for column in columns if column not in without]
    lines = [columns, ["---"] * len(columns)]
    lines += [[row["cells"][column] for column in columns] for row in rows]
    cells = [[str(cell).replace("|", "\\|") for cell in line] for line in lines]
    text = "\n".join(f"| {' | '.join(line)} |" for line in cells)
    first = rows[0]
    return f"**{first['title']}** (`{first['command']}`, {first['date']})\n\n{text}\n"


def page_text(text: str) -> str:
    """Return the text of the page with all tables written anew. Raise if no row has its figures."""
    tables = records()
    used = [name for name, _ in _PLACE.findall(text)]
    for paragraph in _PARAGRAPH.split(_PLACE.sub("", text)):
        names = [name for name in re.findall(r"`([\w-]+)`", paragraph) if name in tables]
        rows = [(row["title"], row["cells"]) for name in names for row in tables[name]]
        recorded = _FIGURE.findall(json.dumps(rows, ensure_ascii=False))
        odd = sorted({*_FIGURE.findall(paragraph)} - {*recorded})
        if names and odd:
            raise ValueError(f"figures that {', '.join(names)} do not record: {', '.join(odd)}")
        used += names
    if {*used} != {*tables}:
        odd = sorted({*used} ^ {*tables})
        raise ValueError(f"tables that are only in the page or only recorded: {', '.join(odd)}")

    def written(place: re.Match[str]) -> str:
        mark = place[0].partition("\n")[0]
        without = place[2].split(", ") if place[2] else []
        return f"{mark}\n{table_text(tables[place[1]], without)}\n<!-- end -->"

    return _PLACE.sub(written, text)


def main() -> None:
    """Write the page, or check it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="change nothing; exit 1 if it differs")
    asked = parser.parse_args()
    before = PAGE.read_text(encoding="utf-8")
    after = page_text(before)
    if asked.check:
        sys.exit(after != before)
    PAGE.write_text(after, encoding="utf-8")


if __name__ == "__main__":
    main()
