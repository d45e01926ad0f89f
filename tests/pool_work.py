"""Work for the processes of a pool, in a module that they import at once."""

import time
from pathlib import Path


def row_zero_after_row_five(done: Path, row: int) -> int:
    """Return the row; the first one waits until another process has done the sixth."""
    while row == 0 and not done.exists():
        time.sleep(0.01)
    if row == 5:
        done.touch()
    return row
