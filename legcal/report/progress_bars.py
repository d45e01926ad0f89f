"""Progress of a long command, on stderr."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console

from legcal.progress import Report

_REFRESH = 0.1  # [s] between two pictures of a bar, at least


@contextmanager
def progress_on_stderr() -> Iterator[Report]:
    """Show one line a stage on stderr: a moving bar on a terminal, else finished stages."""
    console = Console(stderr=True, highlight=False)
    if not console.is_terminal:
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
    # Without a thread of its own, beside which no process can be copied.
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


def _finished_stages(console: Console) -> Report:
    def report(stage: str, done: int, total: int) -> None:
        if done == total:
            console.print(f"{stage}: {done}/{total}")

    return report
