"""How long-running work says where it is."""

from collections.abc import Callable

Report = Callable[[str, int, int], None]
"""Called as ``report(stage, done, total)``."""


def no_progress(stage: str, done: int, total: int) -> None:
    """Report nothing."""
