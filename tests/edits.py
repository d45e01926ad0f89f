"""Ways to spoil the files of a folder."""

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from csv_rows import read_rows, write_rows

Edit = Callable[[Path], object]
GONE = object()  # of a key: take it out


def text(name: str, content: str | bytes) -> Edit:
    """Write a file."""
    data = content if isinstance(content, bytes) else content.encode()

    def edit(folder: Path) -> None:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)

    return edit


def swap(name: str, old: str, new: str, count: int = 1) -> Edit:
    """Replace text in a file."""

    def edit(folder: Path) -> None:
        content = (folder / name).read_text()
        assert old in content, f"{name} has no {old!r}"
        (folder / name).write_text(content.replace(old, new, count))

    return edit


def remove(name: str) -> Edit:
    """Delete a file or folder."""

    def edit(folder: Path) -> None:
        path = folder / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return edit


def document(name: str, change: Callable[[Any], object]) -> Edit:
    """Change the content of a YAML or JSON file in place."""

    def edit(folder: Path) -> None:
        path = folder / name
        is_json = path.suffix == ".json"
        content = json.loads(path.read_text()) if is_json else yaml.safe_load(path.read_text())
        change(content)
        path.write_text(
            json.dumps(content) if is_json else yaml.safe_dump(content, sort_keys=False)
        )

    return edit


def keyed(name: str, /, **values: Any) -> Edit:
    """Set keys of a YAML or JSON file; ``a__b`` is b in a, numbers count entries of lists."""

    def change(content: Any) -> None:
        for key, value in values.items():
            *parents, last = [int(k) if k.isdigit() else k for k in key.split("__")]
            place: Any = content
            for parent in parents:
                place = place[parent]
            if value is GONE:
                del place[last]
            else:
                place[last] = value

    return document(name, change)


def cell(name: str, row: int | None, /, **cells: str) -> Edit:
    """Change cells of a row of a table, counted from 1; of all rows without one."""

    def edit(folder: Path) -> None:
        header, rows = _table(folder / name)
        for number, line in enumerate(rows, start=1):
            if row in {None, number}:
                for column, value in cells.items():
                    line[header.index(column)] = value
        _write_table(folder / name, [header, *rows])

    return edit


def header(name: str, old: str, new: str | None) -> Edit:
    """Rename a column of a table, or take it out."""

    def edit(folder: Path) -> None:
        names, rows = _table(folder / name)
        k = names.index(old)
        lines = [names, *rows]
        if new is None:
            lines = [[*line[:k], *line[k + 1 :]] for line in lines]
        else:
            names[k] = new
        _write_table(folder / name, lines)

    return edit


def doubled(name: str) -> Edit:
    """Write the first row of a table once more."""

    def edit(folder: Path) -> None:
        names, rows = _table(folder / name)
        _write_table(folder / name, [names, *rows, rows[0]])

    return edit


def kept(name: str, n: int) -> Edit:
    """Keep the first rows of a table."""

    def edit(folder: Path) -> None:
        names, rows = _table(folder / name)
        _write_table(folder / name, [names, *rows[:n]])

    return edit


def _table(path: Path) -> tuple[list[str], list[list[str]]]:
    with path.open(newline="") as file:
        names, *rows = csv.reader(file)
    return names, rows


def _write_table(path: Path, lines: list[list[str]]) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(lines)


def picture(name: str, width: int, height: int) -> Edit:
    """Write a grey picture."""

    def edit(folder: Path) -> None:
        cv2.imwrite(str(folder / name), np.full((height, width), 90, dtype=np.uint8))

    return edit


def cut(name: str, by: int) -> Edit:
    """Cut off the end of a file."""

    def edit(folder: Path) -> None:
        path = folder / name
        path.write_bytes(path.read_bytes()[:-by])

    return edit


def each_row(name: str, change: Callable[[dict[str, str]], object]) -> Edit:
    """Change every row of a table in place."""

    def edit(folder: Path) -> None:
        rows = read_rows(folder / name)
        for row in rows:
            change(row)
        write_rows(folder / name, rows)

    return edit


def added(name: str, column: str, amount: float) -> Edit:
    """Add an amount to a column of a table."""
    return each_row(name, lambda row: row.update({column: repr(float(row[column]) + amount)}))
