"""Parameters of which the usual run takes a few; the others show more of the same."""

from collections.abc import Callable, Iterable
from typing import Any

import pytest


def thinned(
    values: Iterable[Any], usual: Callable[..., bool] | Iterable[Any], mark: str = "slow"
) -> list[Any]:
    """Return parameters with those marked slow, or system, that are not among the usual ones.

    Tuples are the parameters of several names; *usual* may be a question that takes them.
    """
    kept = usual if callable(usual) else _one_of(list(usual))
    found = []
    for value in values:
        several = value if isinstance(value, tuple) else (value,)
        marks = () if kept(*several) else (getattr(pytest.mark, mark),)
        found.append(pytest.param(*several, marks=marks))
    return found


def _one_of(usual: list[Any]) -> Callable[..., bool]:
    return lambda *several: (several[0] if len(several) == 1 else several) in usual
