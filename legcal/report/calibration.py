"""What people read of a calibration, of a check of an earlier one, and of two models compared."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import RenderableType
from rich.text import Text

from legcal.calibration import poses_at_readings, result_of
from legcal.machine import pose_differences
from legcal.report.render import report, table

if TYPE_CHECKING:
    from legcal.calibration import (
        Calibration,
        Check,
        Evaluation,
        Explanation,
        Holdout,
        PlatformBlock,
        Result,
        WorkspaceAccuracy,
    )

_SHOWN = {  # what tables show a unit in: its size, its name, and digits
    "m": (1e3, "mm", 4),
    "rad": (float(np.degrees(1.0)), "deg", 4),
    "px": (1.0, "px", 3),
    "": (1.0, "", 6),
}
_EXPLANATIONS = 3  # that are named beside the best


def summary(calibration: Calibration, output: Path) -> RenderableType:
    """Return the table of parameters in mm, degrees and pixels, and what it means."""
    result = result_of(calibration)
    rows = []
    for row in result.parameters:
        scale, unit, digits = _SHOWN[row.unit]
        value, nominal = scale * row.value, scale * row.nominal
        rows.append(
            (
                row.name,
                f"{nominal:z.{digits}f}",
                f"{value:z.{digits}f}",
                f"{value - nominal:+z.{digits}f}",
                "" if row.sigma is None else f"{scale * row.sigma:.{digits}f}",
                unit,
                "" if row.status == "estimated" else row.status,
            )
        )
    columns = ("parameter", ">nominal", ">calibrated", ">change", ">sigma", "unit", "status")
    lines = [
        *(f"Note: {note}" for note in result.notes),
        _observation_line(calibration),
        *_board_lines(calibration),
        _steps_line(calibration),
        _fit_line(result),
        *_direction_lines(result),
        *([] if result.platform is None else _platform_lines(result.platform)),
        *([] if result.holdout is None else _holdout_lines(result.holdout)),
        f"Written to {output}.",
    ]
    good = calibration.verdict.trustworthy
    verdict = Text(result.verdict, style="bold green" if good else "bold red")
    return report(table(*columns, rows=rows), [*lines, verdict])


def _mm_deg(dX_m: float, dE_rad: float) -> str:
    return f"{1e3 * dX_m:.3f} mm / {np.degrees(dE_rad):.4f} deg"


def _observation_line(calibration: Calibration) -> str:
    measurements, axes = calibration.dataset.measurements, calibration.dataset.axes
    if axes is not None:
        return (
            f"Axes: {len(axes)} in {measurements.n_rows} images, taken with the standard "
            "deviations that their table gives."
        )
    outlines = calibration.solution.outlines
    reasons = Counter(
        reason.split(",")[0].split(" by ")[0]
        for reason, used in zip(outlines.reason, outlines.used, strict=True)
        if not used
    )
    rejected = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common(4))
    return (
        f"Outlines: {int(outlines.used.sum())} of {len(outlines)} used"
        + (f"; rejected: {rejected}" if rejected else "")
        + "."
    )


def _board_lines(calibration: Calibration) -> list[str]:
    dataset, solution, corners = calibration.dataset, calibration.solution, calibration.corners
    if solution.T_Rb_board is None or corners is None:
        return []
    images = len(np.unique(corners.row[corners.used]))
    line = (
        f"Calibration board: {int(corners.used.sum())} of {len(corners)} corners used, in {images} "
        f"images, {solution.rms_corners_px or 0.0:.3f} px rms."
    )
    if dataset.T_base_board is not None:
        apart = dataset.T_base_board.inv() * dataset.machine.T_base_Rb * solution.T_Rb_board
        line += (
            f" It stands {1e3 * np.linalg.norm(apart.translation):.2f} mm and "
            f"{np.degrees(apart.rotation.magnitude()):.3f} deg from where the dataset has it, if "
            "the joints of the base stand where the nominal model has them."
        )
    return [line]


def _steps_line(calibration: Calibration) -> str:
    steps = calibration.steps
    if steps.legs is None:
        return f"The four steps alone gave no result: {steps.failure}"
    left_out = (
        f" They left out or at nominal {len(steps.diagnostics)} axes, joints or directions."
        * bool(steps.diagnostics)
    )
    if calibration.platform is None:
        return f"The four steps alone gave a result.{left_out}"
    machine, measurements = calibration.dataset.machine, calibration.dataset.measurements
    near, q = calibration.solution.T_Rb_Re, measurements.q[measurements.first_rows]
    displacement, rotation = pose_differences(
        poses_at_readings(machine, steps.legs, q, near),
        poses_at_readings(machine, calibration.solution.legs, q, near),
    )
    return (
        f"The four steps alone end {1e3 * displacement.mean():.3f} mm / "
        f"{np.degrees(rotation.mean()):.3f} deg from the fit at the platform.{left_out}"
    )


def _fit_line(result: Result) -> str:
    found = result.residuals
    parts = [f"{found.dof} degrees of freedom"]
    if found.rms_px is not None:
        parts.append(f"{found.rms_px:.3f} px rms")
    if found.rms_axes is not None:
        parts.append(f"axes off by {found.rms_axes:.3f} of their standard deviations, rms")
    line = (
        f"The joint fit started from the {result.start} model: chi2 {found.chi2:.1f} "
        f"for {', '.join(parts)}."
    )
    shared = [f"{what} {sigma:.3f} px" for what, sigma in found.shared_px.items()]
    return line + (f" Common-mode edge biases: {', '.join(shared)}." if shared else "")


def _direction_lines(result: Result) -> list[str]:
    """Return which combinations of parameters are least certain, and which are held."""
    worst = [f"{weak.direction} ({1e3 * weak.sigma_m:.3f} mm)" for weak in result.weakest]
    lines = [f"Least certain combinations (1 sigma): {'; '.join(worst)}."] if worst else []
    if result.held:
        lines.append(
            "Held at nominal, as nothing determines them and they do not move the platform: "
            f"{'; '.join(result.held)}."
        )
    return lines


def _platform_lines(found: PlatformBlock) -> list[str]:
    """Return the predicted error of the platform, and what would add to it."""
    parts = [f"at the {found.poses} poses {_predicted(found)}"]
    if found.workspace is not None:
        parts.append(f"over the workspace {_predicted(found.workspace)}")
    return [
        f"Predicted error of the platform (1 sigma): {'; '.join(parts)}.",
        *(
            f"{one.what.capitalize()} would move the platform by {_mm_deg(one.dX_m, one.dE_rad)}, "
            f"at most {_mm_deg(one.dX_max_m, one.dE_max_rad)}."
            for one in found.sensitivities
        ),
    ]


def _predicted(at: PlatformBlock | WorkspaceAccuracy) -> str:
    mean, most = (at.sigma_dX_m, at.sigma_dE_rad), (at.sigma_dX_max_m, at.sigma_dE_max_rad)
    return f"{_mm_deg(*mean)}, at most {_mm_deg(*most)}"


def _holdout_lines(found: Holdout) -> list[str]:
    of = f"{found.images} image{'s' * (found.images != 1)} kept aside"
    if found.rms_px is None or found.expected_px is None:
        return [f"Held out: {of} show no outline that could be compared."]
    views = ", ".join(f"{name} {rms:.3f}" for name, rms in found.views.items())
    lines = [
        f"Held out: {of}: {found.outlines - found.wrong} of {found.outlines} outlines are "
        f"{found.rms_px:.3f} px (rms) from where the fit of the others predicts them, "
        f"{found.expected_px:.3f} px were expected ({views})."
    ]
    pair = found.platform
    if pair is None:
        return [*lines, "They show too few legs at once to determine the platform's pose alone."]
    return [
        *lines,
        f"At the platform, its pose by what {pair.poses} of {found.poses} poses show alone is "
        f"{_mm_deg(pair.dX_m, pair.dE_rad)} (rms) from that by the readings; "
        f"{_mm_deg(pair.expected_dX_m, pair.expected_dE_rad)} were expected.",
    ]


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
        scale, shown, _ = _SHOWN[unit]
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
    scale = np.array([_SHOWN[unit][0] for unit in evaluation.units])
    values, references = scale * evaluation.values, scale * evaluation.references
    rows = [
        (name, f"{value:.4f}", f"{reference:.4f}", f"{value - reference:+.4f}")
        for name, value, reference in zip(evaluation.names, values, references, strict=True)
    ]
    angles = "; axes and twists in deg" * ("rad" in evaluation.units)
    columns = ("parameter", ">model", ">reference", ">difference")
    return report(headline, table(*columns, rows=rows, title=f"Parameters [mm{angles}]"))
