"""What ``legcal calibrate`` shows at the end: a table, what steps and fit gave, the verdict."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from legcal.calibration import Calibration
from legcal.mechanism.parameters import KinematicParameters
from legcal.mechanism.platform import pose_differences
from legcal.refinement.start import platform_poses, with_joints
from legcal.report.result import result_document


def summary(calibration: Calibration, output: Path) -> RenderableType:
    """Return the table of parameters in mm, and what it means."""
    document = result_document(calibration)
    table = Table(box=None, pad_edge=False)
    table.add_column("parameter [mm]")
    for column in ("nominal", "calibrated", "change", "sigma"):
        table.add_column(column, justify="right")
    for row in document["parameters"]:
        value, nominal, sigma = (1e3 * (row[key] or 0.0) for key in ("value", "nominal", "sigma"))
        shown = f"{sigma:.4f}" if row["sigma"] is not None else row["status"]
        table.add_row(
            row["name"], f"{nominal:.4f}", f"{value:.4f}", f"{value - nominal:+.4f}", shown
        )
    lines = [
        *(f"Note: {note}" for note in calibration.notes),
        _observation_line(calibration),
        _steps_line(calibration),
        _fit_line(calibration),
        f"Written to {output}.",
    ]
    verdict = Text(
        calibration.verdict.sentence,
        style="bold green" if calibration.verdict.trustworthy else "bold red",
    )
    return Group(table, Text(), *(Text(line) for line in lines), verdict)


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
    if steps.parameters is None:
        return f"The four steps alone gave no result: {steps.failure}"
    displacement, rotation = _apart(calibration, steps.parameters)
    left_out = f" They left out {len(steps.diagnostics)} axes or joints." * bool(steps.diagnostics)
    return (
        f"The four steps alone end {1e3 * displacement:.3f} mm / {np.degrees(rotation):.3f} deg "
        f"from the fit at the platform.{left_out}"
    )


def _apart(calibration: Calibration, parameters: KinematicParameters) -> tuple[float, float]:
    """Return how far the platform with these parameters is from that of the fit [m, rad]."""
    near, mechanism = calibration.solution.T_Rb_Re, calibration.dataset.mechanism
    measurements = calibration.dataset.measurements
    lengths = mechanism.sign * measurements.q[measurements.first_rows] + parameters.offsets
    legs = with_joints(calibration.solution.legs, parameters)
    displacement, rotation = pose_differences(
        platform_poses(legs, lengths, near, mechanism.frame_legs), near
    )
    return float(displacement.mean()), float(rotation.mean())


def _fit_line(calibration: Calibration) -> str:
    solution = calibration.solution
    residuals = []
    if solution.rms_px is not None:
        residuals.append(f"{solution.rms_px:.3f} px rms")
    if solution.rms_axes is not None:
        residuals.append(f"axes off by {solution.rms_axes:.3f} of their standard deviations, rms")
    return (
        f"The fit of everything started from the {solution.start} model: chi2 {solution.chi2:.1f} "
        f"for {', '.join([f'{solution.dof} degrees of freedom', *residuals])}."
    )
