"""What the sessions of the study of the classes say of steps and fit on one machine."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from legcal.studies.classes_record import ESTIMATORS, FIT, fit_errors
from legcal.studies.outline_figures import (
    INSIDE,
    Figure,
    coverage_figure,
    nse_figure,
    ratio_figure,
)
from legcal.studies.outline_platform import Misses
from legcal.studies.study import Record

NSE = (0.9, 1.1)
LARGEST_RATIO = 1.05


@dataclass(frozen=True, eq=False)
class Estimates:
    """What one estimator made of the sessions of a machine.

    Attributes
    ----------
    n : int
        How often it found something.
    platform : Misses or None
        Errors of the platform: means over poses and over these sessions; None without any.
    failures : dict of str to int
        How often it failed, by kind of error.
    reasons : dict of str to str
        What the first of each kind says.
    """

    n: int
    platform: Misses | None
    failures: dict[str, int]
    reasons: dict[str, str]

    def document(self) -> dict[str, Any]:
        """Return it as a JSON document."""
        where = self.platform
        return {
            "runs": self.n,
            "dX_mm": None if where is None else 1e3 * where.displacement,
            "dE_deg": None if where is None else float(np.rad2deg(where.rotation)),
            "failed": sum(self.failures.values()),
            "failures": self.failures,
            "reasons": self.reasons,
        }


@dataclass(frozen=True, eq=False)
class ClassStatistics:
    """What the sessions of one machine showed.

    Attributes
    ----------
    machine : str
        The machine.
    rank, of : int
        Directions of the kinematic parameters that fits determined, and all of them.
    estimators : dict of str to Estimates
        By name, of :data:`legcal.studies.classes_record.ESTIMATORS`.
    figures : tuple of Figure
        Error over bound, normalised squared error and coverage; none without a fit.
    """

    machine: str
    rank: int
    of: int
    estimators: dict[str, Estimates]
    figures: tuple[Figure, ...]

    @property
    def fit(self) -> Estimates:
        """What the fit made of them."""
        return self.estimators[FIT]

    @property
    def is_met(self) -> bool:
        """Whether no fit failed and every figure is within its limits."""
        good = self.fit.n > 0 and not self.fit.failures
        return good and all(figure.is_met for figure in self.figures)

    def document(self) -> dict[str, Any]:
        """Return it as a JSON document."""
        return {
            "machine": self.machine,
            "met": self.is_met,
            "rank": self.rank,
            "of": self.of,
            "figures": {figure.name: figure.document() for figure in self.figures},
            "estimators": {name: found.document() for name, found in self.estimators.items()},
        }


@dataclass
class _Estimator:
    """Takes what one estimator made of sessions."""

    n: int = 0
    shift: float = 0.0
    turn: float = 0.0
    failures: Counter[str] = field(default_factory=Counter)
    reasons: dict[str, str] = field(default_factory=dict)

    def add(self, record: Record) -> bool:
        """Count a session, and say whether something was found."""
        if "failure" in record:
            kind = record["failure"]["kind"]
            self.failures[kind] += 1
            self.reasons.setdefault(kind, record["failure"]["message"])
            return False
        self.n += 1
        self.shift += record["dX"]
        self.turn += record["dE"]
        return True

    def found(self) -> Estimates:
        """Return what it made of them."""
        where = Misses(self.shift / self.n, self.turn / self.n) if self.n else None
        return Estimates(self.n, where, dict(self.failures), self.reasons)


class ClassTally:
    """Takes the records of one machine one by one.

    Parameters
    ----------
    machine : str
        The machine.
    n_parameters : int
        Number of its kinematic parameters.
    """

    def __init__(self, machine: str, n_parameters: int) -> None:
        self._machine, self._of = machine, n_parameters
        self._estimators = {name: _Estimator() for name in ESTIMATORS}
        self._ranks: Counter[int] = Counter()
        self._joint = self._nse = 0.0
        self._shares: list[float] = []

    def add(self, record: Record) -> None:
        """Count a session."""
        ended = {name: self._estimators[name].add(record[name]) for name in ESTIMATORS}
        if ended[FIT]:
            errors = fit_errors(record[FIT])
            self._ranks[errors.rank] += 1
            self._joint += errors.rank * errors.of_bound
            self._nse += errors.rank * errors.nse
            self._shares.append(float(np.mean(np.abs(errors.of_sigma) < INSIDE)))

    def found(self) -> ClassStatistics:
        """Return what they showed."""
        return ClassStatistics(
            self._machine,
            min(self._ranks, default=0),
            self._of,
            {name: estimator.found() for name, estimator in self._estimators.items()},
            self._figures() if self._shares else (),
        )

    def _figures(self) -> tuple[Figure, ...]:
        """Return the figures of all fits; every determined direction counts alike."""
        n, total = len(self._shares), sum(rank * k for rank, k in self._ranks.items())
        spread = float(np.std(self._shares))
        return (
            ratio_figure(float(np.sqrt(self._joint / total)), 1, total, LARGEST_RATIO),
            nse_figure(self._nse / total, 1, total, NSE),
            coverage_figure(float(np.mean(self._shares)), spread, n),
        )
