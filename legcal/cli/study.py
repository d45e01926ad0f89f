"""``legcal study``: section 4.3 of the paper; other studies are benchmarks of the source tree."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from legcal.cli.options import (
    REPORT,
    ClusterOption,
    JsonOption,
    PageOfResult,
    QuietOption,
    WorkersOption,
    chosen_workers,
    print_table,
    show,
    write_page,
)
from legcal.errors import UsageError
from legcal.processors import processors

OutputFolder = Annotated[
    Path | None,
    typer.Option(
        "--output",
        "-o",
        metavar="OUT",
        help="Folder for the runs, the document and the figures. A study that was stopped "
        "goes on from what is there.",
    ),
]

_BENCHMARKS = {  # that replace studies of earlier versions, and what they measure
    "bound": ("bound.py", "errors of a calibration, and its sigmas, beside the Cramer-Rao bound"),
    "convergence": (
        "convergence.py",
        "where calibrations end that start 5 mm and 3 deg off in everything",
    ),
    "classes": (
        "classes_study.py",
        "shipped machines by the four steps and by the fit, beside the bound",
    ),
}

study = typer.Typer(
    help="Validate the method on many simulated machines whose truth is known.",
    no_args_is_help=True,
)


@study.command()
def paper(
    runs: Annotated[int, typer.Option(help="Number of runs.")] = 100,
    seed: Annotated[int, typer.Option(help="Seed of all runs.")] = 0,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
    output: OutputFolder = None,
    part: Annotated[
        str | None,
        typer.Option(metavar="K/N", help="Only every N-th run, from run K on: a job of an array."),
    ] = None,
    merge: Annotated[
        list[Path] | None,
        typer.Option(metavar="OUT", help="Take over the runs of a part; may be repeated."),
    ] = None,
    radians: Annotated[
        bool, typer.Option("--radians", help="Take the angles of Table 1 as radians, as printed.")
    ] = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Repeat section 4.3 of the paper: calibrations of a 6-SPU, before and after."""
    from legcal.report.study import study_table
    from legcal.simulation.observe import TableNoise
    from legcal.simulation.paper import PaperStudy
    from legcal.simulation.study import StudyResult, run_study

    def make_page(found: StudyResult, folder: Path) -> None:
        caption = "Mean errors of the parameters, as in Fig. 4 of the paper; fig4.html enlarges it."
        title, figures = "The paper's simulation", {caption: folder / "fig4.png"}
        write_page(folder / REPORT, title, study_table(found.document()), figures=figures)

    noise, page = TableNoise.in_radians() if radians else TableNoise(), PageOfResult(make_page)
    result = run_study(
        PaperStudy(noise),
        runs,
        seed=seed,
        workers=chosen_workers(cluster, workers, processors()),
        output=output,
        progress=not quiet,
        beside=page,
        part=_part(part),
        merge=merge or (),
    )
    page.say()
    document = result.document()
    show(as_json, lambda: document, lambda: study_table(document))
    if output is not None and not as_json:
        print_table(f"\nRuns, document and figures: {output}")


def _part(text: str | None) -> tuple[int, int] | None:
    """Return which part of how many a text names."""
    if text is None:
        return None
    k, slash, n = text.partition("/")
    if not (slash and k.isdecimal() and n.isdecimal()):
        raise UsageError(
            f"--part could not be used: found '{text}', needed K/N as in 3/100, K from 1 to N; "
            "correct it."
        )
    return int(k), int(n)


def _name_benchmark(name: str, program: str) -> Callable[[typer.Context], None]:
    """Return the command of a study that is a benchmark now: it names the command to run."""

    def command(context: typer.Context) -> None:
        words = shlex.join(["python", f"benchmarks/{program}", *context.args])
        raise UsageError(
            f"The study {name} could not be run: found a command of an earlier version, needed the "
            f"benchmark of the source tree; run {words}."
        )

    return command


for _name, (_program, _what) in _BENCHMARKS.items():
    study.command(
        _name,
        help=f"Name the benchmark: {_what}.",
        context_settings={"ignore_unknown_options": True, "allow_extra_args": True},
    )(_name_benchmark(_name, _program))
