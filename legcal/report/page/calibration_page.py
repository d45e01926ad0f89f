"""The page of a calibration: ``report.html`` of a result folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from legcal.calibration.result import Calibration
from legcal.pages.document import Gallery, Items, Page, Section, Text
from legcal.pages.html import time_of_page
from legcal.report.page.crops import outline_crops
from legcal.report.page.evidence import (
    correlation_blocks,
    held_out_blocks,
    identifiability_blocks,
    note_blocks,
    reproducibility_blocks,
)
from legcal.report.page.parameter_rows import change_charts, parameter_tables
from legcal.report.page.platform_blocks import platform_blocks
from legcal.report.page.residual_charts import residual_charts
from legcal.report.page.scene import machine_scene
from legcal.report.page.verdicts import next_steps, verdict_of


def calibration_page(
    calibration: Calibration,
    folder: Path,
    command: str = "",
    against: Sequence[Any] = (),
) -> Page:
    """Return the page of a calibration whose result folder this is, made by a command.

    *against* are the blocks of a section on the truth, if it is given.
    """
    machine = calibration.dataset.machine
    when = time_of_page()
    sections = (
        ("next", "What to do next", [Items(next_steps(calibration, str(folder), command), True)]),
        ("platform", "Platform error", platform_blocks(calibration)),
        ("truth", "Against the truth", against),
        ("parameters", "Parameters", [*parameter_tables(calibration), *change_charts(calibration)]),
        ("machine", "The machine", [machine_scene(calibration)]),
        *_outline_sections(calibration),
        ("identifiability", "Identifiability", identifiability_blocks(calibration)),
        ("correlation", "Correlations", correlation_blocks(calibration)),
        ("holdout", "Held-out images", held_out_blocks(calibration)),
        ("notes", "Diagnosis and notes", note_blocks(calibration)),
        ("record", "Reproducibility", reproducibility_blocks(calibration, command, when)),
    )
    return Page(
        f"Calibration of {machine.name}",
        f"{calibration.dataset.folder.name}, {when}",
        verdict_of(calibration),
        [Section(*section) for section in sections if section[2]],
    )


def _outline_sections(calibration: Calibration) -> list[tuple[str, str, Sequence[Any]]]:
    """Return the sections on residuals and on the outlines with the largest ones."""
    if not len(calibration.residuals):
        return []
    crops = outline_crops(calibration, calibration.overlays)
    n = len(crops.missing)
    missing = [Text([f"{n} image{'s' * (n != 1)} could not be read any more."])] if n else []
    lines = Text(
        [
            "Green: measured outline, red if rejected by the fit; dashed orange: predicted by the "
            "fit. Click to enlarge, scroll to zoom, drag to move."
        ],
        dim=True,
    )
    galleries = [
        Gallery(gallery, title)
        for gallery, title in (
            (
                crops.worst,
                f"The worst {len(crops.worst)}, by their distance in standard deviations",
            ),
            (crops.median, f"{len(crops.median)} typical ones (median distance)"),
        )
        if gallery
    ]
    sections: list[tuple[str, str, Sequence[Any]]] = [
        ("residuals", "Residuals", [residual_charts(calibration, crops.links)])
    ]
    if galleries or missing:
        sections.append(("outlines", "Outlines", [*missing, lines, *galleries]))
    return sections
