"""Views in a sentence."""

from collections.abc import Sequence

MOST = 5  # that are named


def few_views(names: Sequence[str]) -> str:
    """Return views as a sentence names them: ``views c1, c2``, not more than a few."""
    named, more = names[:MOST], len(names) - MOST
    return f"view{'s' * (len(names) > 1)} {', '.join(named)}" + f" and {more} more" * (more > 0)
