"""The smallest sets of views that suffice."""

from __future__ import annotations

from dataclasses import dataclass

from legcal.mechanism.model import Mechanism


@dataclass(frozen=True)
class Recommendation:
    """A set of views.

    Attributes
    ----------
    views : tuple of tuples of str
        The legs that each camera position shows.
    legs_a_view : int
        How many these are.
    """

    views: tuple[tuple[str, ...], ...]
    legs_a_view: int


def recommend(mechanism: Mechanism, images: int) -> tuple[Recommendation, ...]:
    """Return the smallest sets of views that suffice, the best first."""
    return ()
