"""``legcal study``: section 4.3 of the paper; other studies are benchmarks of the source tree."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from legcal.cli.options import JsonOption, print_json, print_table
from legcal.errors import UsageError
from legcal.processors import processors

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
    from legcal.report import progress_on_stderr
    from legcal.simulation import PaperStudy, TableNoise, run_study

    noise = TableNoise.in_radians() if radians else TableNoise()
    with progress_on_stderr() as progress:
        result = run_study(
            PaperStudy(noise),
            runs,
            seed=seed,
            workers=processors() if workers is None else workers,
            output=output,
            progress=progress,
        )
    if as_json:
        print_json(result.document())
        return
    from rich.console import Group
    from rich.text import Text

    where = [Text(f"\nRuns, document and figures: {output}")] if output is not None else []
    print_table(Group(result.summary.table(), *where))


@study.command()
def bound(
    runs: RunsOption = 2000,
    machine: MachineOption = None,
    seed: SeedOption = 0,
    workers: WorkersOption = None,
    output: OutputOption = None,
    as_json: JsonOption = False,
) -> None:
    """Name the benchmark: errors of a calibration, and its sigmas, beside the Cramer-Rao bound."""
    raise _moved("bound", "bound.py", runs, machine, seed, workers, output, as_json=as_json)


@study.command()
def convergence(
    runs: RunsOption = 100,
    machine: MachineOption = None,
    seed: SeedOption = 0,
    workers: WorkersOption = None,
    output: OutputOption = None,
    as_json: JsonOption = False,
) -> None:
    """Name the benchmark: where calibrations end that start 5 mm and 3 deg off in everything."""
    raise _moved(
        "convergence", "convergence.py", runs, machine, seed, workers, output, as_json=as_json
    )


@study.command()
def classes(
    runs: RunsOption = 200,
    machine: ModelOption = None,
    seed: SeedOption = 0,
    workers: WorkersOption = None,
    output: OutputOption = None,
    as_json: JsonOption = False,
) -> None:
    """Name the benchmark: shipped machines by the four steps and by the fit, beside the bound."""
    raise _moved(
        "classes", "classes_study.py", runs, machine, seed, workers, output, as_json=as_json
    )


def _moved(
    name: str,
    program: str,
    runs: int,
    machines: list[str] | None,
    seed: int,
    workers: int | None,
    output: Path | None,
    *,
    as_json: bool,
) -> UsageError:
    """Return that a study is a benchmark, with the command line that runs it as asked for."""
    words = ["python", f"benchmarks/{program}", "--runs", f"{runs}", "--seed", f"{seed}"]
    words += [word for machine in machines or () for word in ("--machine", machine)]
    words += [] if workers is None else ["--workers", f"{workers}"]
    words += [] if output is None else ["-o", str(output)]
    words += ["--json"] * as_json
    return UsageError(
        f"The study {name} could not be run: found a command of an earlier version, needed the "
        f"benchmark of the source tree; run {shlex.join(words)}."
    )
