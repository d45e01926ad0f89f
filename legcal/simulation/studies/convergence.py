"""The study of convergence: where one fit of everything ends from a start that is far off.

A run is right where every parameter is within five of the standard deviations that the fit states,
and the platform within five of those that follow from them. It is refused where the fit raises an
error. What is left is wrong with a small sigma: nothing is worse.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from legcal.geometry import Array
from legcal.simulation.studies.outlines import (
    Misses,
    OutlineDesign,
    OutlineExperiment,
    OutlineSession,
    StartErrors,
    errors_of,
    is_number,
    one_fit,
    platform_misses,
    predicted_misses,
)
from legcal.simulation.studies.paper import has_keys
from legcal.simulation.studies.runner import Record, is_failure

FAR = 5.0  # standard deviations
_PLACES = ("before", "after", "predicted")


def fit_record(worst: float, before: Misses, after: Misses, predicted: Misses) -> Record:
    """Return the record of a fit that ended."""
    found = {"before": before, "after": after, "predicted": predicted}
    return {"worst": worst, **{key: list(misses) for key, misses in found.items()}}


def is_right(record: Record) -> bool:
    """Return whether a fit that ended found the truth, within what it states."""
    platform = zip(record["after"], record["predicted"], strict=True)
    return bool(record["worst"] <= FAR and all(miss <= FAR * sigma for miss, sigma in platform))


def is_outcome(found: Any) -> bool:
    """Return whether a document says where a fit ended, or how it was refused."""
    if has_keys(found, {"failure"}):
        return is_failure(found["failure"])
    return (
        has_keys(found, {"worst", *_PLACES})
        and is_number(found["worst"])
        and all(isinstance(found[key], list) and len(found[key]) == 2 for key in _PLACES)
        and all(is_number(value) for key in _PLACES for value in found[key])
    )


ENOUGH = 0.99  # of the runs must be right


@dataclass(frozen=True, eq=False)
class Outcomes:
    """Where the fits of one machine ended."""

    machine: str
    right: int  # right, wrong: numbers of fits
    wrong: int
    refused: dict[str, int]  # the others, by kind of error
    worst: float  # largest error of a parameter of all that are right, in standard deviations
    # before, after, predicted: (2,) displacement [m] and rotation [rad] of the platform, root mean
    # squares over all that ended: of the nominal model, of the found one, and one standard
    # deviation of that
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


_COLUMNS = ("right", "refused", "wrong", "before", "after", "1 sigma", "verdict")


def convergence_table(machines: Sequence[Outcomes], readings: Sequence[str]) -> RenderableType:
    """Return one row a machine, and what is to be said of them."""
    table = Table(box=None, pad_edge=False)
    table.add_column("machine", no_wrap=True)
    for column in _COLUMNS:
        table.add_column(Text(column), justify="right", no_wrap=True)
    for found in machines:
        table.add_row(found.machine, *_cells(found))
    notes = [
        f"right: every parameter is within {FAR:g} of the standard deviations that the fit states, "
        "and the platform within as many of those that follow. Refused: the fit ends with an "
        "error. Wrong: with a sigma that is too small.",
        "before, after, 1 sigma: displacement of the platform at the poses measured, root mean "
        "square over all fits that ended [mm]: of the nominal model, of the fitted one, and what "
        "the fit predicts of that.",
        *(_refusals(found) for found in machines if found.refused),
        *readings,
    ]
    return Group(table, Text(), *(Text(f"- {line}", style="dim") for line in notes))


def _cells(found: Outcomes) -> tuple[str, ...]:
    """Return the figures of a machine in the order of the columns."""
    counts = (f"{found.right}", f"{sum(found.refused.values())}", f"{found.wrong}")
    verdict = "met" if found.is_met else "not met"
    if found.right + found.wrong == 0:
        return (*counts, "", "", "", verdict)
    before, after, predicted = (
        1e3 * float(x[0]) for x in (found.before, found.after, found.predicted)
    )
    return (*counts, f"{before:.2f}", f"{after:.4f}", f"{predicted:.4f}", verdict)


def _refusals(found: Outcomes) -> str:
    """Return how fits of a machine were refused, in a sentence."""
    kinds = ", ".join(f"{count} {kind}" for kind, count in found.refused.items())
    return f"{found.machine}: refused with {kinds}."


if TYPE_CHECKING:
    from rich.console import RenderableType

ERRORS = StartErrors(0.005, float(np.deg2rad(3.0)), 0.005, float(np.deg2rad(3.0)), full=True)
CONVERGENCE = OutlineExperiment(ERRORS)


@dataclass(frozen=True)
class ConvergenceJudge:
    """Asks where fits end from nominal models and camera poses that are wrong in everything."""

    name: str = "convergence"

    def record(
        self, experiment: OutlineExperiment, design: OutlineDesign, session: OutlineSession
    ) -> Record:
        """Return where the fit of a session ends."""
        solution = one_fit(session, experiment.noise.radius_sigma)
        return fit_record(
            float(np.abs(errors_of(design, session, solution).of_sigma).max()),
            platform_misses(design, session.nominal),
            platform_misses(design, solution.legs),
            predicted_misses(design, solution),
        )

    def is_record(self, found: Any) -> bool:
        """Return whether a document says where a fit ended."""
        return is_outcome(found)

    def tally(self, experiment: OutlineExperiment, machine: str) -> ConvergenceTally:
        """Return what counts right, refused and wrong fits of a machine."""
        return ConvergenceTally(machine)

    def table(self, found: Sequence[Outcomes], readings: Sequence[str]) -> RenderableType:
        """Return one row a machine."""
        return convergence_table(found, readings)

    def files(self, found: Sequence[Outcomes], readings: Sequence[str]) -> dict[str, bytes]:
        """Return nothing: there is no figure."""
        return {}
