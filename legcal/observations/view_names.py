"""Views and images in a sentence."""

from collections.abc import Sequence

MOST = 5  # that are named


def few(names: Sequence[str]) -> str:
    """Return names one after the other, not more than a few: ``c1, c2 and 3 more``."""
    more = len(names) - MOST
    return ", ".join(names[:MOST]) + f" and {more} more" * (more > 0)


def few_views(names: Sequence[str]) -> str:
    """Return views as a sentence names them: ``views c1, c2``, not more than a few."""
    return f"view{'s' * (len(names) > 1)} {few(names)}"
