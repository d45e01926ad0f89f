"""What errors of many runs say about an estimator beside the Cramer-Rao bound.

For errors d of p parameters and a covariance C, d' inv(C) d / p is the normalised squared error per
parameter: 1 on average where C is the covariance of d. With C the bound, its root is how many times
worse than the bound the estimator is; with C the covariance that the estimator states, it says
whether that is right. Both hardly depend on chance, as all directions count alike.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from legcal.geometry.types import Array, BoolArray
from legcal.studies.bound_record import run_errors
from legcal.studies.outline_bound import Bound
from legcal.studies.outline_figures import (
    INSIDE,
    Figure,
    band_of_ratio,
    coverage_figure,
    nse_figure,
    ratio_figure,
)
from legcal.studies.study import Record

LARGEST_RATIO = 1.02
NSE = (0.97, 1.03)


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

    def document(self) -> dict[str, Any]:
        """Return it as a JSON document; without a run that did not fail there are no figures."""
        rows = zip(
            self.bound.names,
            self.bound.units,
            self.bound.sigma.tolist(),
            self.ratio.tolist(),
            self.nse.tolist(),
            self.coverage.tolist(),
            self.outside.tolist(),
            strict=True,
        )
        keys = ("name", "unit", "bound", "ratio", "nse", "coverage", "outside_band")
        return {
            "machine": self.machine,
            "met": self.is_met,
            "runs": self.n,
            "failed": sum(self.failures.values()),
            "failures": self.failures,
            "band": list(self.band),
            "pooled": {figure.name: figure.document() for figure in self.pooled},
            "parameters": [dict(zip(keys, row, strict=True)) for row in rows] if self.n else [],
        }


class BoundTally:
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

    def add(self, record: Record) -> None:
        """Count a run, or the kind of error with which it failed."""
        if "failure" in record:
            self._failures[record["failure"]["kind"]] += 1
            return
        run = run_errors(record)
        z = run.error / self._bound.sigma
        is_inside = np.abs(run.of_sigma) < INSIDE
        self._n += 1
        self._of_bound += z**2
        self._of_sigma += run.of_sigma**2
        self._inside += is_inside
        self._joint += float(z @ self._inverse @ z) / len(z)
        self._nse += run.nse
        self._shares += float(is_inside.mean()) ** 2

    def found(self) -> BoundStatistics:
        """Return what they found."""
        n, count, n_parameters = self._n, max(self._n, 1), len(self._bound.names)
        coverage = self._inside / count
        covered = float(coverage.mean())
        spread = max(self._shares / count - covered**2, 0.0) ** 0.5
        pooled = (
            ratio_figure((self._joint / count) ** 0.5, n, n_parameters, LARGEST_RATIO),
            nse_figure(self._nse / count, n, n_parameters, NSE),
            coverage_figure(covered, spread, n),
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
