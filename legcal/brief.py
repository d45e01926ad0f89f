"""Short representations of large objects for interactive sessions: a few lines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Set
from dataclasses import fields, is_dataclass
from html import escape
from pathlib import Path
from typing import TypeVar

import numpy as np
from pydantic import BaseModel
from scipy.spatial.transform import RigidTransform, Rotation

T = TypeVar("T")

_MAX_FIELDS = 9  # maximum number of lines
_MAX_TEXT = 70  # maximum characters of a value
_MAX_ITEMS = 4  # maximum length of a sequence of numbers or names that is shown whole
_MAX_NUMBERS = 6  # maximum length of an array that is shown whole
_WIDTH = 100  # characters of a line


def brief(cls: type[T]) -> type[T]:
    """Give a class a ``repr`` of at most ten lines, whatever its content, and a table of HTML.

    The class is a dataclass or a pydantic model.

    Large arrays are shown by their shape, sequences by their types, dataclasses by their name.
    """
    cls.__repr__ = cls.__str__ = _repr  # type: ignore[method-assign]
    if not hasattr(cls, "_repr_html_"):
        cls._repr_html_ = _repr_html  # type: ignore[attr-defined]
    return cls


def _repr(self: object) -> str:
    shown = [f"{name}={_value(getattr(self, name))}" for name in _shown(self)]
    name = type(self).__name__
    line = f"{name}({', '.join(shown)})"
    if len(line) <= _WIDTH:
        return line
    if len(shown) > _MAX_FIELDS:
        shown = [*shown[: _MAX_FIELDS - 1], f"... and {len(shown) - _MAX_FIELDS + 1} more"]
    return f"{name}(" + ",".join(f"\n    {entry}" for entry in shown) + ")"


def _repr_html(self: object) -> str:
    """Return the view in a notebook: the answer, if the object has one, and a row a field."""
    answer = getattr(self, "sentence", None)
    answer_in_bold = f"<p><b>{escape(answer)}</b></p>" if isinstance(answer, str) else ""
    rows = "".join(
        f'<tr><td style="text-align:left">{escape(name)}</td>'
        f'<td style="text-align:left">{escape(_value(getattr(self, name)))}</td></tr>'
        for name in _shown(self)
    )
    name = escape(type(self).__name__)
    return f"{answer_in_bold}<details open><summary>{name}</summary><table>{rows}</table></details>"


def _shown(self: object) -> list[str]:
    """Return the names of the fields that are shown."""
    if isinstance(self, BaseModel):
        return [name for name, field in type(self).model_fields.items() if field.repr]
    return [field.name for field in fields(self) if field.repr]  # type: ignore[arg-type]


def _value(value: object) -> str:
    """Return a value in a few words."""
    if isinstance(value, np.ndarray):
        if value.size <= _MAX_NUMBERS:
            return np.array2string(value, precision=6, separator=", ").replace("\n", "")
        return f"array({' x '.join(map(str, value.shape))})"
    if isinstance(value, RigidTransform | Rotation):
        return type(value).__name__
    if isinstance(value, Path):
        return _short(repr(str(value)))
    if isinstance(value, Mapping):
        return _several(list(value), "{}") if value else "{}"
    if isinstance(value, tuple | list | Set):
        return _several(list(value), "()" if isinstance(value, tuple) else "[]")
    if is_dataclass(value) or isinstance(value, BaseModel):
        return f"{type(value).__name__}(...)"
    return _short(repr(value))


def _several(items: list[object], brackets: str) -> str:
    """Return the items of a sequence if these are few and plain, else their types."""
    if len(items) <= _MAX_ITEMS and all(isinstance(x, str | int | float) for x in items):
        text = ", ".join(map(repr, items))
        if len(text) <= _MAX_TEXT:
            return f"{brackets[0]}{text}{brackets[1]}"
    counts = Counter(type(x).__name__ for x in items)
    return f"{brackets[0]}{', '.join(f'{n} {name}' for name, n in counts.items())}{brackets[1]}"


def _short(text: str) -> str:
    """Return the beginning of a text that is long."""
    text = " ".join(text.split())
    return text if len(text) <= _MAX_TEXT else f"{text[: _MAX_TEXT - 3]}..."
