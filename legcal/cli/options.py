"""Shared parts of commands: options, and output as tables for people or one JSON document."""

from __future__ import annotations

import gc
import json
import os
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from legcal.errors import LegcalError, OutOfResources, UsageError, code_of_kind, printable

MAX_IMAGE_WORKERS = 4  # processes that search images by default; each takes about 150 MB
REPORT = "report.html"  # the page in the folder of a result
MAX_WORKERS = 256  # more are likely a mistake, and all of them would be started

ModelArgument = Annotated[
    str,
    typer.Argument(
        metavar="MODEL",
        help="A mechanism YAML, a URDF, an MJCF file, a robot.yaml folder or a shipped name.",
    ),
]
DatasetArgument = Annotated[
    Path, typer.Argument(metavar="DATASET", help="The folder that holds dataset.yaml.")
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print one JSON document on stdout, and nothing else.")
]
ModelOption = Annotated[
    str, typer.Option("--model", metavar="MODEL", help="The nominal model, as for inspect.")
]
DatasetOutputOption = Annotated[
    Path, typer.Option("--output", "-o", metavar="DIR", help="The dataset folder to write.")
]
LengthsOption = Annotated[
    bool, typer.Option("--lengths", help="The table holds whole lengths of legs.")
]
HandHeldOption = Annotated[
    bool,
    typer.Option("--hand-held", help="Hand-held camera: a new pose for every image; with --board."),
]
OnlyOption = Annotated[
    Literal["zeros", "lengths", "all"] | None,
    typer.Option(
        "--only",
        help="Take the tolerances of the model or dataset (tolerance, machine_kind) as priors, and "
        "tell this group from few photographs; the model keeps nominal values elsewhere.",
    ),
]
NoiseOption = Annotated[
    Path | None,
    typer.Option(metavar="RESULT", help="Take the errors of outlines from this earlier result."),
]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace existing files.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress on stderr.")]


def _possible_number(workers: int | None) -> int | None:
    if workers is not None and not 1 <= workers <= MAX_WORKERS:
        raise UsageError(
            f"--workers could not be used: found {workers}, needed 1 to {MAX_WORKERS} processes; "
            "give another number or leave it out."
        )
    return workers


WorkersOption = Annotated[
    int | None,
    typer.Option(
        callback=_possible_number,
        help="Number of processes; by default one for each core (for images and plans at "
        f"most {MAX_IMAGE_WORKERS}). Results do not depend on it.",
    ),
]


ClusterOption = Annotated[
    str | None,
    typer.Option(
        "--cluster",
        metavar="ADDRESS",
        envvar="LEGCAL_CLUSTER",
        help="Work on the Dask cluster of this scheduler (tcp://host:8786), not in processes of "
        "this machine.",
    ),
]


if TYPE_CHECKING:
    from rich.text import Text

    from legcal.pages.document import Block, Verdict
    from legcal.report.render import Report
    from legcal.viewer.server import PageServer


def write_page(
    page: Path | None,
    title: str,
    report: Report,
    verdict: Verdict | None = None,
    blocks: Sequence[Block] = (),
) -> None:
    """Write the printed text as a page, with further blocks, if *page* is set."""
    from legcal.pages.document import PAGE, page_html
    from legcal.report.render import text_page

    if page is not None:
        command = command_line()
        content = text_page(title, report, verdict=verdict, blocks=blocks, command=command)
        PAGE.write(page, page_html(content))


@dataclass
class PageOfResult:
    """Makes the page of a result in the folder of its other files, before that appears.

    An error then loses the page only, and :meth:`print_failure` prints it.
    """

    make: Callable[[Any, Path], object]  # of the result, into the folder
    failure: str = ""

    def __call__(self, result: Any, folder: Path) -> None:
        """Make the page of a result; its other files are in the folder."""
        try:
            self.make(result, folder)
        except Exception as error:  # minutes of work must not be lost for a page
            (folder / REPORT).unlink(missing_ok=True)
            cause = f"found {type(error).__name__}: {error}; please report this."
            if isinstance(error, LegcalError):
                cause = " ".join(error.problems)
            self.failure = f"The result was written without {REPORT}: {cause}"

    def print_failure(self) -> None:
        """Print the error on stderr, if there was one."""
        if self.failure and sys.stderr is not None:
            sys.stderr.write(f"legcal: {printable(self.failure)}\n")


