"""CSV files that people edit: read strictly, every line with its number."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from legcal.errors import DatasetError
from legcal.files.schema import read_text

Line = tuple[int, list[str]]


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


def read_named_rows(
    path: Path,
    what: str,
    columns: Sequence[str],
    remedy: str,
    problems: list[str],
    optional: Sequence[str] = (),
) -> list[tuple[str, dict[str, str]]]:
    """Return the rows of a CSV file by column name, each with its place for messages.

    Parameters
    ----------
    path : Path
        The file.
    what : str
        What the file is, for messages.
    columns : sequence of str
        The names in its header, in any order.
    remedy : str
        What to do about another header.
    problems : list of str
        Takes one sentence for each row that is not complete; such rows are left out.
    optional : sequence of str
        Names that the header may have besides.

    Raises
    ------
    DatasetError
        If the file cannot be read or has other columns.
    """
    lines = read_lines(path, what)
    header = lines[0][1] if lines else []
    here = [name for name in optional if name in header]
    if sorted(header) != sorted([*columns, *here]):
        raise DatasetError(
            f"{path}, header: the columns could not be used: found {','.join(header) or 'none'}, "
            f"needed {','.join(columns)}; {remedy}."
        )
    rows = []
    for row, (line, cells) in enumerate(lines[1:], start=1):
        where = f"{path}, row {row} (line {line})"
        if len(cells) == len(header):
            rows.append((where, dict(zip(header, cells, strict=True))))
        else:
            problems.append(
                f"{where}: the row could not be used: found {len(cells)} cells, needed "
                f"{len(header)}; complete or remove the row."
            )
    return rows
