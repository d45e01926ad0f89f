"""Parameters of which the usual run takes a few; the others show more of the same."""

from collections.abc import Callable, Iterable
from typing import Any

import pytest


def thinned(
    values: Iterable[Any],
    usual: Callable[..., bool] | Iterable[Any],
    mark: str = "slow",
    *,
    system: Iterable[Any] = (),
) -> list[Any]:
    """Return parameters with those marked slow, or system, that are not among the usual ones.

    Tuples are the parameters of several names; *usual* may be a question that takes them. Those of
    *system* are marked so in any case.
    """
    kept, further = usual if callable(usual) else _one_of(list(usual)), _one_of(list(system))
    found = []
    for value in values:
        several = value if isinstance(value, tuple) else (value,)
        name = "system" if further(*several) else mark
        marks = () if kept(*several) else (getattr(pytest.mark, name),)
        found.append(pytest.param(*several, marks=marks))
    return found


def _one_of(usual: list[Any]) -> Callable[..., bool]:
    return lambda *several: (several[0] if len(several) == 1 else several) in usual
