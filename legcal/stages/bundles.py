"""Bundles of leg axes: those of one leg in one view, which meet in its base joint."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array, BoolArray, IntArray


@dataclass(frozen=True, eq=False)
class Bundles:
    """Axes in bundles, each of one leg in one view, whose axes meet in one point.

    Attributes
    ----------
    rows : (k,) array of int
        The axes, bundle by bundle.
    counts : (n,) array of int
        How many axes each bundle has.
    """

    rows: IntArray
    counts: IntArray

    @classmethod
    def of(cls, key: IntArray) -> Bundles:
        """Return the bundles of axes with equal keys, by key."""
        return cls(np.argsort(key, kind="stable"), np.unique(key, return_counts=True)[1])

    @property
    def bundle(self) -> IntArray:
        """The bundle of each of ``rows``, (k,)."""
        return np.repeat(np.arange(len(self.counts)), self.counts)

    def some(self, wanted: BoolArray) -> Bundles:
        """Return some of the bundles."""
        return Bundles(self.rows[wanted[self.bundle]], self.counts[wanted])

    def total(self, values: Array) -> Array:
        """Return the sum over each bundle of values of ``rows``."""
        if len(self.counts) == 0:
            return np.zeros((0, *values.shape[1:]))
        return np.asarray(np.add.reduceat(values, np.cumsum(self.counts) - self.counts))

    def median(self, values: Array) -> Array:
        """Return the median over each bundle of values (k,) of ``rows``."""
        ordered = values[np.lexsort((values, self.bundle))]
        first = np.cumsum(self.counts) - self.counts
        low, high = first + (self.counts - 1) // 2, first + self.counts // 2
        return np.asarray(0.5 * (ordered[low] + ordered[high]))
