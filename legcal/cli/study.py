"""``legcal study``: section 4.3 of the paper; other studies are benchmarks of the source tree."""

from __future__ import annotations

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
from legcal.processors import processors

OutputFolder = Annotated[
    Path | None,
    typer.Option(
        "--output",
        "-o",
        metavar="OUT",
        help="Folder for the runs, the document and the figures. A study that was stopped "
        "is continued.",
    ),
]

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
    radians: Annotated[
        bool, typer.Option("--radians", help="Take the angles of Table 1 as radians, as printed.")
    ] = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Repeat section 4.3 of the paper: calibrations of a 6-SPU, before and after."""
    from markupsafe import Markup

    from legcal.pages.document import Drawing
    from legcal.report.session import study_table
    from legcal.simulation.observe import TableNoise
    from legcal.simulation.paper import PaperStudy
    from legcal.simulation.study import StudyResult, run_study

    def make_page(study_result: StudyResult, folder: Path) -> None:
        figure = Markup((folder / "fig4.svg").read_text(encoding="utf-8"))
        title, text = "The paper's simulation", study_table(study_result.document())
        write_page(folder / REPORT, title, text, blocks=[Drawing(figure)])

    noise, page = TableNoise.in_radians() if radians else TableNoise(), PageOfResult(make_page)
    result = run_study(
        PaperStudy(noise),
        runs,
        seed=seed,
        workers=chosen_workers(cluster, workers, processors()),
        output=output,
        progress=not quiet,
        beside=page,
    )
    page.say()
    document = result.document()
    show(as_json, lambda: document, lambda: study_table(document))
    if output is not None and not as_json:
        print_table(f"\nRuns, document and figures: {output}")
