"""A study of outlines: one experiment, and what is asked of its sessions.

The studies of outlines repeat the same sessions (:mod:`legcal.studies.outline_experiment`). What
differs is the judge: what it records of a session, what it says of all, and what must come out.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

import numpy as np

from legcal.studies.outline_design import OutlineDesign
from legcal.studies.outline_experiment import OutlineExperiment
from legcal.studies.outline_session import OutlineSession
from legcal.studies.paper_record import has_keys
from legcal.studies.study import Record

if TYPE_CHECKING:
    from rich.console import RenderableType


class Finding(Protocol):
    """What all sessions of a machine showed."""

    @property
    def is_met(self) -> bool:
        """Whether it is what must come out."""

    def document(self) -> dict[str, Any]:
        """Return it as a JSON document."""


F = TypeVar("F", bound=Finding)
F_co = TypeVar("F_co", bound=Finding, covariant=True)


class Tally(Protocol[F_co]):
    """Takes the records of one machine one by one."""

    def add(self, record: Record) -> None:
        """Count a session, or how the judge could make nothing of it."""

    def found(self) -> F_co:
        """Return what they showed."""


class Judge(Protocol[F]):
    """What is asked of every session. It is sent to worker processes, and must pickle."""

    @property
    def name(self) -> str:
        """Name of the study on the command line."""

    def record(
        self, experiment: OutlineExperiment, design: OutlineDesign, session: OutlineSession
    ) -> Record:
        """Return what is kept of a session; a LegcalError is kept as a failure."""

    def is_record(self, found: Any) -> bool:
        """Return whether a document is what :meth:`record` returns, or such a failure."""

    def tally(self, experiment: OutlineExperiment, machine: str) -> Tally[F]:
        """Return what takes the records of a machine."""

    def table(self, found: Sequence[F], readings: Sequence[str]) -> RenderableType:
        """Return what was found of all machines for people."""

    def files(self, found: Sequence[F], readings: Sequence[str]) -> dict[str, bytes]:
        """Return the files that belong to it by name."""


@dataclass(frozen=True)
class OutlineStudy(Generic[F]):
    """Many sessions of every machine before one judge.

    Attributes
    ----------
    judge : Judge
        What is asked.
    experiment : OutlineExperiment
        The sessions.
    """

    judge: Judge[F]
    experiment: OutlineExperiment

    @property
    def name(self) -> str:
        """Its name on the command line."""
        return self.judge.name

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that decides a run beside its seed."""
        return self.experiment.settings

    def one_run(self, seed: np.random.SeedSequence) -> Record:
        """Return by machine what the judge keeps of one session."""
        return self.experiment.judged(seed, partial(self.judge.record, self.experiment))

    def is_record(self, found: Any) -> bool:
        """Return whether a document has what the judge keeps of every machine."""
        machines = set(self.experiment.machines)
        return has_keys(found, machines) and all(map(self.judge.is_record, found.values()))

    def summary(self, records: Iterable[Record]) -> OutlineSummary[F]:
        """Return what all runs showed."""
        machines = self.experiment.machines
        tallies = {name: self.judge.tally(self.experiment, name) for name in machines}
        for record in records:
            for machine, tally in tallies.items():
                tally.add(record[machine])
        found = tuple(tally.found() for tally in tallies.values())
        return OutlineSummary(self.judge, found, self.experiment.readings)


@dataclass(frozen=True, eq=False)
class OutlineSummary(Generic[F]):
    """What a study of outlines hands back.

    Attributes
    ----------
    judge : Judge
        What was asked.
    machines : tuple of Finding
        What was found, in the order in which machines were asked for.
    readings : tuple of str
        How the experiment was made, one sentence each.
    """

    judge: Judge[F]
    machines: tuple[F, ...]
    readings: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """Return the document of ``--json``."""
        return {
            "machines": [found.document() for found in self.machines],
            "met": all(found.is_met for found in self.machines),
            "readings": list(self.readings),
        }

    def table(self) -> RenderableType:
        """Return the table for people."""
        return self.judge.table(self.machines, self.readings)

    def files(self) -> dict[str, bytes]:
        """Return the files that belong to it."""
        return self.judge.files(self.machines, self.readings)
