"""The study of convergence: where one fit of everything ends from a start that is far off.

A run is right where every parameter is within five of the standard deviations that the fit states,
and the platform within five of those that follow from them. It is refused where the fit raises an
error. What is left is wrong with a small sigma: nothing is worse.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from legcal.studies.convergence_outcomes import ConvergenceTally
from legcal.studies.convergence_record import fit_record, is_outcome
from legcal.studies.convergence_summary import ConvergenceSummary
from legcal.studies.outline_design import OutlineDesign
from legcal.studies.outline_estimate import errors_of, one_fit
from legcal.studies.outline_experiment import OutlineExperiment
from legcal.studies.outline_platform import platform_misses, predicted_misses
from legcal.studies.outline_session import OutlineSession, StartErrors
from legcal.studies.paper_record import has_keys
from legcal.studies.study import Record

ERRORS = StartErrors(0.005, float(np.deg2rad(3.0)), 0.005, float(np.deg2rad(3.0)), full=True)
EXPERIMENT = OutlineExperiment(ERRORS)


@dataclass(frozen=True)
class ConvergenceStudy:
    """Fits from nominal models and camera poses that are wrong in everything.

    Attributes
    ----------
    experiment : OutlineExperiment
        The calibrations.
    """

    experiment: OutlineExperiment = EXPERIMENT

    @property
    def name(self) -> str:
        """Its name on the command line."""
        return "convergence"

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that decides a run beside its seed."""
        return self.experiment.settings

    def one_run(self, seed: np.random.SeedSequence) -> Record:
        """Return where the fit of one session of every machine ends."""
        return self.experiment.judged(seed, self._fit)

    def is_record(self, found: Any) -> bool:
        """Return whether a document says where the fit of every machine ended."""
        machines = set(self.experiment.machines)
        return has_keys(found, machines) and all(map(is_outcome, found.values()))

    def summary(self, records: Iterable[Record]) -> ConvergenceSummary:
        """Return how many fits were right, refused and wrong."""
        tallies = {machine: ConvergenceTally(machine) for machine in self.experiment.machines}
        for record in records:
            for machine, tally in tallies.items():
                tally.add(record[machine])
        found = tuple(tally.outcomes() for tally in tallies.values())
        return ConvergenceSummary(found, self.experiment.readings)

    def _fit(self, design: OutlineDesign, session: OutlineSession) -> Record:
        """Return where the fit of a session ends."""
        solution = one_fit(session, self.experiment.noise.radius_sigma)
        return fit_record(
            float(np.abs(errors_of(design, session, solution).of_sigma).max()),
            platform_misses(design, session.nominal),
            platform_misses(design, solution.legs),
            predicted_misses(design, solution),
        )
