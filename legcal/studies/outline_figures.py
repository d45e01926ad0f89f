"""Figures over all parameters of a machine, and the limits that they must keep."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2, norm

LEVEL = 0.999  # of sampling bands
COVERED, COVERAGE = 0.95, (0.94, 0.96)
INSIDE = float(norm.ppf(0.5 + 0.5 * COVERED))  # standard deviations on either side
_WIDE = float(norm.ppf(0.5 + 0.5 * LEVEL))
_TOGETHER = 10  # runs: what is believed of the spread of coverage before any, see below


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

    def document(self) -> dict[str, Any]:
        """Return it as a JSON document."""
        return {
            "value": self.value,
            "limits": [self.low, self.high],
            "limits_of_chance": self.by_chance,
            "met": self.is_met,
        }


def figure_remarks(machine: str, n: int, figures: tuple[Figure, ...]) -> list[str]:
    """Return which figures of n runs are outside their limits, and which limits are of chance."""
    said = [
        f"{machine}: {figure.name} is {figure.value:.4f}, outside {figure.low:.4f} to "
        f"{figure.high:.4f}."
        for figure in figures
        if not figure.is_met
    ]
    few = [figure.name for figure in figures if figure.by_chance]
    if few:
        said.append(
            f"{machine}: {n} runs are too few for the limits of {', '.join(few)}; "
            "those of chance are taken."
        )
    return said


def band_of_ratio(n: int) -> tuple[float, float]:
    """Return where 99.9 % of all root mean squares of n unit Gaussians are."""
    n = max(n, 1)
    low, high = (float(chi2.ppf(0.5 + sign * 0.5 * LEVEL, n)) / n for sign in (-1.0, 1.0))
    return low**0.5, high**0.5


def ratio_figure(value: float, n: int, n_parameters: int, largest: float) -> Figure:
    """Return the figure of all errors over the bound; below it is as wrong as far above it."""
    low, high = band_of_ratio(n * n_parameters)
    return Figure("ratio", value, low, max(largest, high), high > largest)


def nse_figure(value: float, n: int, n_parameters: int, limits: tuple[float, float]) -> Figure:
    """Return the figure of all normalised squared errors."""
    low, high = (limit**2 for limit in band_of_ratio(n * n_parameters))
    by_chance = low < limits[0] or high > limits[1]
    return Figure("nse", value, min(limits[0], low), max(limits[1], high), by_chance)


def coverage_figure(value: float, spread: float, n: int) -> Figure:
    """Return the figure of all intervals; intervals of one run hold the truth together or not.

    Parameters
    ----------
    value : float
        Part of all intervals that hold the truth.
    spread : float
        Standard deviation, over runs, of the part of a run. Few runs may show none: it counts
        beside some in which all intervals of a run hold the truth together.
    n : int
        Number of runs.
    """
    together = COVERED * (1.0 - COVERED)
    variance = (n * spread**2 + _TOGETHER * together) / (n + _TOGETHER)
    half = _WIDE * np.sqrt(variance / max(n, 1))
    by_chance = bool(half > COVERED - COVERAGE[0])
    low, high = min(COVERAGE[0], COVERED - half), max(COVERAGE[1], COVERED + half)
    return Figure("coverage", value, float(low), float(high), by_chance)
