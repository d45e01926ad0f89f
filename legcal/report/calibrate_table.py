"""What ``legcal calibrate`` shows at the end: a table, what steps and fit gave, the verdict."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from legcal.calibration import (
    Calibration,
    ParameterRow,
    PlatformError,
    board_lines,
    held_out_lines,
    parameter_rows,
    poses_at_readings,
)
from legcal.machine import describe_direction, pose_differences

_SHOWN = {  # what tables show a unit in: its size, its name, and digits
    "m": (1e3, "mm", 4),
    "rad": (float(np.degrees(1.0)), "deg", 4),
    "px": (1.0, "px", 3),
    "": (1.0, "", 6),
}


def summary(calibration: Calibration, output: Path) -> RenderableType:
    """Return the table of parameters in mm, degrees and pixels, and what it means."""
    lines = [
        *(f"Note: {note}" for note in calibration.notes),
        _observation_line(calibration),
        *board_lines(calibration),
        _steps_line(calibration),
        _fit_line(calibration),
        *_direction_lines(calibration),
        *_platform_lines(calibration),
        *([] if calibration.held_out is None else held_out_lines(calibration.held_out)),
        f"Written to {output}.",
    ]
    verdict = Text(
        calibration.verdict.sentence,
        style="bold green" if calibration.verdict.trustworthy else "bold red",
    )
    return Group(
        _table(parameter_rows(calibration)), Text(), *(Text(line) for line in lines), verdict
    )


def _table(rows: list[ParameterRow]) -> Table:
    """Return one line a parameter."""
    table = Table(box=None, pad_edge=False)
    table.add_column("parameter")
    for column in ("nominal", "calibrated", "change", "sigma"):
        table.add_column(column, justify="right")
    table.add_column("unit")
    table.add_column("status")
    for row in rows:
        scale, unit, digits = _SHOWN[row.unit]
        value, nominal = scale * row.value, scale * row.nominal
        sigma = "" if row.sigma is None else f"{scale * row.sigma:.{digits}f}"
        table.add_row(
            row.name,
            f"{nominal:z.{digits}f}",
            f"{value:z.{digits}f}",
            f"{value - nominal:+z.{digits}f}",
            sigma,
            unit,
            "" if row.status == "estimated" else row.status,
        )
    return table


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
    mechanism, measurements = calibration.dataset.mechanism, calibration.dataset.measurements
    near, q = calibration.solution.T_Rb_Re, measurements.q[measurements.first_rows]
    displacement, rotation = pose_differences(
        poses_at_readings(mechanism, steps.legs, q, near),
        poses_at_readings(mechanism, calibration.solution.legs, q, near),
    )
    return (
        f"The four steps alone end {1e3 * displacement.mean():.3f} mm / "
        f"{np.degrees(rotation.mean()):.3f} deg from the fit at the platform.{left_out}"
    )


def _fit_line(calibration: Calibration) -> str:
    solution = calibration.solution
    residuals = []
    if solution.rms_px is not None:
        residuals.append(f"{solution.rms_px:.3f} px rms")
    if solution.rms_axes is not None:
        residuals.append(f"axes off by {solution.rms_axes:.3f} of their standard deviations, rms")
    fit = (
        f"The fit of everything started from the {solution.start} model: chi2 {solution.chi2:.1f} "
        f"for {', '.join([f'{solution.dof} degrees of freedom', *residuals])}."
    )
    shared = [f"{what} {sigma:.3f} px" for what, sigma in solution.shared_px.items()]
    return fit + (f" Errors that outlines share: {', '.join(shared)}." if shared else "")


def _direction_lines(calibration: Calibration) -> list[str]:
    """Return which combinations of parameters are known worst, and which are held."""
    solution, names = calibration.solution, calibration.dataset.mechanism.leg_names
    worst = [
        f"{describe_direction([name for name, _ in weak.parts], names)} ({1e3 * weak.sigma:.3f} mm)"
        for weak in solution.weak
    ]
    lines = [f"Known worst (1 sigma): {'; '.join(worst)}."] if worst else []
    if solution.held:
        lines.append(
            "Held at nominal, since nothing determines it and the platform does not move with it: "
            f"{'; '.join(solution.held)}."
        )
    return lines


def _platform_lines(calibration: Calibration) -> list[str]:
    """Return the predicted error of the platform, and what would add to it."""
    platform = calibration.platform
    if platform is None:
        return []
    parts = [f"at the {len(platform.sigma.displacement)} poses {_mean_and_most(platform.sigma)}"]
    if platform.workspace is not None:
        parts.append(f"over the workspace {_mean_and_most(platform.workspace)}")
    lines = [f"Predicted error of the platform (1 sigma): {'; '.join(parts)}."]
    return lines + [
        f"{effect.what.capitalize()} would move the platform by {_mean_and_most(effect.error)}."
        for effect in platform.effects
    ]


def _mean_and_most(error: PlatformError) -> str:
    """Return mean and maximum in words."""
    return (
        f"{1e3 * error.mean_displacement:.3f} mm / {np.degrees(error.mean_rotation):.4f} deg, "
        f"at most {1e3 * error.max_displacement:.3f} mm / {np.degrees(error.max_rotation):.4f} deg"
    )
