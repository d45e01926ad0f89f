"""Work for the processes of a pool, in a module that they import at once."""

import time
from pathlib import Path

import numpy as np

from legcal.errors import DatasetError
from legcal.workers import KeptArrays


def row_zero_after_row_five(done: Path, row: int) -> int:
    """Return the row; the first one waits until another process has done the sixth."""
    while row == 0 and not done.exists():
        time.sleep(0.01)
    if row == 5:
        done.touch()
    return row


def keep_row(kept: KeptArrays, row: int) -> bool:
    """Say whether the array of a row was kept before; keep it."""
    before = kept.get(row) is not None
    kept.keep(row, np.full((2, 3), row, dtype=np.float32))
    return before


def negative(row: int, refused: int = -1) -> int:
    """Return the row with the other sign; one is refused."""
    if row == refused:
        raise DatasetError(f"row {row} could not be used.")
    return -row
