"""What people read of a calibration, of a check of an earlier one, and of two models compared."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import RenderableType
from rich.text import Text

from legcal.calibration import UNITS, sentences
from legcal.report.render import report, table

if TYPE_CHECKING:
    from legcal.calibration import (
        Calibration,
        Check,
        Evaluation,
        Explanation,
    )

_EXPLANATIONS = 3  # that are named beside the best


def summary(calibration: Calibration, output: Path) -> RenderableType:
    """Return the table of parameters in mm, degrees and pixels, and what it means."""
    parameters = calibration.table()
    columns = ("parameter", ">nominal", ">calibrated", ">change", ">sigma", "unit", "status")
    lines = [*sentences(calibration.result), f"Written to {output}."]
    good = calibration.verdict.trustworthy
    verdict = Text(calibration.verdict.sentence, style="bold green" if good else "bold red")
    return report(table(*columns, rows=parameters.cells()), [*lines, verdict])


def check_summary(check: Check) -> RenderableType:
    """Return whether something has moved, and what explains it."""
    movement, images = check.movement, check.dataset.measurements.n_rows
    lines = [
        *(f"Note: {note}" for note in check.notes),
        f"{images} image{'s' * (images != 1)} compared with {check.earlier.folder}: {movement.dof} "
        f"of {len(check.earlier.names)} directions of the parameters, "
        f"statistic {movement.statistic:.1f}.",
    ]
    if movement.explanations:
        best, *others = movement.explanations
        what, amount = best.change.what, _amount(best)
        if best.p_value < movement.significance:
            lines.append(
                f"No single leg explains it; {what} explains most ({amount}; {best.remaining:.1f} "
                f"of {movement.statistic:.1f} are left)."
            )
        else:
            lines.append(f"It is explained by {what}: {amount}.")
            named = ", ".join(other.change.what for other in others[:_EXPLANATIONS])
            lines += [f"These images cannot distinguish that from: {named}."] if named else []
    style = "bold red" if movement.moved else "bold green"
    return report([*lines, Text(check.sentence, style=style)])


def _amount(explanation: Explanation) -> str:
    """Return by how much something changed, in words."""
    change, parts = explanation.change, []
    numbers = zip(explanation.values.tolist(), explanation.sigma.tolist(), strict=True)
    for name, unit, (value, sigma) in zip(change.components, change.units, numbers, strict=True):
        scale, shown, _ = UNITS[unit]
        parts.append(f"{name} {scale * value:+.3f} {shown} (1 sigma {scale * sigma:.3f})")
    return ", ".join(parts)


def accuracy_table(evaluation: Evaluation) -> RenderableType:
    """Return the platform errors and the parameters of two models, in mm and degrees."""
    dX, dE = 1e3 * evaluation.displacement, np.degrees(evaluation.rotation)
    headline = "Parameters only: readings do not give one pose where mobility and motors differ."
    if len(dX):
        headline = (
            f"Platform error over {len(dX)} poses: displacement {dX.mean():.4f} mm "
            f"(max {dX.max():.4f}), orientation {dE.mean():.4f} deg (max {dE.max():.4f})"
        )
    scale = np.array([UNITS[unit][0] for unit in evaluation.units])
    values, references = scale * evaluation.values, scale * evaluation.references
    rows = [
        (name, f"{value:.4f}", f"{reference:.4f}", f"{value - reference:+.4f}")
        for name, value, reference in zip(evaluation.names, values, references, strict=True)
    ]
    angles = "; axes and twists in deg" * ("rad" in evaluation.units)
    columns = ("parameter", ">model", ">reference", ">difference")
    return report(
        headline,
        *_left_out(evaluation),
        table(*columns, rows=rows, title=f"Parameters [mm{angles}]"),
    )


def _left_out(evaluation: Evaluation) -> list[RenderableType]:
    """Return a table of the rows that are left out, if there are any."""
    n, rows = evaluation.n_left_out, evaluation.unreached
    if not n:
        return []
    title = f"{n} of {n + len(evaluation.displacement)} poses are left out"
    cells = [(str(row.row), row.view, row.image, " and ".join(row.by)) for row in rows]
    return [table(">row", "view", "image", "not reached by", rows=cells, title=title)]
