"""The study of the bound: errors of one fit of everything beside the Cramer-Rao bound."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from legcal.studies.bound_record import errors_record, is_errors
from legcal.studies.bound_statistics import BoundStatistics, BoundTally
from legcal.studies.outline_bound import bound_of
from legcal.studies.outline_design import OutlineDesign
from legcal.studies.outline_estimate import errors_of, one_fit
from legcal.studies.outline_experiment import OutlineExperiment
from legcal.studies.outline_session import OutlineSession, StartErrors
from legcal.studies.study import Record

if TYPE_CHECKING:
    from rich.console import RenderableType

ERRORS = StartErrors(0.002, float(np.deg2rad(1.0)), 0.015, float(np.deg2rad(1.5)), full=False)
EXPERIMENT = OutlineExperiment(ERRORS)


@dataclass(frozen=True)
class BoundJudge:
    """Asks for the errors of parameters, and what the fit says of them."""

    name: str = "bound"

    def record(
        self, experiment: OutlineExperiment, design: OutlineDesign, session: OutlineSession
    ) -> Record:
        """Return the errors of the fit of a session."""
        solution = one_fit(session, experiment.noise.radius_sigma)
        return errors_record(errors_of(design, session, solution))

    def is_record(self, found: Any) -> bool:
        """Return whether a document has the errors of a fit."""
        return is_errors(found)

    def tally(self, experiment: OutlineExperiment, machine: str) -> BoundTally:
        """Return what compares the errors of a machine with its bound."""
        noise, design = experiment.noise, experiment.design(machine)
        return BoundTally(machine, bound_of(design, noise.sigma_q, noise.radius_sigma))

    def table(self, found: Sequence[BoundStatistics], readings: Sequence[str]) -> RenderableType:
        """Return one row a machine."""
        from legcal.studies.bound_table import bound_table

        return bound_table(found, readings)

    def files(self, found: Sequence[BoundStatistics], readings: Sequence[str]) -> dict[str, bytes]:
        """Return the page with every parameter."""
        from legcal.studies.bound_page import bound_page

        return {"bound.md": bound_page(found, readings).encode()}
