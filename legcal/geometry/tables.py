"""Tables of arrays: rows chosen, and tables joined, by one way for all of them.

Of candidates, the best first, :func:`first_apart` leaves out those that are near better ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Self

import numpy as np

from legcal.geometry.types import BoolArray, IntArray

_COLUMN = np.ndarray, tuple


@dataclass(frozen=True, eq=False)
class Table:
    """A table: each field that is an array or a tuple has one entry a row.

    Other fields, and the arrays named in ``common``, hold for all rows.
    """

    common: ClassVar[tuple[str, ...]] = ()

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(next(iter(self.columns().values())))

    def columns(self) -> dict[str, Any]:
        """Return the fields with one entry a row, by name."""
        return {
            field.name: values
            for field in fields(self)
            if isinstance(values := getattr(self, field.name), _COLUMN)
            and field.name not in self.common
        }

    def choose(self, rows: BoolArray | IntArray | slice) -> Self:
        """Return the rows of a mask, of a slice, or of indices in a new order."""
        some = {}
        for name, values in self.columns().items():
            if isinstance(values, tuple):
                index = np.arange(len(values))[rows].tolist()
                some[name] = tuple(map(values.__getitem__, index))
            else:
                some[name] = values[rows]
        return replace(self, **some)

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Return all rows of some tables, with the other fields of the first."""
        if len(parts) == 1:
            return parts[0]
        columns = [part.columns() for part in parts]
        joined: dict[str, Any] = {
            name: tuple(entry for part in columns for entry in part[name])
            if isinstance(values, tuple)
            else np.concatenate([part[name] for part in columns])
            for name, values in columns[0].items()
        }
        return replace(parts[0], **joined)


def first_apart(near: BoolArray, most: int | None = None) -> IntArray:
    """Return the first rows (k,) that are not near an earlier one of these, at most so many.

    ``near[i, j]`` of near (n, n) says whether row i counts as near row j.
    """
    kept = list[int]()
    for i in range(len(near)):
        if len(kept) == most:
            break
        if not near[i, kept].any():
            kept.append(i)
    return np.array(kept, dtype=np.intp)
