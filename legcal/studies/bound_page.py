"""The page of the study of the bound: a Markdown table of every parameter of every machine."""

from __future__ import annotations

from collections.abc import Sequence

from legcal.studies.bound_statistics import BoundStatistics
from legcal.studies.bound_table import cells, remarks

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
