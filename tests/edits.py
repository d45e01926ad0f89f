"""Ways to spoil the files of a folder."""

import csv
import json
import shutil
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any, Concatenate, ParamSpec

import cv2
import numpy as np
import yaml
from csv_rows import read_rows, write_rows

Edit = Callable[[Path], object]
Rows = list[dict[str, str]]
P = ParamSpec("P")
GONE = object()  # of a key: take it out


def edit(change: Callable[Concatenate[Path, P], object]) -> Callable[P, Edit]:
    """Return what makes an edit of the arguments of a change but its folder."""

    @wraps(change)
    def made(*arguments: P.args, **named: P.kwargs) -> Edit:
        return lambda folder: change(folder, *arguments, **named)

    return made


@edit
def text(folder: Path, name: str, content: str | bytes) -> None:
    """Write a file."""
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())


@edit
def swap(folder: Path, name: str, old: str, new: str, count: int = 1) -> None:
    """Replace text in a file."""
    content = (folder / name).read_text()
    assert old in content, f"{name} has no {old!r}"
    (folder / name).write_text(content.replace(old, new, count))


@edit
def remove(folder: Path, name: str) -> None:
    """Delete a file or folder."""
    path = folder / name
    shutil.rmtree(path) if path.is_dir() else path.unlink()


@edit
def document(folder: Path, name: str, change: Callable[[Any], object]) -> None:
    """Change the content of a YAML or JSON file in place."""
    path = folder / name
    is_json = path.suffix == ".json"
    content = json.loads(path.read_text()) if is_json else yaml.safe_load(path.read_text())
    change(content)
    path.write_text(json.dumps(content) if is_json else yaml.safe_dump(content, sort_keys=False))


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


@edit
def header(folder: Path, name: str, old: str, new: str | None) -> None:
    """Rename a column of a table, or take it out."""
    with (folder / name).open(newline="") as file:
        names, *rows = csv.reader(file)
    place = names.index(old)
    for line in (names, *rows):
        if new is None:
            del line[place]
    if new is not None:
        names[place] = new
    with (folder / name).open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([names, *rows])


@edit
def table(folder: Path, name: str, change: Callable[[Rows], Rows]) -> None:
    """Change the rows of a table."""
    write_rows(folder / name, change(read_rows(folder / name)))


def each_row(name: str, change: Callable[[dict[str, str]], object]) -> Edit:
    """Change every row of a table in place."""

    def changed(rows: Rows) -> Rows:
        for row in rows:
            change(row)
        return rows

    return table(name, changed)


def cell(name: str, row: int | None, /, **cells: str) -> Edit:
    """Change cells of a row of a table, counted from 1; of all rows without one."""

    def changed(rows: Rows) -> Rows:
        assert cells.keys() <= rows[0].keys(), f"{name} has no {cells.keys() - rows[0].keys()}"
        numbered = enumerate(rows, start=1)
        return [line | cells if row in {None, k} else line for k, line in numbered]

    return table(name, changed)


def doubled(name: str) -> Edit:
    """Write the first row of a table once more."""
    return table(name, lambda rows: [*rows, rows[0]])


def kept(name: str, n: int) -> Edit:
    """Keep the first rows of a table."""
    return table(name, lambda rows: rows[:n])


@edit
def picture(folder: Path, name: str, width: int, height: int) -> None:
    """Write a grey picture."""
    cv2.imwrite(str(folder / name), np.full((height, width), 90, dtype=np.uint8))


@edit
def cut(folder: Path, name: str, by: int) -> None:
    """Cut off the end of a file."""
    path = folder / name
    path.write_bytes(path.read_bytes()[:-by])


def added(name: str, column: str, amount: float) -> Edit:
    """Add an amount to a column of a table."""
    return each_row(name, lambda row: row.update({column: repr(float(row[column]) + amount)}))
