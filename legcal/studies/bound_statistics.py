"""What errors of many runs say about an estimator beside the Cramer-Rao bound.

For errors d of p parameters and a covariance C, d' inv(C) d / p is the normalised squared error per
parameter: 1 on average where C is the covariance of d. With C the bound, its root is how many times
worse than the bound the estimator is; with C the covariance that the estimator states, it says
whether that is right. Both hardly depend on chance, as all directions count alike.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2, norm

from legcal.geometry.types import Array, BoolArray
from legcal.studies.outline_bound import Bound

LEVEL = 0.999  # of sampling bands
LARGEST_RATIO = 1.02
NSE = (0.97, 1.03)
COVERED, COVERAGE = 0.95, (0.94, 0.96)
_WIDE = float(norm.ppf(0.5 + 0.5 * LEVEL))
_INSIDE = float(norm.ppf(0.5 + 0.5 * COVERED))


@dataclass(frozen=True, eq=False)
class RunErrors:
    """The errors of one run.

    Attributes
    ----------
    error : (n,) array
        Of the parameters, axes as angles from the true ones [m, rad].
    of_sigma : (n,) array
        The same over the standard deviations that the estimator states.
    nse : float
        Normalised squared error per parameter by the covariance that it states.
    """

    error: Array
    of_sigma: Array
    nse: float


@dataclass(frozen=True)
class Figure:
    """A figure over all parameters, and what it must be.

    Attributes
    ----------
    name : str
        ``ratio``, ``nse`` or ``coverage``.
    value : float
        What it is.
    low, high : float
        Its limits: those that are asked for, or those of chance where the runs are so few that
        chance leads beyond them.
    by_chance : bool
        Whether the limits are those of chance.
    """

    name: str
    value: float
    low: float
    high: float
    by_chance: bool

    @property
    def is_met(self) -> bool:
        """Whether it is within its limits."""
        return self.low <= self.value <= self.high


@dataclass(frozen=True, eq=False)
class BoundStatistics:
    """What the runs on one machine found.

    Attributes
    ----------
    machine : str
        The machine.
    bound : Bound
        Its bound.
    n : int
        Number of runs that did not fail.
    failures : dict of str to int
        The others, by kind of error.
    ratio, nse, coverage : (n_parameters,) array
        Of every parameter the root mean square error over the bound, the mean squared error over
        the stated variance, and the part of the stated 95 % intervals that hold the truth.
    band : tuple of float
        Where 99.9 % of all ratios are if the bound is reached.
    pooled : tuple of Figure
        Ratio, normalised squared error and coverage of all parameters together.
    """

    machine: str
    bound: Bound
    n: int
    failures: dict[str, int]
    ratio: Array
    nse: Array
    coverage: Array
    band: tuple[float, float]
    pooled: tuple[Figure, ...]

    @property
    def outside(self) -> BoolArray:
        """Which parameters have a ratio outside the band, (n_parameters,)."""
        return np.asarray((self.ratio < self.band[0]) | (self.ratio > self.band[1]))

    @property
    def is_met(self) -> bool:
        """Whether no run failed and everything is within its limits."""
        good = self.n > 0 and not self.failures and not self.outside.any()
        return bool(good and all(figure.is_met for figure in self.pooled))


class Tally:
    """Takes the runs on one machine one by one.

    Parameters
    ----------
    machine : str
        The machine.
    bound : Bound
        Its bound.
    """

    def __init__(self, machine: str, bound: Bound) -> None:
        self._machine, self._bound = machine, bound
        self._inverse = np.linalg.inv(bound.covariance / np.outer(bound.sigma, bound.sigma))
        self._failures: Counter[str] = Counter()
        self._n = 0
        self._of_bound, self._of_sigma, self._inside = np.zeros((3, len(bound.names)))
        self._joint = self._nse = self._shares = 0.0

    def add(self, run: RunErrors | str) -> None:
        """Count a run, or the kind of error with which it failed."""
        if isinstance(run, str):
            self._failures[run] += 1
            return
        z = run.error / self._bound.sigma
        is_inside = np.abs(run.of_sigma) < _INSIDE
        self._n += 1
        self._of_bound += z**2
        self._of_sigma += run.of_sigma**2
        self._inside += is_inside
        self._joint += float(z @ self._inverse @ z) / len(z)
        self._nse += run.nse
        self._shares += float(is_inside.mean()) ** 2

    def statistics(self) -> BoundStatistics:
        """Return what they found."""
        n, count, n_parameters = self._n, max(self._n, 1), len(self._bound.names)
        coverage = self._inside / count
        covered = float(coverage.mean())
        spread = max(self._shares / count - covered**2, 0.0) ** 0.5 if n > 1 else 1.0
        pooled = (
            _ratio((self._joint / count) ** 0.5, n, n_parameters),
            _nse(self._nse / count, n, n_parameters),
            _coverage(covered, spread, n),
        )
        return BoundStatistics(
            machine=self._machine,
            bound=self._bound,
            n=n,
            failures=dict(self._failures),
            ratio=np.sqrt(self._of_bound / count),
            nse=self._of_sigma / count,
            coverage=coverage,
            band=band_of_ratio(n),
            pooled=pooled if n else (),
        )


def band_of_ratio(n: int) -> tuple[float, float]:
    """Return where 99.9 % of all root mean squares of n unit Gaussians are."""
    n = max(n, 1)
    low, high = (float(chi2.ppf(0.5 + sign * 0.5 * LEVEL, n)) / n for sign in (-1.0, 1.0))
    return low**0.5, high**0.5


def _ratio(value: float, n: int, n_parameters: int) -> Figure:
    """Return the figure of all errors over the bound; below it is as wrong as far above it."""
    low, high = band_of_ratio(n * n_parameters)
    return Figure("ratio", value, low, max(LARGEST_RATIO, high), high > LARGEST_RATIO)


def _nse(value: float, n: int, n_parameters: int) -> Figure:
    """Return the figure of all normalised squared errors."""
    low, high = (limit**2 for limit in band_of_ratio(n * n_parameters))
    by_chance = low < NSE[0] or high > NSE[1]
    return Figure("nse", value, min(NSE[0], low), max(NSE[1], high), by_chance)


def _coverage(value: float, spread: float, n: int) -> Figure:
    """Return the figure of all intervals; intervals of one run hold the truth together or not."""
    half = _WIDE * spread / np.sqrt(max(n, 1))
    by_chance = bool(half > COVERED - COVERAGE[0])
    low, high = min(COVERAGE[0], COVERED - half), max(COVERAGE[1], COVERED + half)
    return Figure("coverage", value, float(low), float(high), by_chance)
