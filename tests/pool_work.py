"""Work for the processes of a pool, in a module that they import at once."""

import os
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


def process_of(_row: int) -> int:
    """Return the number of the process that works on a row, for a moment."""
    time.sleep(0.01)
    return os.getpid()


def refused(first: int, row: int) -> None:
    """Refuse a row; the process with that number does it at once, others after a moment."""
    time.sleep(0.0 if os.getpid() == first else 0.1)
    raise DatasetError(f"row {row} could not be used.")


def asleep_elsewhere(here: int, seconds: float) -> None:
    """Sleep in any process but the one with that number."""
    if os.getpid() != here:
        time.sleep(seconds)


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
