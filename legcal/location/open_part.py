"""A part of the base's frame or of the tool's that is open, and its words."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from legcal.geometry.types import Array

Frame = Literal["base", "tool"]
Kind = Literal["position", "orientation"]
Direction = tuple[float, float, float]


@dataclass(frozen=True)
class OpenPart:
    """A part of the frames that poses do not tell, or hardly.

    Attributes
    ----------
    frame : {"base", "tool"}
        Whose.
    kind : {"position", "orientation"}
        Of what.
    directions : tuple of tuple of float
        Unit vectors: of the base in the base link, of the tool in the platform link.
    """

    frame: Frame
    kind: Kind
    directions: tuple[Direction, ...]

    @property
    def words(self) -> str:
        """What is open, for people."""
        whose = "the base in the world" if self.frame == "base" else "the tool in the platform"
        link = "the base" if self.frame == "base" else "the platform"
        start = f"the {self.kind} of {whose}"
        if len(self.directions) == 3:
            return start
        if len(self.directions) == 2:
            normal = np.cross(*np.array(self.directions))
            return f"{start} across {direction_words(normal)} of {link}"
        link = "its own axes" if self.frame == "base" else link
        how = "along" if self.kind == "position" else "about"
        return f"{start} {how} {direction_words(self.directions[0])} of {link}"


def joined(parts: list[OpenPart]) -> str:
    """Return parts in one phrase, the tool's first."""
    words = [part.words for part in sorted(parts, key=lambda part: part.frame != "tool")]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def direction_words(v: Array | tuple[float, ...]) -> str:
    """Return a direction with two digits."""
    v = _signed(np.asarray(v) / np.linalg.norm(v))
    return "(" + ", ".join(f"{x:.3g}" for x in np.round(v, 2) + 0.0) + ")"


def direction_of(v: Array) -> Direction:
    """Return a unit vector (3,) with its largest component positive, as numbers."""
    x, y, z = _signed(v).tolist()
    return x, y, z


def _signed(v: Array) -> Array:
    """Return a direction with its largest component positive."""
    return np.asarray(v if v[np.argmax(np.abs(v))] > 0.0 else -v)
