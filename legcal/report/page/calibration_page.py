"""The page of a calibration: ``report.html`` of a result folder."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

from legcal.calibration import Calibration
from legcal.report.page.document import Items, Page, Row, Section
from legcal.report.page.parameter_rows import change_charts, parameter_table
from legcal.report.page.residual_plots import residual_plots
from legcal.report.page.verdicts import next_steps, verdict_of


def calibration_page(calibration: Calibration, folder: Path, command: str = "") -> Page:
    """Return the page of a calibration whose result folder this is, made by a command."""
    machine = calibration.dataset.machine
    sections = [
        Section("next", "What to do next", [Items(next_steps(calibration, str(folder)), True)]),
        Section(
            "parameters", "Parameters", [parameter_table(calibration), *change_charts(calibration)]
        ),
    ]
    if len(calibration.residuals):
        plots = residual_plots(calibration, {})
        sections.append(Section("residuals", "Residuals", [Row(plots)]))
    if calibration.notes:
        sections.append(Section("notes", "Notes", [Items(calibration.notes)]))
    when = datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    return Page(
        f"Calibration of {machine.name}",
        f"{calibration.dataset.folder.name}, {when}",
        verdict_of(calibration),
        [section for section in sections if section.blocks],
    )
