"""Parameters of which the default run takes a few; the system tests show more of the same."""

from collections.abc import Callable, Iterable
from typing import Any

import pytest


def thinned(values: Iterable[Any], usual: Callable[..., bool] | Iterable[Any]) -> list[Any]:
    """Return parameters with those marked system that are not among the usual ones.

    Tuples are the parameters of several names; *usual* may be a question that takes them.
    """
    kept = usual if callable(usual) else list(usual)
    found = []
    for value in values:
        several = value if isinstance(value, tuple) else (value,)
        is_usual = kept(*several) if callable(kept) else value in kept
        found.append(pytest.param(*several, marks=() if is_usual else (pytest.mark.system,)))
    return found
