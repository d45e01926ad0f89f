"""Work for the processes of a pool, in a module that they import at once."""

import pickle
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from legcal.errors import DatasetError


def row_zero_after_row_five(done: Path, row: int) -> int:
    """Return the row; the first one waits until another process has done the sixth."""
    while row == 0 and not done.exists():
        time.sleep(0.01)
    if row == 5:
        done.touch()
    return row


def negative(row: int, refused: int = -1) -> int:
    """Return the row with the other sign; one is refused."""
    if row == refused:
        raise DatasetError(f"row {row} could not be used.")
    return -row


def _pickled(content: Any) -> Any:
    return pickle.loads(pickle.dumps(content))


def _called(work: Any, *arguments: Any) -> Any:
    return _pickled(work(*arguments))


class OtherProcess(ThreadPoolExecutor):
    """Work that comes and goes as to another process, which would take seconds to start."""

    def submit(self, work: Any, /, *arguments: Any, **_: Any) -> Future[Any]:
        return super().submit(_called, *_pickled((work, *arguments)))
