"""How many fits of the study of convergence were right, refused and wrong."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from legcal.geometry.types import Array
from legcal.studies.convergence_record import is_right
from legcal.studies.study import Record

ENOUGH = 0.99  # of the runs must be right


@dataclass(frozen=True, eq=False)
class Outcomes:
    """Where the fits of one machine ended.

    Attributes
    ----------
    machine : str
        The machine.
    right, wrong : int
        Numbers of fits.
    refused : dict of str to int
        The others, by kind of error.
    worst : float
        Largest error of a parameter of all that are right, in standard deviations.
    before, after, predicted : (2,) array
        Displacement [m] and rotation [rad] of the platform, root mean squares over all that ended:
        of the nominal model, of the found one, and one standard deviation of that.
    """

    machine: str
    right: int
    wrong: int
    refused: dict[str, int]
    worst: float
    before: Array
    after: Array
    predicted: Array

    @property
    def n(self) -> int:
        """Number of runs."""
        return self.right + self.wrong + sum(self.refused.values())

    @property
    def is_met(self) -> bool:
        """Whether nearly all are right and none is wrong."""
        return self.n > 0 and self.wrong == 0 and self.right >= ENOUGH * self.n

    def document(self) -> dict[str, Any]:
        """Return it as a JSON document; null where no fit ended."""
        ended = self.right + self.wrong > 0
        figures = (("before", self.before), ("after", self.after), ("predicted", self.predicted))
        return {
            "machine": self.machine,
            "met": self.is_met,
            "runs": self.n,
            "right": self.right,
            "wrong": self.wrong,
            "refused": sum(self.refused.values()),
            "refusals": self.refused,
            "worst_sigma": self.worst if self.right else None,
            **{
                key: {"dX_mm": 1e3 * float(x[0]), "dE_deg": float(np.rad2deg(x[1]))}
                if ended
                else None
                for key, x in figures
            },
        }


class ConvergenceTally:
    """Takes the runs on one machine one by one."""

    def __init__(self, machine: str) -> None:
        self._machine = machine
        self._refused: Counter[str] = Counter()
        self._right = self._wrong = 0
        self._worst = 0.0
        self._squares = np.zeros((3, 2))

    def add(self, record: Record) -> None:
        """Count a run."""
        if "failure" in record:
            self._refused[record["failure"]["kind"]] += 1
            return
        self._squares += np.square([record[key] for key in ("before", "after", "predicted")])
        if is_right(record):
            self._right += 1
            self._worst = max(self._worst, record["worst"])
        else:
            self._wrong += 1

    def found(self) -> Outcomes:
        """Return where they ended."""
        before, after, predicted = np.sqrt(self._squares / max(self._right + self._wrong, 1))
        return Outcomes(
            machine=self._machine,
            right=self._right,
            wrong=self._wrong,
            refused=dict(self._refused),
            worst=self._worst,
            before=before,
            after=after,
            predicted=predicted,
        )
