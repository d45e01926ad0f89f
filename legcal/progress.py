"""Progress of long-running work, reported to a function of the caller or on stderr."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

Report = Callable[[str, int, int], None]
"""Called as ``report(stage, done, total)``."""

Progress = Report | bool
"""True shows bars, in terminals and notebooks; False shows nothing; a function is called."""

_REFRESH = 0.1  # [s] minimum time between two drawings of a bar


def no_progress(stage: str, done: int, total: int) -> None:
    """Report nothing."""


@contextmanager
def shown_progress(progress: Progress) -> Iterator[Report]:
    """Yield the function to call with the progress of the work within; see :data:`Progress`."""
    if callable(progress):
        yield progress
    elif progress:
        with _on_stderr() as report:
            yield report
    else:
        yield no_progress


@contextmanager
def _on_stderr() -> Iterator[Report]:
    """Show one line a stage: a moving bar on a terminal or in a notebook, else finished stages."""
    from rich.console import Console

    console = Console(stderr=True, highlight=False)
    if not (console.is_terminal or (console.is_jupyter and find_spec("ipywidgets"))):
        yield _finished_stages(console)
        return
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
    )

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    # Without a refresh thread: a process with threads cannot be forked.
    with Progress(*columns, TimeElapsedColumn(), console=console, auto_refresh=False) as bars:
        tasks = {}
        refreshed = -_REFRESH

        def report(stage: str, done: int, total: int) -> None:
            nonlocal refreshed
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            bars.update(tasks[stage], completed=done, total=total)
            now = time.monotonic()
            if done == total or now - refreshed >= _REFRESH:
                bars.refresh()
                refreshed = now

        yield report
        for task in bars.tasks:  # skipped parts of a stage count as done
            bars.update(task.id, completed=task.total)


def _finished_stages(console: Console) -> Report:
    def report(stage: str, done: int, total: int) -> None:
        if done == total:
            console.print(f"{stage}: {done}/{total}")

    return report
