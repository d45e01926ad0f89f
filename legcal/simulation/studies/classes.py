"""The study of the classes: every shipped machine calibrated many times, by the steps and the fit.

The errors of the fit are judged by what it states of them and by the Cramer-Rao bound, on all that
is determined. What errors do to the platform tells of the rest, and compares the fit with the
nominal model and with the four steps, as printed and with legcal's criteria.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from legcal.calibration import Solution
from legcal.errors import LegcalError
from legcal.geometry import Array
from legcal.machine import LegGeometry, vector_of
from legcal.paper import Criteria
from legcal.simulation.studies.bound import ERRORS
from legcal.simulation.studies.outlines import (
    INSIDE,
    SHIPPED,
    Determined,
    Figure,
    Misses,
    Noise,
    OutlineDesign,
    OutlineExperiment,
    OutlineSession,
    as_stated,
    at_best,
    coverage_figure,
    figure_remarks,
    is_number,
    nse_figure,
    one_fit,
    platform_errors,
    ratio_figure,
    staged_legs,
    standing_where_held,
)
from legcal.simulation.studies.paper import has_keys
from legcal.simulation.studies.runner import Record, failure_of, is_failure

NOMINAL, FIT = "nominal", "fit"
STEPS: tuple[Criteria, ...] = ("literal", "default")
ESTIMATORS = (NOMINAL, *STEPS, FIT)
_PLATFORM = {"dX", "dE"}
_ERRORS = {"rank", "nse", "of_bound", "of_sigma"}


@dataclass(frozen=True, eq=False)
class FitErrors:
    """The errors of the kinematic parameters of one fit."""

    rank: int  # how many directions are determined; the others are held
    nse: float  # normalised squared error for each of them, by the covariance that the fit states
    of_bound: float  # the same by the Cramer-Rao bound
    # (k,) errors of the parameters that are estimated each for itself, over the standard deviations
    # that the fit states
    of_sigma: Array


def fit_record(errors: FitErrors) -> Record:
    """Return the errors of a fit as a part of its record."""
    return {
        "rank": errors.rank,
        "nse": errors.nse,
        "of_bound": errors.of_bound,
        "of_sigma": errors.of_sigma.tolist(),
    }


def fit_errors(record: Record) -> FitErrors:
    """Return the errors of the record of a fit that ended."""
    of_sigma = np.array(record["of_sigma"])
    return FitErrors(record["rank"], record["nse"], record["of_bound"], of_sigma)


def is_record(found: Any) -> bool:
    """Return whether a document has errors or a failure of every estimator."""
    if not has_keys(found, set(ESTIMATORS)):
        return False
    others = (found[name] for name in ESTIMATORS if name != FIT)
    return all(map(_is_platform, others)) and _is_fit(found[FIT])


def _is_platform(found: Any) -> bool:
    if has_keys(found, {"failure"}):
        return is_failure(found["failure"])
    return has_keys(found, _PLATFORM) and all(map(is_number, found.values()))


def _is_fit(found: Any) -> bool:
    if has_keys(found, {"failure"}):
        return is_failure(found["failure"])
    return (
        has_keys(found, _PLATFORM | _ERRORS)
        and all(is_number(found[key]) for key in (_PLATFORM | _ERRORS) - {"of_sigma"})
        and isinstance(found["of_sigma"], list)
        and len(found["of_sigma"]) > 0
        and all(map(is_number, found["of_sigma"]))
    )


NSE = (0.9, 1.1)
LARGEST_RATIO = 1.05


@dataclass(frozen=True, eq=False)
class Estimates:
    """What one estimator made of the sessions of a machine."""

    n: int  # how often it found something
    # errors of the platform: means over poses and over these sessions; None without any
    platform: Misses | None
    failures: dict[str, int]  # how often it failed, by kind of error
    reasons: dict[str, str]  # what the first of each kind says

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
    """What the sessions of one machine showed."""

    machine: str
    # rank, of: directions of the kinematic parameters that fits determined, and all of them
    rank: int
    of: int
    # by name, of :data:`legcal.simulation.studies.classes.ESTIMATORS`
    estimators: dict[str, Estimates]
    # error over bound, normalised squared error and coverage; none without a fit
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
    """Takes the records of one machine one by one."""

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


WORTH = ("determined", "runs", "error/bound", "nse", "covered", "verdict")
NOTES = (
    "determined: directions of the kinematic parameters that the fit determines; the others do not "
    "move the platform and are held where the nominal model has them. Errors are judged on what is "
    "determined, from the machine that shows exactly the same as the true one and stands there.",
    "error/bound: all these errors together, in units of the Cramer-Rao bound (root mean square); "
    "nse: normalised squared error by the covariance that the fit states, 0.9 to 1.1 is asked for; "
    "covered: stated 95 % intervals of estimated parameters that hold the truth.",
    "Errors of the platform: displacement [mm] and rotation [deg] at the poses measured, mean over "
    "poses and over all sessions of which the estimator made something; in brackets how many "
    "sessions it failed in.",
    "The four steps take the axes that these outlines give with the nominal radii, the readings "
    "and the nominal model; they look at no camera pose. They take radii as true, and an error of "
    "2 % of a radius is one of 2 % of the distance.",
)


def classes_table(machines: Sequence[ClassStatistics], readings: Sequence[str]) -> RenderableType:
    """Return what the fit is worth, errors of the platform, and what is to be said of them."""
    worth, platform = _table("machine", WORTH), _table("machine", ESTIMATORS)
    for found in machines:
        worth.add_row(found.machine, *worth_cells(found))
        platform.add_row(found.machine, *platform_cells(found))
    lines = [*NOTES, *(line for found in machines for line in remarks(found)), *readings]
    notes = (Text(f"- {line}", style="dim") for line in lines)
    return Group(worth, Text(), platform, Text(), *notes)


def worth_cells(found: ClassStatistics) -> tuple[str, ...]:
    """Return what the fit is worth, in the order of ``WORTH``."""
    if not found.figures:
        return (f"? of {found.of}", "0", "", "", "", "all failed")
    ratio, nse, coverage = (figure.value for figure in found.figures)
    return (
        f"{found.rank} of {found.of}",
        f"{found.fit.n}",
        f"{ratio:.3f}",
        f"{nse:.3f}",
        f"{100.0 * coverage:.1f} %",
        "met" if found.is_met else "not met",
    )


def platform_cells(found: ClassStatistics) -> tuple[str, ...]:
    """Return errors of the platform, in the order of ``ESTIMATORS``."""
    return tuple(_platform(found.estimators[name]) for name in ESTIMATORS)


def remarks(found: ClassStatistics) -> list[str]:
    """Return what else is to be said of a machine, one sentence each."""
    said = [
        f"{found.machine}: the {name}{' steps' if name in STEPS else ''} failed in {count} of "
        f"{sum(estimates.failures.values()) + estimates.n} sessions with {kind}, the first time: "
        f"{estimates.reasons[kind]}"
        for name, estimates in found.estimators.items()
        for kind, count in estimates.failures.items()
    ]
    return said + figure_remarks(found.machine, found.fit.n, found.figures)


def _platform(estimates: Estimates) -> str:
    """Return a mean error of the platform, and in how many sessions there is none."""
    n_failed = sum(estimates.failures.values())
    failed = f" ({n_failed})" if n_failed else ""
    if estimates.platform is None:
        return f"failed{failed}"
    shift, turn = 1e3 * estimates.platform.displacement, np.rad2deg(estimates.platform.rotation)
    return f"{_figures(shift)} {_figures(turn)}{failed}"


def _figures(value: float) -> str:
    """Return a number with three figures, more than four decimals aside."""
    decimals = 2 - int(np.floor(np.log10(value))) if value > 0.0 else 4
    return f"{value:.{min(max(decimals, 0), 4)}f}"


def _table(first: str, columns: Sequence[str]) -> Table:
    """Return an empty table."""
    table = Table(box=None, pad_edge=False)
    table.add_column(first, no_wrap=True)
    for column in columns:
        table.add_column(Text(column), justify="right", no_wrap=True)
    return table


def classes_page(machines: Sequence[ClassStatistics], readings: Sequence[str]) -> str:
    """Return the page."""
    said = [line for found in machines for line in remarks(found)]
    return "\n".join(
        [
            "# Machines of every class, calibrated",
            "",
            "Written by `legcal study classes`.",
            "",
            "## What the fit is worth",
            "",
            "| machine | directions determined | runs | error / bound "
            "| normalised squared error | 95 % intervals that hold the truth | verdict |",
            "|---|---|---|---|---|---|---|",
            *(f"| {' | '.join((found.machine, *worth_cells(found)))} |" for found in machines),
            "",
            "## Errors of the platform, mm and deg",
            "",
            "| machine | nominal model | four steps as printed | four steps, legcal's criteria "
            "| one fit of everything |",
            "|---|---|---|---|---|",
            *(f"| {' | '.join((found.machine, *platform_cells(found)))} |" for found in machines),
            "",
            *(f"- {line}" for line in (*NOTES, *readings)),
            "",
            *(["## What failed, and what else is to be said", ""] if said else []),
            *(f"- {line}" for line in said),
            *([""] if said else []),
        ]
    )


if TYPE_CHECKING:
    from rich.console import RenderableType

CLASSES = OutlineExperiment(ERRORS, SHIPPED, known=SHIPPED)


@dataclass(frozen=True)
class ClassesJudge:
    """Asks what steps and fit make of machines of every class."""

    name: str = "classes"

    def record(
        self, experiment: OutlineExperiment, design: OutlineDesign, session: OutlineSession
    ) -> Record:
        """Return errors of the platform by estimator, and of the parameters of the fit."""
        found: Record = {NOMINAL: _platform_classes(design, session.nominal)}
        for criteria in STEPS:
            found[criteria] = _kept(partial(_steps, design, session, criteria))
        found[FIT] = _kept(partial(_fit, experiment, design, session))
        return found

    def is_record(self, found: Any) -> bool:
        """Return whether a document has errors or a failure of every estimator."""
        return is_record(found)

    def tally(self, experiment: OutlineExperiment, machine: str) -> ClassTally:
        """Return what takes the records of a machine."""
        return ClassTally(machine, len(experiment.design(machine).parametrization))

    def table(self, found: Sequence[ClassStatistics], readings: Sequence[str]) -> RenderableType:
        """Return two rows a machine: what the fit is worth, and errors of the platform."""
        return classes_table(found, readings)

    def files(self, found: Sequence[ClassStatistics], readings: Sequence[str]) -> dict[str, bytes]:
        """Return the page with both tables."""
        return {"classes.md": classes_page(found, readings).encode()}


def errors_of_fit(
    design: OutlineDesign, session: OutlineSession, solution: Solution, noise: Noise
) -> FitErrors:
    """Return the errors of a fit, judged on what is determined."""
    parametrization, n_held = design.parametrization, len(solution.held_basis)
    there = standing_where_held(design, session, solution)
    best = _bound_of(there, noise, n_held) if n_held == 0 else _bound(there, noise, n_held)
    stated = as_stated(there, solution)
    values, true_values = (
        vector_of(parametrization, legs, session.nominal) for legs in (solution.legs, there.legs)
    )
    from_truth = vector_of(parametrization, solution.legs, there.legs)
    errors = dict(zip(parametrization.names, (values - true_values).tolist(), strict=True))
    sigma = dict(zip(solution.names, solution.sigma.tolist(), strict=True))
    return FitErrors(
        rank=stated.rank,
        nse=stated.nse(values - true_values),
        of_bound=best.nse(from_truth - vector_of(parametrization, there.legs, there.legs)),
        of_sigma=np.array([errors[name] / sigma[name] for name in errors if name in sigma]),
    )


def _bound(design: OutlineDesign, noise: Noise, n_held: int) -> Determined:
    """Return the bound of a machine."""
    return at_best(design, noise.sigma_q, noise.radius_sigma, n_held)


_bound_of = lru_cache(maxsize=32)(_bound)  # of the true machines, which are the same in all runs


def _steps(design: OutlineDesign, session: OutlineSession, criteria: Criteria) -> Record:
    """Return the record of the four steps on a session."""
    return _platform_classes(design, staged_legs(session, criteria))


def _fit(experiment: OutlineExperiment, design: OutlineDesign, session: OutlineSession) -> Record:
    """Return the record of the fit of a session."""
    solution = one_fit(session, experiment.noise.radius_sigma)
    errors = errors_of_fit(design, session, solution, experiment.noise)
    return {**_platform_classes(design, solution.legs), **fit_record(errors)}


def _platform_classes(design: OutlineDesign, legs: Sequence[LegGeometry]) -> Record:
    """Return mean errors of the platform [m], [rad]."""
    shift, turn = platform_errors(design, legs)
    return {"dX": float(shift.mean()), "dE": float(turn.mean())}


def _kept(estimate: Callable[[], Record]) -> Record:
    """Return what an estimator finds, or how it fails."""
    try:
        return estimate()
    except LegcalError as error:
        return {"failure": failure_of(error)}
