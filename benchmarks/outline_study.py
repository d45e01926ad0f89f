"""What the studies of outlines share: how they repeat sessions, and how they are run.

``bound.py``, ``convergence.py`` and ``classes_study.py`` differ in what they record of a session of
:mod:`outline_sessions` and in what must come out.
"""

from __future__ import annotations

import argparse
import json
import sys
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from outline_sessions import (
    MACHINES,
    Design,
    Noise,
    OutlineSession,
    StartErrors,
    design_of,
    draw_session,
)
from rich.console import Console
from rich.text import Text

from legcal.cli.options import print_failure
from legcal.errors import LegcalError, UsageError
from legcal.report.render import Report, report, table
from legcal.simulation.paper import Record, Summary, failure_of, run_study
from legcal.workers import processors

Found = dict[str, Any]
"""What all sessions of a machine showed, as in the document: its name, ``met``, figures."""


@dataclass(frozen=True)
class OutlineStudy(ABC):
    """Many sessions of every machine, for the runner of studies."""

    machines: tuple[str, ...] = ()  # all that are known without any
    noise: Noise = field(default_factory=Noise)
    n_views: int = 3
    n_poses: int = 15  # that each view sees; no two see the same

    name: ClassVar[str]
    errors: ClassVar[StartErrors]
    known: ClassVar[tuple[str, ...]] = MACHINES
    runs: ClassVar[int]  # by default

    def __post_init__(self) -> None:
        names = self.machines or self.known
        object.__setattr__(self, "machines", names)
        if len(set(names)) < len(names) or not set(names) <= set(self.known):
            raise UsageError(
                f"The study could not be run: found the machines {', '.join(names)}, needed some "
                f"of {', '.join(self.known)}, each once; choose them."
            )

    @abstractmethod
    def record(self, design: Design, session: OutlineSession) -> Record:
        """Return what is kept of a session of a machine."""

    @abstractmethod
    def judged(self, machine: str, records: Sequence[Record]) -> Found:
        """Return what the records of all sessions of a machine say together."""

    @abstractmethod
    def table(self, machines: Sequence[Found]) -> Report:
        """Return what was found for people."""

    def files(self, machines: Sequence[Found]) -> dict[str, bytes]:
        """Return the files that belong to it, by name."""
        return {}

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that decides a session beside its seed."""
        return {"errors": asdict(self.errors), **asdict(self)}

    def design(self, machine: str) -> Design:
        """Return what is the same in all sessions of a machine."""
        return design_of(machine, self.n_views, self.n_poses, self.noise.sigma_px)

    def one_run(self, seed: np.random.SeedSequence) -> Record:
        """Return by machine what is kept of one session; it does not depend on the others."""
        seeds = dict(zip(self.known, seed.spawn(len(self.known)), strict=True))
        record: Record = {}
        for machine in self.machines:
            design, rng = self.design(machine), np.random.default_rng(seeds[machine])
            session = draw_session(design, self.noise, self.errors, rng)
            try:
                record[machine] = self.record(design, session)
            except LegcalError as error:
                record[machine] = {"failure": failure_of(error)}
        return record

    def summary(self, records: Sequence[Record], heading: dict[str, Any]) -> Summary:
        """Return what all runs showed."""
        found = [self.judged(m, [record[m] for record in records]) for m in self.machines]
        document = {
            "machines": found,
            "met": all(machine["met"] for machine in found),
            "readings": list(self.readings),
            **heading,
        }
        return document, self.files(found)

    @property
    def readings(self) -> tuple[str, ...]:
        """How the sessions are made, one sentence each."""
        noise, errors = self.noise, self.errors
        length, angle = f"{1e3 * errors.length:g} mm", f"{np.rad2deg(errors.angle):g} deg"
        shift = f"{1e3 * errors.camera_shift:g} mm"
        turn = f"{np.rad2deg(errors.camera_turn):g} deg"
        wrong = (
            f"In every run the nominal model is wrong by up to {length} in every coordinate of a "
            f"joint and every offset, and by up to {angle} in both angles of every axis (uniform); "
            f"every camera pose by up to {shift} and {turn}."
        )
        if errors.full:
            wrong = (
                f"In every run the nominal model is wrong by {length}, up or down, in every "
                f"coordinate of a joint and every offset, and by {angle} in every axis, in any "
                f"direction; every camera pose by {shift} and {turn}, in any direction and about "
                "any axis."
            )
        machines = (
            "Machines: the shipped hexapod (coplanar), the same with joints 2, 4 and 6 moved 30 mm "
            "out of the planes of 1, 3 and 5 (non-coplanar), the shipped 3-upu-tilted and 3-rpr."
            if self.known == MACHINES
            else "Machines: the shipped models are the true ones."
        )
        return (
            machines,
            f"{self.n_views} cameras of 1024 x 768 px see {self.n_poses} extreme poses each, no "
            "two the same; of a machine with six legs or more each is said to see the four legs "
            "that it sees best. Machine, poses and cameras are drawn once: the bound is one "
            "matrix, at the truth.",
            f"Every pixel along an outline is an edge point with {noise.sigma_px:g} px of white "
            "noise (1 sigma): the covariance of a fitted line is known. Readings have "
            f"{1e6 * noise.sigma_q:g} um.",
            f"Nominal radii are Gaussian, {100.0 * noise.radius_sigma:g} % (1 sigma), and so is "
            "what the fit takes them for.",
            wrong,
            "The fit sees outlines, readings, the nominal model and the rough camera poses. It "
            "estimates the noise and guards against wrong outlines as in any calibration. Twists "
            "of legs without an S joint are known (`legcal calibrate` has a prior on them).",
        )


def failures_of(records: Iterable[Record]) -> dict[str, int]:
    """Return how many records are failures, by kind of error."""
    kinds = [record["failure"]["kind"] for record in records if "failure" in record]
    return dict(Counter(kinds))


def printed(
    columns: Sequence[str], rows: Iterable[Sequence[str]], notes: Iterable[str] = ()
) -> Report:
    """Return a table of machines with notes below."""
    found = table("machine", *(f">{column}" for column in columns), rows=rows)
    return report(found, [Text(f"- {line}", style="dim") for line in notes])


def run(kind: type[OutlineStudy], description: str | None) -> int:
    """Run a study from its command line."""
    parser = argparse.ArgumentParser(description=(description or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=kind.runs)
    parser.add_argument("--machine", action="append", metavar="NAME", default=[])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=processors())
    parser.add_argument("--cluster", help="address of a Dask scheduler, in place of processes")
    parser.add_argument("-o", "--output", type=Path, help="folder for figures and document")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    try:
        study = kind(tuple(asked.machine))
        document = run_study(
            study,
            asked.runs,
            seed=asked.seed,
            workers=asked.cluster or asked.workers,
            output=asked.output,
            progress=lambda stage, done, total: print(
                f"\r{stage}: {done}/{total}", end="\n" * (done == total), file=sys.stderr
            ),
        )
    except LegcalError as error:
        print_failure(type(error).__name__, str(error), as_json=asked.json)
        return error.exit_code
    if asked.json:
        print(json.dumps(document, allow_nan=False))
    else:
        Console(highlight=False).print(study.table(document["machines"]))
    return 0
