"""The study of convergence: where one fit of everything ends from a start that is far off.

A run is right where every parameter is within five of the standard deviations that the fit states,
and the platform within five of those that follow from them. It is refused where the fit raises an
error. What is left is wrong with a small sigma: nothing is worse.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from legcal.studies.convergence_outcomes import ConvergenceTally, Outcomes
from legcal.studies.convergence_record import fit_record, is_outcome
from legcal.studies.outline_design import OutlineDesign
from legcal.studies.outline_estimate import errors_of, one_fit
from legcal.studies.outline_experiment import OutlineExperiment
from legcal.studies.outline_platform import platform_misses, predicted_misses
from legcal.studies.outline_session import OutlineSession, StartErrors
from legcal.studies.study import Record

if TYPE_CHECKING:
    from rich.console import RenderableType

ERRORS = StartErrors(0.005, float(np.deg2rad(3.0)), 0.005, float(np.deg2rad(3.0)), full=True)
EXPERIMENT = OutlineExperiment(ERRORS)


@dataclass(frozen=True)
class ConvergenceJudge:
    """Asks where fits end from nominal models and camera poses that are wrong in everything."""

    name: str = "convergence"

    def record(
        self, experiment: OutlineExperiment, design: OutlineDesign, session: OutlineSession
    ) -> Record:
        """Return where the fit of a session ends."""
        solution = one_fit(session, experiment.noise.radius_sigma)
        return fit_record(
            float(np.abs(errors_of(design, session, solution).of_sigma).max()),
            platform_misses(design, session.nominal),
            platform_misses(design, solution.legs),
            predicted_misses(design, solution),
        )

    def is_record(self, found: Any) -> bool:
        """Return whether a document says where a fit ended."""
        return is_outcome(found)

    def tally(self, experiment: OutlineExperiment, machine: str) -> ConvergenceTally:
        """Return what counts right, refused and wrong fits of a machine."""
        return ConvergenceTally(machine)

    def table(self, found: Sequence[Outcomes], readings: Sequence[str]) -> RenderableType:
        """Return one row a machine."""
        from legcal.studies.convergence_table import convergence_table

        return convergence_table(found, readings)

    def files(self, found: Sequence[Outcomes], readings: Sequence[str]) -> dict[str, bytes]:
        """Return nothing: there is no figure."""
        return {}