@contextmanager
def importing() -> Iterator[None]:
    """Keep the garbage collector off the objects of imported modules: they live to the end."""
    n_modules = len(sys.modules)
    gc.disable()
    try:
        yield
    finally:
        if len(sys.modules) > n_modules:
            gc.freeze()
        gc.enable()


def command_line() -> str:
    """Return the command as it was given, for the record."""
    return shlex.join(["legcal", *sys.argv[1:]])


def image_workers(cluster: str | None, workers: int | None = None) -> int | str:
    """Return the cluster or the number of processes that search images, few: each takes memory."""
    from legcal.workers import processors

    return chosen_workers(cluster, workers, min(processors(), MAX_IMAGE_WORKERS))


def chosen_workers(cluster: str | None, workers: int | None, by_default: int) -> int | str:
    """Return the cluster or the number of processes; refuse both."""
    if cluster and workers:
        raise UsageError(
            "The command could not be run: found --workers beside a cluster (--cluster or "
            "LEGCAL_CLUSTER), which has workers of its own; leave one of them out."
        )
    return cluster or workers or by_default


def show(
    as_json: bool, document: Callable[[], dict[str, Any]], table: Callable[[], Report]
) -> None:
    """Print the document or the table."""
    if as_json:
        print_json(document())
    else:
        print_table(table())


def as_lines(lines: Iterable[str]) -> Report:
    """Return lines that wrap without losing anything, such as paths to copy."""
    from rich.text import Text

    from legcal.report.render import report

    return report([Text(line, overflow="fold") for line in lines])


def print_table(text: Report | Text | str) -> None:
    """Print text for people on stdout."""
    from rich.console import Console

    from legcal.report.render import report

    with _writing_to_stdout():
        # Paths to copy must not wrap: they may be wider than the terminal, and are not cut there.
        Console(highlight=False).print(report(text), crop=False)
        sys.stdout.flush()


def print_json(document: dict[str, Any]) -> None:
    """Print one JSON document on stdout."""
    with _writing_to_stdout():
        sys.stdout.write(json.dumps(document, allow_nan=False) + "\n")
        sys.stdout.flush()


@contextmanager
def _writing_to_stdout() -> Iterator[None]:
    """Refuse a stdout that cannot be written to; a closed pipe raises BrokenPipeError."""
    cause = "that it is closed"
    if sys.stdout is not None:
        try:
            yield
            return
        except BrokenPipeError:
            raise
        except OSError as error:
            cause = f"'{error.strerror}'"
            # The rest of the buffer is lost, so that nothing fails there again.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            sys.stdout = None
    raise OutOfResources(
        f"The output could not be printed: found {cause}, needed a stdout that takes it; send it "
        "elsewhere."
    )


def print_failure(
    kind: str,
    message: str,
    *,
    as_json: bool,
    problems: Sequence[dict[str, object]] = (),
    diagnosis: Sequence[dict[str, object]] = (),
    notes: Sequence[str] = (),
) -> None:
    """Print why a command failed, on stderr, or in JSON on stdout.

    Without *problems*, the message is the one problem.
    """
    message = "\n".join(map(printable, message.split("\n")))
    if as_json:
        with suppress(OutOfResources):
            error: dict[str, object] = {"kind": kind, "message": message}
            error["problems"] = list(problems) or [{"code": code_of_kind(kind), "what": message}]
            error |= {"notes": list(notes)} if notes else {}
            extra = {"diagnosis": list(diagnosis)} if diagnosis else {}
            print_json({"error": error, **extra})
            return
    if sys.stderr is not None:
        beside = "".join(f"Note: {printable(note)}\n" for note in notes)
        sys.stderr.write(f"legcal: {message}\n{beside}")


def open_browser(address: str) -> None:
    """Open the browser at an address, where it can have windows."""
    variables = ("DISPLAY", "WAYLAND_DISPLAY")
    if sys.platform in ("win32", "darwin") or any(map(os.environ.get, variables)):
        import webbrowser

        webbrowser.open(address)


def serve(server: PageServer, *, browser: bool = True) -> None:
    """Serve a page until an interrupt, the way to end it."""
    if browser:
        open_browser(str(server.address))
    with suppress(KeyboardInterrupt):
        server.run()
