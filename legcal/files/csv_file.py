"""CSV files that people edit: read strictly, every line with its number."""

import csv
import io
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
        raise DatasetError(
            f"{path}: the {what} could not be read: found '{error}', needed comma-separated text "
            "in UTF-8; save it again as CSV."
        ) from error
    return [(number, cells) for number, cells in lines if any(cells)]
