"""Means over the runs of the paper's evaluation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from legcal.geometry.types import Array
from legcal.mechanism.parameters import parameter_names, to_vector
from legcal.simulation.machine import Machine
from legcal.studies.paper_record import SCALARS
from legcal.studies.study import Record

INITIAL = "initial"
BOUND = "bound"


@dataclass(frozen=True, eq=False)
class Means:
    """Means of one estimator's errors over the runs in which it did not fail.

    Attributes
    ----------
    machine, estimator : str
        Whose they are.
    n : int
        Number of these runs.
    failures : dict of str to int
        The others, by kind of error.
    dX, dE, angle : float
        Means of eq (20) [m], [rad]; zero without any run, as all others.
    of_bound : float
        Root mean square of d' inv(C) d / n for errors d of the n parameters, C being the covariance
        of the Cramer-Rao bound of the same run: 1 for an estimator that reaches it. Its spread
        is far smaller than that of dX.
    dX_uncertainty, dE_uncertainty, of_bound_uncertainty : float
        Standard deviations of these means [m], [rad], [1].
    parameters : (n_parameters,) array
        Mean absolute error of every parameter [m].
    """

    machine: str
    estimator: str
    n: int
    failures: dict[str, int]
    dX: float
    dE: float
    angle: float
    of_bound: float
    dX_uncertainty: float
    dE_uncertainty: float
    of_bound_uncertainty: float
    parameters: Array

    def document(self) -> dict[str, Any]:
        """Return a row of ``--json``; null where every run failed."""
        return {
            "estimator": self.estimator,
            "coplanar": self.machine == "coplanar",
            "dX_mm": 1e3 * self.dX if self.n else None,
            "dE_deg": float(np.degrees(self.dE)) if self.n else None,
            "parameters_mm": (1e3 * self.parameters).tolist() if self.n else [],
            "angle_deg": float(np.degrees(self.angle)) if self.n else None,
            "dX_mean_sigma_mm": 1e3 * self.dX_uncertainty if self.n else None,
            "dE_mean_sigma_deg": float(np.degrees(self.dE_uncertainty)) if self.n else None,
            "of_bound": self.of_bound if self.n else None,
            "of_bound_sigma": self.of_bound_uncertainty if self.n else None,
            "runs": self.n,
            "failed": sum(self.failures.values()),
            "failures": self.failures,
        }


@dataclass(frozen=True, eq=False)
class PaperMeans:
    """Errors before and after calibration, of every estimator on either machine.

    Attributes
    ----------
    means : tuple of Means
        By machine, and then: initial, the estimators, the bound.
    names : tuple of str
        Names of the parameters.
    truths : dict of str to (n_parameters,) array
        True values of each machine [m].
    """

    means: tuple[Means, ...]
    names: tuple[str, ...]
    truths: dict[str, Array]

    def of(self, machine: str) -> tuple[Means, ...]:
        """Return the means of one machine."""
        return tuple(means for means in self.means if means.machine == machine)


class _Sums:
    """Running sums of one estimator's errors."""

    def __init__(self, n_parameters: int) -> None:
        self.n = 0
        self.scalars = np.zeros(len(SCALARS))
        self.squares = np.zeros(len(SCALARS))
        self.parameters = np.zeros(n_parameters)
        self.failures: Counter[str] = Counter()

    def add(self, record: Record) -> None:
        """Add what one run found."""
        if "failure" in record:
            self.failures[record["failure"]["kind"]] += 1
            return
        scalars = np.array([record[name] for name in SCALARS])
        self.n += 1
        self.scalars += scalars
        self.squares += scalars**2
        self.parameters += record["parameters"]

    def means(self, machine: str, estimator: str) -> Means:
        """Return the means."""
        means = self.scalars / max(self.n, 1)
        variances = np.maximum(self.squares / max(self.n, 1) - means**2, 0.0)
        dX, dE, angle, squared = means.tolist()
        of_dX, of_dE, _, of_squared = np.sqrt(variances / max(self.n - 1, 1)).tolist()
        ratio = float(np.sqrt(squared))
        return Means(
            machine,
            estimator,
            self.n,
            dict(sorted(self.failures.items())),
            dX,
            dE,
            angle,
            ratio,
            of_dX,
            of_dE,
            of_squared / (2.0 * ratio) if ratio else 0.0,
            self.parameters / max(self.n, 1),
        )


def means_of(records: Iterable[Record], machines: Mapping[str, Machine]) -> PaperMeans:
    """Return the means over records, which are read once."""
    first = next(iter(machines.values()))
    names = parameter_names(first.leg_names, first.frame_legs)
    sums: dict[tuple[str, str], _Sums] = {}
    for record in records:
        for machine, found in record.items():
            for estimator, errors in found.items():
                sums.setdefault((machine, estimator), _Sums(len(names))).add(errors)
    return PaperMeans(
        tuple(total.means(*key) for key, total in sums.items()),
        names,
        {
            name: to_vector(machine.parameters, machine.frame_legs)
            for name, machine in machines.items()
        },
    )
