"""``legcal calibrate``."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from legcal.cli.options import JsonOption, print_json, print_table
from legcal.errors import UsageError
from legcal.processors import processors

MOST_WORKERS = 4  # processes that search images; each takes about 150 MB


class Criteria(StrEnum):
    """What the four steps minimise."""

    DEFAULT = "default"
    LITERAL = "literal"


class Transformation(StrEnum):
    """How the four steps compute where the platform is, eq (18)."""

    POINTS = "points"
    CROSS_PRODUCT = "cross_product"


_TESTS = "Tests of a result"
_PARAMETERS = "Parameters by name (or a pattern: '*.offset'); each may be repeated"


def calibrate(
    dataset: Annotated[
        Path, typer.Argument(metavar="DATASET", help="The folder that holds dataset.yaml.")
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="OUT", help="The result folder to write."),
    ] = None,
    as_json: JsonOption = False,
    criteria: Annotated[
        Criteria,
        typer.Option(help="What the four steps minimise: legcal's criteria, or the paper's."),
    ] = Criteria.DEFAULT,
    transformation: Annotated[
        Transformation | None,
        typer.Option(
            help="How they find the platform, eq (18): point equality, or as printed. By default "
            "as the criteria are."
        ),
    ] = None,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Detect again, even where a cached detection fits.")
    ] = False,
    prior: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE+-SIGMA",
            help="What is known already: leg1.length=0.4200+-0.0001, or 420+-0.1mm.",
            rich_help_panel=_PARAMETERS,
        ),
    ] = None,
    fix: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[=VALUE]",
            help="Leave as the model has it, or at a value.",
            rich_help_panel=_PARAMETERS,
        ),
    ] = None,
    free: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Look for what is fixed otherwise (camera), and for radii and twists without a "
            "prior.",
            rich_help_panel=_PARAMETERS,
        ),
    ] = None,
    holdout: Annotated[
        float | None,
        typer.Option(
            metavar="PART",
            help="Keep this part of the images aside (0.2: a fifth) and tell how well the fit of "
            "the others foretells them.",
            rich_help_panel=_TESTS,
        ),
    ] = None,
    check: Annotated[
        Path | None,
        typer.Option(
            metavar="RESULT",
            help="Has it moved? Test the result folder of an earlier calibration with the images "
            "of DATASET; nothing is written. Exit 1 if something has moved.",
            rich_help_panel=_TESTS,
        ),
    ] = None,
    significance: Annotated[
        float | None,
        typer.Option(
            metavar="P",
            help="Of --check: probability of a false alarm; 0.01 without it.",
            rich_help_panel=_TESTS,
        ),
    ] = None,
) -> None:
    """Compute the calibrated model from images and encoder readings, or check an earlier one."""
    others = {
        "--output": output,
        "--prior": prior,
        "--fix": fix,
        "--free": free,
        "--holdout": holdout,
        "--fresh": fresh or None,
        "--criteria": None if criteria is Criteria.DEFAULT else criteria,
        "--transformation": transformation,
    }
    if check is not None:
        _refuse("--check", [name for name, value in others.items() if value is not None])
        _check(dataset, check, significance, as_json=as_json)
        return
    if significance is not None:
        raise UsageError(
            "The significance could not be used: found --significance without --check, needed the "
            "result to test; name it or leave the significance out."
        )
    if output is None:
        raise UsageError(
            "The calibration could not be run: found no --output (-o), needed the result folder to "
            "write; name one, or the result to test with --check."
        )
    from legcal.calibration import calibrate as run
    from legcal.calibration import result_document
    from legcal.report import progress_on_stderr

    with progress_on_stderr() as progress:
        calibration = run(
            dataset,
            output=output,
            progress=progress,
            criteria=criteria.value,
            transformation=None if transformation is None else transformation.value,
            use_cache=not fresh,
            workers=min(processors(), MOST_WORKERS),
            priors=prior or (),
            fixed=fix or (),
            free=free or (),
            holdout=holdout,
        )
    if as_json:
        print_json(result_document(calibration))
    else:
        from legcal.report import summary

        print_table(summary(calibration, output))
    if not calibration.verdict.trustworthy:
        raise typer.Exit(1)


def _check(dataset: Path, result: Path, significance: float | None, *, as_json: bool) -> None:
    """Test an earlier result with new images."""
    from legcal.calibration import SIGNIFICANCE, check, check_summary
    from legcal.report import progress_on_stderr

    with progress_on_stderr() as progress:
        found = check(
            dataset,
            result,
            significance=SIGNIFICANCE if significance is None else significance,
            progress=progress,
            workers=min(processors(), MOST_WORKERS),
        )
    if as_json:
        print_json(found.document())
    else:
        print_table(check_summary(found))
    if found.movement.moved:
        raise typer.Exit(1)


def _refuse(option: str, others: list[str]) -> None:
    """Refuse options beside one that does not go with them."""
    if others:
        raise UsageError(
            f"The command could not be run: found {', '.join(others)} beside {option}, which "
            "writes nothing and takes all of it from the earlier result; leave one of them out."
        )
