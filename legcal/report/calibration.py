"""Text reports of a calibration, of a check of an earlier one, and of two compared models."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.text import Text

from legcal.calibration.documents import PlatformBlock, Result, WorkspaceAccuracy
from legcal.calibration.quantities import DIGITS, joints_of, parameters_of
from legcal.calibration.summary import (
    brief_sentences,
    sentences,
    tables,
)
from legcal.data.measurements import few
from legcal.files.quantity import SHOWN_IN
from legcal.machine.leg import ParameterId
from legcal.pages.document import Table, Verdict
from legcal.report.render import Report, report, table

if TYPE_CHECKING:
    from legcal.calibration.change_detection import Explanation
    from legcal.calibration.evaluation import Evaluation
    from legcal.calibration.result import Calibration
    from legcal.calibration.verification import Check

_LARGEST = 5  # largest changes of parameters shown
_EXPLANATIONS = 3  # alternative explanations shown


def summary(calibration: Calibration, output: Path, *, verbose: bool = False) -> Report:
    """Return one screen: verdict, platform, largest changes, weakest direction, notes.

    *verbose* adds all parameters in mm, degrees and pixels, and the quality of the fit.
    """
    result = calibration.result
    colour = "green" if calibration.verdict.trustworthy else "yellow"
    if calibration.verdict.is_to_be_refused:
        colour = "red"
    verdict = Text(calibration.verdict.sentence, style=f"bold {colour}")
    written = f"Written to {output}."
    if not verbose:
        return report(
            verdict,
            None if result.platform is None else platform_table(result.platform),
            _largest_changes(result),
            [
                *brief_sentences(result),
                *(f"Note: {note}" for note in result.notes),
                f"{written} All parameters: --verbose, or the files there.",
            ],
        )
    shown = [parameters.as_table(title) for title, parameters in tables(result)]
    return report(*shown, [*sentences(result, verbose=True), written, verdict])


def platform_table(platform: PlatformBlock) -> Table:
    """Return the platform error before the calibration, and the predicted error after it."""
    after: PlatformBlock | WorkspaceAccuracy = platform.workspace or platform
    scope = "poses" if platform.workspace is None else "workspace"
    rows = [
        ("nominal vs. calibrated", platform.change_dX_m, platform.change_dE_rad),
        (f"calibrated, predicted (1 sigma, {scope})", after.sigma_dX_m, after.sigma_dE_rad),
        ("maximum", after.sigma_dX_max_m, after.sigma_dE_max_rad),
    ]
    return table(
        "platform error",
        ">mm",
        ">deg",
        rows=[(name, f"{1e3 * dX:.3f}", f"{np.degrees(dE):.4f}") for name, dX, dE in rows],
    )


def _largest_changes(result: Result) -> Table | None:
    """Return the lengths and coordinates that changed most, joints in the links."""
    others = [q for q in parameters_of(result) if not q.parameter.is_joint_coordinate]
    changes = [
        (q.name, q.change, q.sigma)
        for q in (*joints_of(result), *others)
        if q.unit == "mm" and q.change is not None and q.sigma is not None
    ]
    largest = sorted(changes, key=lambda row: -abs(row[1]))[:_LARGEST]
    if not largest:
        return None
    return table(
        "largest changes",
        ">mm",
        ">sigma",
        rows=[(name, f"{change:+.3f}", f"{sigma:.3f}") for name, change, sigma in largest],
    )


def check_summary(check: Check) -> Report:
    """Return the result of a check: movement, test and explanations."""
    movement, images = check.movement, check.dataset.measurements.n_rows
    lines = [
        *(f"Note: {note}" for note in check.notes),
        f"{images} image{'s' * (images != 1)} compared with {check.earlier.folder}: {movement.dof} "
        f"of {len(check.earlier.names)} directions of the parameters, "
        f"statistic {movement.statistic:.1f}.",
    ]
    if movement.explanations:
        best, *others = movement.explanations
        change, amount = best.change.what, _amount(best)
        if best.p_value < movement.significance:
            lines.append(
                f"No single leg explains it; {change} explains most ({amount}; residual statistic "
                f"{best.remaining:.1f} of {movement.statistic:.1f})."
            )
        else:
            lines.append(f"It is explained by {change}: {amount}.")
            named = ", ".join(other.change.what for other in others[:_EXPLANATIONS])
            lines += [f"These images cannot distinguish that from: {named}."] if named else []
    style = "bold red" if movement.moved else "bold green"
    return report([*lines, Text(check.sentence, style=style)])


def _amount(explanation: Explanation) -> str:
    """Return the amount of a change in words."""
    change, parts = explanation.change, []
    components = zip(change.components, change.units, change.links, strict=True)
    numbers = zip(explanation.values.tolist(), explanation.sigma.tolist(), strict=True)
    for (name, unit, link), (value, sigma) in zip(components, numbers, strict=True):
        scale, shown = SHOWN_IN[unit]
        digits = DIGITS[shown]
        amount = f"{scale * value:+.{digits}f} {shown}"
        moved = f"{amount} in {name} of {link}" if link else f"{name} {amount}"
        parts.append(f"{moved} (1 sigma {scale * sigma:.{digits}f})")
    return ", ".join(parts)


def accuracy_table(evaluation: Evaluation) -> Report:
    """Return the platform errors and the parameters of two models, in mm and degrees."""
    dX, dE = 1e3 * evaluation.displacement, np.degrees(evaluation.rotation)
    headline = "Parameters only: the motors of a model do not determine its pose."
    if len(dX):
        headline = (
            f"Platform error over {len(dX)} poses: displacement {dX.mean():.4f} mm "
            f"(max {dX.max():.4f}), orientation {dE.mean():.4f} deg (max {dE.max():.4f})"
        )
    left_out = None
    if n := evaluation.n_left_out:
        rows_left_out = few([str(row) for row in evaluation.unreached])
        left_out = (
            f"{n} of {n + len(dX)} poses are left out, which one of the models does not reach "
            f"(rows {rows_left_out})."
        )
    scale = np.array([SHOWN_IN[unit][0] for unit in evaluation.units])
    values, references = scale * evaluation.values, scale * evaluation.references
    rows = [
        (name, f"{value:z.4f}", f"{reference:z.4f}", f"{value - reference:+z.4f}")
        for name, value, reference in zip(evaluation.names, values, references, strict=True)
        if not (ParameterId.parse(name).kind == "gain" and value == reference == 1.0)
    ]
    angles = "; axes and twists in deg" * ("rad" in evaluation.units)
    columns = ("parameter", ">model", ">reference", ">difference")
    return report(
        headline,
        left_out,
        table(*columns, rows=rows, title=f"Parameters, joints in R_b and R_e [mm{angles}]"),
    )


def check_verdict(check: Check) -> Verdict:
    """Return whether anything has moved: green or red."""
    if check.movement.moved:
        return Verdict("bad", "Something has moved", check.sentence, [])
    return Verdict("good", "No change was detected", check.sentence, [])
