"""The study of the bound: errors of one fit of everything beside the Cramer-Rao bound."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from legcal.geometry import Array, BoolArray
from legcal.simulation.studies.outlines import (
    INSIDE,
    Bound,
    Figure,
    OutlineDesign,
    OutlineExperiment,
    OutlineSession,
    StartErrors,
    band_of_ratio,
    bound_of,
    coverage_figure,
    errors_of,
    errors_record,
    figure_remarks,
    is_errors,
    nse_figure,
    one_fit,
    ratio_figure,
    run_errors,
)
from legcal.simulation.studies.runner import Record

LARGEST_RATIO = 1.02
NSE = (0.97, 1.03)


@dataclass(frozen=True, eq=False)
class BoundStatistics:
    """What the runs on one machine found."""

    machine: str
    bound: Bound  # its bound
    n: int  # number of runs that did not fail
    failures: dict[str, int]  # the others, by kind of error
    # ratio, nse, coverage: (n_parameters,) of every parameter the root mean square error over the
    # bound, the mean squared error over the stated variance, and the part of the stated 95 %
    # intervals that hold the truth
    ratio: Array
    nse: Array
    coverage: Array
    band: tuple[float, float]  # where 99.9 % of all ratios are if the bound is reached
    # ratio, normalised squared error and coverage of all parameters together
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
    """Takes the runs on one machine one by one."""

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


COLUMNS = ("runs", "each/bound", "all/bound", "nse", "covered", "verdict")


def bound_table(machines: Sequence[BoundStatistics], readings: Sequence[str]) -> RenderableType:
    """Return one row a machine, and what is to be said of them."""
    table = Table(box=None, pad_edge=False)
    table.add_column("machine", no_wrap=True)
    for column in COLUMNS:
        table.add_column(Text(column), justify="right", no_wrap=True)
    for found in machines:
        table.add_row(found.machine, *cells(found))
    notes = [line for found in machines for line in remarks(found)] + [*readings]
    return Group(table, Text(), *(Text(f"- {line}", style="dim") for line in notes))


def cells(found: BoundStatistics) -> tuple[str, ...]:
    """Return the figures of a machine in the order of ``COLUMNS``."""
    if found.n == 0:
        return ("0", "", "", "", "", "all failed")
    ratio, nse, coverage = (figure.value for figure in found.pooled)
    return (
        f"{found.n}",
        f"{found.ratio.min():.3f} to {found.ratio.max():.3f}",
        f"{ratio:.3f}",
        f"{nse:.3f}",
        f"{100.0 * coverage:.1f} %",
        "met" if found.is_met else "not met",
    )


def remarks(found: BoundStatistics) -> list[str]:
    """Return what else is to be said of a machine, one sentence each."""
    said = []
    if found.failures:
        kinds = ", ".join(f"{count} {kind}" for kind, count in found.failures.items())
        said.append(f"{found.machine}: {kinds}: runs that failed are in no figure.")
    if found.n == 0:
        return said
    low, high = found.band
    names = [f"{found.bound.names[i]} {found.ratio[i]:.3f}" for i in found.outside.nonzero()[0]]
    told = f"outside are {', '.join(names)}" if names else "no parameter is outside"
    said.append(
        f"{found.machine}: 99.9 % of all ratios of {found.n} runs are within {low:.3f} to "
        f"{high:.3f} at the bound; {told}."
    )
    return said + figure_remarks(found.machine, found.n, found.pooled)


_UNITS = {"m": "um", "rad": "urad"}


def bound_page(machines: Sequence[BoundStatistics], readings: Sequence[str]) -> str:
    """Return the page."""
    lines = [
        "# The fit beside the Cramer-Rao bound",
        "",
        "Written by `legcal study bound`.",
        "",
        "| machine | runs | error / bound, each parameter | all together "
        "| normalised squared error | 95 % intervals that hold the truth | verdict |",
        "|---|---|---|---|---|---|---|",
        *(f"| {' | '.join((found.machine, *cells(found)))} |" for found in machines),
        "",
        *(f"- {line}" for line in readings),
        "",
    ]
    for found in machines:
        lines += _of_machine(found)
    return "\n".join(lines)


def _of_machine(found: BoundStatistics) -> list[str]:
    """Return the table of one machine."""
    lines = [f"## {found.machine}", "", *(f"- {line}" for line in remarks(found)), ""]
    if found.n == 0:
        return lines
    lines += [
        "| parameter | bound, 1 sigma | error / bound | normalised squared error | covered |",
        "|---|---|---|---|---|",
    ]
    bound = found.bound
    for i, name in enumerate(bound.names):
        lines.append(
            f"| {name} | {1e6 * bound.sigma[i]:.2f} {_UNITS[bound.units[i]]} | "
            f"{found.ratio[i]:.3f}{' outside' if found.outside[i] else ''} | {found.nse[i]:.3f} | "
            f"{100.0 * found.coverage[i]:.1f} % |"
        )
    return [*lines, ""]


if TYPE_CHECKING:
    from rich.console import RenderableType

ERRORS = StartErrors(0.002, float(np.deg2rad(1.0)), 0.015, float(np.deg2rad(1.5)), full=False)
BOUND = OutlineExperiment(ERRORS)


@dataclass(frozen=True)
class BoundJudge:
    """Asks for the errors of parameters, and what the fit says of them."""

    name: str = "bound"

    def record(
        self, experiment: OutlineExperiment, design: OutlineDesign, session: OutlineSession
    ) -> Record:
        """Return the errors of the fit of a session."""
        solution = one_fit(session, experiment.noise.radius_sigma)
        return errors_record(errors_of(design, session, solution))

    def is_record(self, found: Any) -> bool:
        """Return whether a document has the errors of a fit."""
        return is_errors(found)

    def tally(self, experiment: OutlineExperiment, machine: str) -> BoundTally:
        """Return what compares the errors of a machine with its bound."""
        noise, design = experiment.noise, experiment.design(machine)
        return BoundTally(machine, bound_of(design, noise.sigma_q, noise.radius_sigma))

    def table(self, found: Sequence[BoundStatistics], readings: Sequence[str]) -> RenderableType:
        """Return one row a machine."""
        return bound_table(found, readings)

    def files(self, found: Sequence[BoundStatistics], readings: Sequence[str]) -> dict[str, bytes]:
        """Return the page with every parameter."""
        return {"bound.md": bound_page(found, readings).encode()}
