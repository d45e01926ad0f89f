"""The comparison of two models as a table for people."""

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from legcal.report.accuracy import Evaluation


def accuracy_table(evaluation: Evaluation) -> RenderableType:
    """Return the platform errors and the parameters of an evaluation, in mm and degrees."""
    title = "Parameters [mm; axes and twists in deg]"
    if "rad" not in evaluation.units:
        title = "Parameters [mm]"
    table = Table(title=Text(title), title_justify="left", box=None, pad_edge=False)
    table.add_column("parameter")
    for column in ("model", "reference", "difference"):
        table.add_column(column, justify="right")
    scale = np.where([unit == "rad" for unit in evaluation.units], np.degrees(1.0), 1e3)
    for name, value, reference in zip(
        evaluation.names,
        scale * evaluation.values,
        scale * evaluation.references,
        strict=True,
    ):
        table.add_row(name, f"{value:.4f}", f"{reference:.4f}", f"{value - reference:+.4f}")
    return Group(Text(_headline(evaluation)), Text(), table)


def _headline(evaluation: Evaluation) -> str:
    dX, dE = 1e3 * evaluation.displacement, np.degrees(evaluation.rotation)
    if len(dX) == 0:
        return "Parameters only: readings do not give one pose where mobility and motors differ."
    return (
        f"Platform error over {len(dX)} poses: displacement {dX.mean():.4f} mm "
        f"(max {dX.max():.4f}), orientation {dE.mean():.4f} deg (max {dE.max():.4f})"
    )
