"""``legcal calibrate``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from legcal.cli.options import (
    ClusterOption,
    JsonOption,
    OnlyOption,
    PageOfResult,
    QuietOption,
    WorkersOption,
    command_line,
    image_workers,
    importing,
    show,
    write_page,
)
from legcal.errors import UsageError
from legcal.paper.criteria import Criteria

if TYPE_CHECKING:
    from legcal.data.dataset import Dataset
    from legcal.machine.model import Machine

_TESTS = "Validation"
_PARAMETERS = "Parameters by name (or a pattern: '*.offset'); each may be repeated"


def calibrate(
    datasets: Annotated[
        list[Path], typer.Argument(metavar="DATASET", help="The folder that holds dataset.yaml.")
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="OUT", help="The result folder to write."),
    ] = None,
    cluster: ClusterOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
    verbose: Annotated[
        bool,
        typer.Option("--verbose", "-v", help="Print all tables and details of the fit."),
    ] = False,
    criteria: Annotated[
        Criteria,
        typer.Option(
            help="The weights of the four steps: from the covariances of the axes, or all one as "
            "in the paper (literal)."
        ),
    ] = "default",
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Measure the images again, even if cached outlines fit.")
    ] = False,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME[=VALUE[±SIGMA]]",
            help="NAME fixes a parameter at its nominal value, NAME=VALUE at a value, "
            "NAME=VALUE±SIGMA (or +-) gives it a prior (leg1.length=420±0.1mm), NAME=free "
            "estimates it without a prior (c1.f?, *.radius.*).",
            rich_help_panel=_PARAMETERS,
        ),
    ] = None,
    length: Annotated[
        list[str] | None,
        typer.Option(
            metavar="JOINT:JOINT=VALUE+-SIGMA",
            help="A measured distance of two joints: leg1.base:leg3.base=MEASURED+-0.05mm, or of "
            "both ends of a rod. Rotary motors do not determine the scale; one distance does.",
            rich_help_panel=_PARAMETERS,
        ),
    ] = None,
    only: OnlyOption = None,
    holdout: Annotated[
        float | None,
        typer.Option(
            metavar="FRACTION",
            help="Hold out this fraction of the images (0.2: a fifth), and compare them with the "
            "prediction of the fit to the others.",
            rich_help_panel=_TESTS,
        ),
    ] = None,
    leave_out: Annotated[
        str,
        typer.Option(
            "--leave-out",
            metavar="IMAGES",
            help="Leave images out of the fit: p22, p22..p45 in the order in which they were "
            "taken, c2 for a view, c2:p22 for one of its images; separated by commas.",
            rich_help_panel=_TESTS,
        ),
    ] = "",
    split: Annotated[
        list[str] | None,
        typer.Option(
            metavar="MOTOR@IMAGES",
            help="The encoder of MOTOR, or of all, had another zero in these images "
            "(leg4@p01..p21), as before a slip; the model has that of the others. May be "
            "repeated.",
            rich_help_panel=_TESTS,
        ),
    ] = None,
    check: Annotated[
        Path | None,
        typer.Option(
            metavar="RESULT",
            help="Change detection: test the result of an earlier calibration with the images of "
            "DATASET; with --output a page is written. Exit 1 if something has moved.",
            rich_help_panel=_TESTS,
        ),
    ] = None,
    with_report: Annotated[
        bool,
        typer.Option(
            "--report/--no-report", help="Write OUT/report.html, a page for the browser, or not."
        ),
    ] = True,
    overlays: Annotated[
        bool,
        typer.Option(
            "--overlays", help="Draw the outlines over every photograph, in OUT/overlays."
        ),
    ] = False,
    truth: Annotated[
        str | None,
        typer.Option(
            metavar="MODEL",
            help="The true model, of a simulated machine: the page compares the result with it. "
            "The calibration does not see it.",
        ),
    ] = None,
    workers: WorkersOption = None,
) -> None:
    """Compute the calibrated model from images and encoder readings, or check an earlier one."""
    if len(datasets) > 1:
        raise UsageError(
            f"Expected one dataset, found {len(datasets)}; run legcal calibrate for each of them, "
            "or a loop in Python (docs/python.md, Many machines)."
        )
    dataset = datasets[0]
    if check is not None:
        others = {
            "--set": settings or None,
            "--length": length,
            "--only": only,
            "--holdout": holdout,
            "--leave-out": leave_out or None,
            "--split": split,
            "--fresh": fresh or None,
            "--criteria": None if criteria == "default" else criteria,
            "--overlays": overlays or None,
            "--truth": truth,
        }
        named = [name for name, value in others.items() if value is not None]
        if named:
            raise UsageError(
                f"{', '.join(named)} cannot be combined with --check, which uses the settings of "
                "the earlier result; leave one of them out."
            )
        page = None if output is None or not with_report else _page_of_check(output)
        from legcal.calibration import verification
        from legcal.report.calibration import check_summary, check_verdict

        used = image_workers(cluster, workers)
        checked = verification.check(dataset, check, progress=not quiet, workers=used)
        summary = check_summary(checked)
        write_page(page, f"Check of {check.resolve().name}", summary, check_verdict(checked))
        show(as_json, checked.document, lambda: summary)
        if checked.movement.moved:
            raise typer.Exit(1)
        return
    if output is None:
        raise UsageError(
            "--output (-o) is missing: name the result folder to write, or a result to test with "
            "--check."
        )
    if truth is not None and not with_report:
        raise UsageError(
            "--truth cannot be combined with --no-report, because only the page compares the "
            "result with it; leave one of them out."
        )
    with importing():
        from legcal.calibration import pipeline
        from legcal.calibration.result_folder import REPORT_NAME
        from legcal.data.dataset_file import overrides_of_settings
        from legcal.pages.document import PAGE
        from legcal.report import calibration
        from legcal.report.calibration_page import write_report

    arguments: dict[str, Any] = {
        "criteria": criteria,
        "use_cache": not fresh,
        "holdout": holdout,
        "leave_out": leave_out,
        "split": split or (),
        "overlays": overlays,
        "only": only,
    }
    arguments |= overrides_of_settings(settings or ())
    arguments["priors"] += _lengths(length or ())
    page = output / REPORT_NAME
    if with_report and page.exists():
        PAGE.check_place(page)
    given: Path | Dataset = dataset
    true = None
    if truth is not None:
        given, true = _with_truth(dataset, truth)
    page_of = PageOfResult(
        lambda found, folder: write_report(found, output, command_line(), truth=true, into=folder)
    )
    found = pipeline.calibrate(
        given,
        output=output,
        progress=not quiet,
        workers=image_workers(cluster, workers),
        beside=page_of if with_report else None,
        **arguments,
    )
    page_of.print_failure()
    show(
        as_json,
        lambda: calibration.document(found, output, command_line()),
        lambda: calibration.summary(found, output, command_line(), verbose=verbose),
    )
    if not found.verdict.trustworthy:
        raise typer.Exit(1)


def _with_truth(folder: Path, truth: str) -> tuple[Dataset, Machine]:
    """Return a dataset and the true model; refuse, before any work, that of another machine."""
    from legcal.calibration.evaluation import evaluate
    from legcal.data.dataset import load_dataset
    from legcal.machine.loader import load_mechanism

    dataset, true = load_dataset(folder), load_mechanism(truth)
    evaluate(dataset.machine, true)
    return dataset, true


def _page_of_check(output: Path) -> Path:
    """Return where the page of a check is written; refuse a folder that holds a result.

    Its own page would be lost.
    """
    from legcal.calibration.result_folder import REPORT_NAME
    from legcal.files.folder import RESULT, check_path
    from legcal.pages.document import PAGE

    check_path(output)
    if RESULT.is_in(output):
        raise UsageError(
            f"{output}: the page of the check could not be written: found the result of a "
            "calibration, needed another folder; give one."
        )
    output.mkdir(parents=True, exist_ok=True)
    page = output / REPORT_NAME
    PAGE.check_place(page)
    return page


def _lengths(stated: Sequence[str]) -> list[str]:
    """Return measured lengths, checked to be between two joints."""
    from legcal.files.schema import describe

    for text in stated:
        if ":" not in text.partition("=")[0]:
            raise UsageError(
                f"The length {describe(text)} could not be used: found no two joints, needed two "
                "with a colon between them; write leg1.base:leg3.base=MEASURED+-0.05mm, or both "
                "ends of a rod, leg1.base:leg1.platform."
            )
    return list(stated)
