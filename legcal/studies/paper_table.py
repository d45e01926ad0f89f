"""The table of the paper's evaluation for people."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from legcal.studies.paper_means import Means, PaperMeans
from legcal.studies.paper_text import AS_PRINTED

LABELS = {  # also of the figure
    "initial": "before",
    "literal": "steps as printed",
    "default": "legcal's steps",
    "fit": "one fit",
    "bound": "Cramer-Rao bound",
}
JOINTS = {"coplanar": "coplanar", "noncoplanar": "non-coplanar"}


def paper_table(found: PaperMeans, readings: Sequence[str]) -> RenderableType:
    """Return errors before and after calibration, beside the figures that the paper prints."""
    table = Table(box=None, pad_edge=False)
    table.add_column("joints")
    table.add_column("")
    for column in ("dX [mm]", "dE [deg]", "parameters [mm]", "runs", "failed"):
        table.add_column(Text(column), justify="right")
    for name in found.truths:
        for place, means in enumerate(found.of(name)):
            table.add_row("" if place else JOINTS[name], LABELS[means.estimator], *_cells(means))
    for place, (key, label) in enumerate(
        (("initial", "paper, before"), ("calibrated", "paper, after"))
    ):
        printed = AS_PRINTED[key]
        assert isinstance(printed, dict)
        table.add_row(
            "" if place else "not known",
            label,
            f"{printed['dX_mm']:g}",
            f"{printed['dE_deg']:g}",
            "" if place == 0 else "0.04 to 1",
            "" if place == 0 else "100",
            "",
        )
    notes = [Text(f"- {line}", style="dim") for line in (AS_PRINTED["note"], *readings)]
    return Group(table, Text(), *notes)


def _cells(means: Means) -> tuple[str, ...]:
    """Return the figures of a row."""
    failed = sum(means.failures.values())
    told = f"{failed}" if failed else ""
    if means.n == 0:
        return ("all failed", "", "", "0", told)
    lowest, highest = 1e3 * means.parameters.min(), 1e3 * means.parameters.max()
    return (
        f"{1e3 * means.dX:.3f}",
        f"{np.degrees(means.dE):.4f}",
        f"{lowest:.3f} to {highest:.3f}",
        f"{means.n}",
        told,
    )
