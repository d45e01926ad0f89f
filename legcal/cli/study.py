"""``legcal study``: the commands of the studies, each with the settings that are its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from legcal.cli.options import JsonOption, print_json, print_table
from legcal.processors import processors

if TYPE_CHECKING:
    from legcal.simulation import F, Judge, OutlineExperiment, OutlineStudy, Study

RunsOption = Annotated[int, typer.Option(help="Number of runs.")]
SeedOption = Annotated[int, typer.Option(help="Seed of all runs.")]
WorkersOption = Annotated[
    int | None,
    typer.Option(help="Processes; all cores without it. Results do not depend on it."),
]
OutputOption = Annotated[
    Path | None,
    typer.Option(
        "--output",
        "-o",
        metavar="OUT",
        help="Folder for the runs, the document and the figures. A study that was stopped "
        "goes on from what is there.",
    ),
]

study = typer.Typer(
    help="Measure on many simulated machines what is claimed; their truth is known.",
    no_args_is_help=True,
)


@study.command()
def paper(
    runs: RunsOption = 100,
    seed: SeedOption = 0,
    workers: WorkersOption = None,
    output: OutputOption = None,
    radians: Annotated[
        bool, typer.Option("--radians", help="Take the angles of Table 1 as radians, as printed.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Repeat section 4.3 of the paper: calibrations of a 6-SPU, before and after."""
    from legcal.simulation import PaperStudy, TableNoise

    noise = TableNoise.in_radians() if radians else TableNoise()
    _run(PaperStudy(noise), runs, seed, workers, output, as_json=as_json)


MachineOption = Annotated[
    list[str] | None,
    typer.Option(
        "--machine",
        metavar="NAME",
        help="6-spu-noncoplanar, 6-spu-coplanar, 3-upu-tilted or 3-rpr; may be repeated, all "
        "without it.",
    ),
]
ModelOption = Annotated[
    list[str] | None,
    typer.Option(
        "--machine",
        metavar="NAME",
        help="The name of a shipped model; may be repeated, all without it.",
    ),
]


@study.command()
def bound(
    runs: RunsOption = 2000,
    machine: MachineOption = None,
    seed: SeedOption = 0,
    workers: WorkersOption = None,
    output: OutputOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compare the errors of a calibration, and its sigmas, with the Cramer-Rao bound."""
    from legcal.simulation import BOUND as EXPERIMENT
    from legcal.simulation import BoundJudge

    _run(_outlines(BoundJudge(), EXPERIMENT, machine), runs, seed, workers, output, as_json=as_json)


@study.command()
def convergence(
    runs: RunsOption = 100,
    machine: MachineOption = None,
    seed: SeedOption = 0,
    workers: WorkersOption = None,
    output: OutputOption = None,
    as_json: JsonOption = False,
) -> None:
    """Count where calibrations end that start 5 mm and 3 deg off in everything."""
    from legcal.simulation import CONVERGENCE as EXPERIMENT
    from legcal.simulation import ConvergenceJudge

    chosen = _outlines(ConvergenceJudge(), EXPERIMENT, machine)
    _run(chosen, runs, seed, workers, output, as_json=as_json)


@study.command()
def classes(
    runs: RunsOption = 200,
    machine: ModelOption = None,
    seed: SeedOption = 0,
    workers: WorkersOption = None,
    output: OutputOption = None,
    as_json: JsonOption = False,
) -> None:
    """Calibrate every shipped machine, by the four steps and by the fit, beside the bound."""
    from legcal.simulation import CLASSES as EXPERIMENT
    from legcal.simulation import ClassesJudge

    chosen = _outlines(ClassesJudge(), EXPERIMENT, machine)
    _run(chosen, runs, seed, workers, output, as_json=as_json)


def _outlines(
    judge: Judge[F], experiment: OutlineExperiment, machines: list[str] | None
) -> OutlineStudy[F]:
    """Return the study of a judge, on the machines that were asked for or on all."""
    from legcal.simulation import OutlineStudy

    chosen = replace(experiment, machines=tuple(machines)) if machines else experiment
    return OutlineStudy(judge, chosen)


def _run(
    chosen: Study, runs: int, seed: int, workers: int | None, output: Path | None, *, as_json: bool
) -> None:
    """Run a study and print what it found."""
    from legcal.report import progress_on_stderr
    from legcal.simulation import run_study

    with progress_on_stderr() as progress:
        result = run_study(
            chosen,
            runs,
            seed=seed,
            workers=processors() if workers is None else workers,
            output=output,
            progress=progress,
        )
    if as_json:
        print_json(result.document())
    else:
        from rich.console import Group
        from rich.text import Text

        where = [Text(f"\nRuns, document and figures: {output}")] if output is not None else []
        print_table(Group(result.summary.table(), *where))
