"""The tables of the study of the classes for people."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from legcal.studies.classes_record import ESTIMATORS, STEPS
from legcal.studies.classes_statistics import ClassStatistics, Estimates
from legcal.studies.outline_figures import figure_remarks

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
