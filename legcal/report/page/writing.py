"""Pages written as files: atomically, and never over a file of another program."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from legcal.calibration.result_folder import REPORT_NAME
from legcal.machine.files import RESULT_YAML
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.pages.document import Page
from legcal.pages.html import PAGE, page_html

if TYPE_CHECKING:
    from legcal.calibration.result import Calibration


def write_page(page: Page, path: Path) -> None:
    """Write a page; an earlier one of legcal is replaced, any other file is not.

    Raises
    ------
    UsageError
        If another file has that name, or no file can have it.
    OutOfResources
        If it cannot be written.
    """
    PAGE.write(path, page_html(page))


def write_report(
    calibration: Calibration,
    folder: str | Path,
    command: str = "",
    *,
    truth: str | Path | Machine | None = None,
    into: str | Path | None = None,
) -> Path:
    """Write ``report.html`` into the result folder of a calibration.

    Parameters
    ----------
    calibration : Calibration
        The result of :func:`legcal.calibrate`.
    folder : path
        The result folder.
    command : str
        The command of the calibration, for the record.
    truth : path, name or Machine, optional
        The true model of a simulated or measured machine: the page then shows the errors of the
        nominal and the calibrated model, as Fig. 4 of the paper.
    into : path, optional
        The folder with the files of the result while it is being written.

    Returns
    -------
    path
        The page.

    Raises
    ------
    UsageError
        If another file has that name.
    ModelError
        If the truth is not a model of the same machine.
    OutOfResources
        If it cannot be written.
    """
    from legcal.report.page.calibration_page import calibration_page
    from legcal.report.page.truth import truth_blocks

    files = Path(folder if into is None else into)
    path = files / REPORT_NAME
    PAGE.check_place(path)
    against = []
    if truth is not None:
        true = truth if isinstance(truth, Machine) else load_mechanism(truth)
        against = truth_blocks(calibration, true, load_mechanism(files / RESULT_YAML))
    write_page(calibration_page(calibration, Path(folder), command, against), path)
    return path
