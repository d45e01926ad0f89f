"""What a study is, and what it hands back."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

if TYPE_CHECKING:
    from rich.console import RenderableType

Record = dict[str, Any]
"""What one run found, as a JSON document: numbers, texts, lists, null; never NaN."""


class Summary(Protocol):
    """What all runs of a study found together."""

    def document(self) -> dict[str, Any]:
        """Return it as a JSON document."""

    def table(self) -> RenderableType:
        """Return it for people."""

    def files(self) -> dict[str, bytes]:
        """Return the files that belong to it, such as figures, by name."""


class Study(Protocol):
    """A Monte Carlo study: many independent runs of one experiment.

    It is sent to worker processes: it must pickle, and keep nothing from one run to the next that
    changes a result.
    """

    @property
    def name(self) -> str:
        """Its name on the command line."""

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that decides a run beside its seed, as a JSON document."""

    def one_run(self, seed: np.random.SeedSequence) -> Record:
        """Return the record of one run; a LegcalError is recorded as a failed run."""

    def is_record(self, found: Any) -> bool:
        """Return whether what a checkpoint has of a run is what :meth:`one_run` returns."""

    def summary(self, records: Iterable[Record]) -> Summary:
        """Return what the records of all runs that did not fail say, read once and in order."""
