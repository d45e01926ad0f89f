"""CSV files that people edit: read strictly, every line with its number."""

import csv
import io
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from legcal.errors import DatasetError
from legcal.files.schema import describe, read_text

Line = tuple[int, list[str]]

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)


def read_lines(path: Path, what: str) -> list[Line]:
    """Return the lines of a CSV file that are not blank, numbered from 1, cells stripped.

    A byte-order mark and either kind of line end are accepted.

    Parameters
    ----------
    path : Path
        The file.
    what : str
        What the file is, for the message.

    Raises
    ------
    DatasetError
        If the file cannot be read or is not comma-separated text in UTF-8.
    """
    try:
        text = read_text(path, what).decode("utf-8-sig")
        reader = csv.reader(io.StringIO(text, newline=""), strict=True)
        lines = [(reader.line_num, [cell.strip() for cell in cells]) for cells in reader]
    except (UnicodeDecodeError, csv.Error) as error:
        found = (
            f"the byte 0x{error.object[error.start]:02x} at place {error.start}, which is no text"
            if isinstance(error, UnicodeDecodeError)
            else f"'{error}'"
        )
        raise DatasetError(
            f"{path}: the {what} could not be read: found {found}, needed comma-separated text "
            "in UTF-8; save it again as CSV."
        ) from error
    return [(number, cells) for number, cells in lines if any(cells)]


def finite_number(text: str) -> float:
    """Return the number in a cell, NaN if it holds no finite one."""
    value = float(text) if _NUMBER.fullmatch(text) else math.nan
    return value if math.isfinite(value) else math.nan


class Row(NamedTuple):
    """A row of a table: where it is, for messages, and its cells by column."""

    where: str
    cells: Mapping[str, str]

    def number(self, column: str, what: str, unit: str, problems: list[str]) -> float:
        """Return the finite number in a cell.

        Parameters
        ----------
        column : str
            Which cell.
        what, unit : str
            What the number is, and its unit in words or "", for the message.
        problems : list of str
            Takes one sentence if the cell holds no such number.

        Returns
        -------
        float
            NaN if there is none.
        """
        text = self.cells[column]
        value = finite_number(text)
        if math.isfinite(value):
            return value
        problems.append(
            f"{self.where}, column {column}: the {what} could not be used: found "
            f"{describe(text) if text else 'an empty cell'}, needed a finite number"
            f"{f' in {unit}' if unit else ''}; correct it or remove the row."
        )
        return math.nan


@dataclass(frozen=True)
class Table:
    """The text of a CSV file with a header.

    Attributes
    ----------
    path : Path
        The file.
    header : tuple of str
        Names of the columns, as they stand: some may be unknown, missing or there twice.
    lines : tuple of Line
        What is below.
    """

    path: Path
    header: tuple[str, ...]
    lines: tuple[Line, ...]

    def rows(self, problems: list[str]) -> list[Row]:
        """Return the rows that have as many cells as the header.

        Parameters
        ----------
        problems : list of str
            Takes one sentence for each of the others.
        """
        rows, n = [], len(self.header)
        for number, (line, cells) in enumerate(self.lines, start=1):
            where = f"{self.path}, row {number} (line {line})"
            if len(cells) == n:
                rows.append(Row(where, dict(zip(self.header, cells, strict=True))))
                continue
            remedy = "complete or remove the row"
            if len(cells) > n:
                remedy = "remove what is too much, and write decimals with points"
            problems.append(
                f"{where}: the row could not be used: found {len(cells)} "
                f"cell{'s' * (len(cells) != 1)}, needed {n} as in the header; {remedy}."
            )
        return rows


def read_table(path: Path, what: str, needed: str = "") -> Table:
    """Return the header of a CSV file and the lines below.

    Parameters
    ----------
    path : Path
        The file.
    what : str
        What the file is, for messages.
    needed : str
        What its rows should be and what to do about a file without any, for the message. Such a
        file is an empty table if this is not told.

    Raises
    ------
    DatasetError
        If the file cannot be read, has other marks than commas between columns, or has no row.
    """
    lines = read_lines(path, what)
    if needed and len(lines) < 2:
        raise DatasetError(
            f"{path}: the {what} could not be used: found {'a' if lines else 'no'} header and no "
            f"row, needed {needed}."
        )
    header = lines[0][1] if lines else []
    if len(header) == 1 and re.search(r"[;\t]", header[0]):
        raise DatasetError(
            f"{path}, header: the columns could not be used: found '{header[0]}' in one column, "
            "needed commas between columns; save as CSV."
        )
    return Table(path, tuple(header), tuple(lines[1:]))


def read_named_rows(
    path: Path,
    what: str,
    columns: Sequence[str],
    remedy: str,
    problems: list[str],
    *,
    needed: str = "",
    optional: Sequence[str] = (),
) -> list[Row]:
    """Return the rows of a CSV file whose columns are fixed.

    Parameters
    ----------
    path, what
        As in :func:`read_table`.
    columns : sequence of str
        The names in its header, in any order.
    remedy : str
        What to do about another header.
    problems : list of str
        Takes one sentence for each row that is not complete; such rows are left out.
    needed : str
        As in :func:`read_table`.
    optional : sequence of str
        Names that the header may have besides.

    Raises
    ------
    DatasetError
        If :func:`read_table` refuses the file, or it has other columns.
    """
    table = read_table(path, what, needed)
    here = [name for name in optional if name in table.header]
    if sorted(table.header) != sorted([*columns, *here]):
        raise DatasetError(
            f"{path}, header: the columns could not be used: found "
            f"{','.join(table.header) or 'none'}, needed {','.join(columns)}; {remedy}."
        )
    return table.rows(problems)
