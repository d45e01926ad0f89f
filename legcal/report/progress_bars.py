"""Progress of a long command, on stderr."""

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from legcal.progress import Report


@contextmanager
def progress_on_stderr() -> Iterator[Report]:
    """Show one line a stage on stderr: a moving bar on a terminal, else finished stages."""
    console = Console(stderr=True, highlight=False)
    if not console.is_terminal:
        yield _finished_stages(console)
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), console=console) as bars:
        tasks = {}

        def report(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            bars.update(tasks[stage], completed=done, total=total)

        yield report


def _finished_stages(console: Console) -> Report:
    def report(stage: str, done: int, total: int) -> None:
        if done == total:
            console.print(f"{stage}: {done}/{total}")

    return report
