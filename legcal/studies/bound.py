"""The study of the bound: errors of one fit of everything beside the Cramer-Rao bound."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from legcal.studies.bound_record import errors_record, is_errors, run_errors
from legcal.studies.bound_statistics import Tally
from legcal.studies.bound_summary import BoundSummary
from legcal.studies.outline_bound import bound_of
from legcal.studies.outline_design import OutlineDesign
from legcal.studies.outline_estimate import errors_of, one_fit
from legcal.studies.outline_experiment import OutlineExperiment
from legcal.studies.outline_session import OutlineSession, StartErrors
from legcal.studies.paper_record import has_keys
from legcal.studies.study import Record

ERRORS = StartErrors(0.002, float(np.deg2rad(1.0)), 0.015, float(np.deg2rad(1.5)), full=False)
EXPERIMENT = OutlineExperiment(ERRORS)


@dataclass(frozen=True)
class BoundStudy:
    """Errors of parameters in many calibrations, and what the fit says of them.

    Attributes
    ----------
    experiment : OutlineExperiment
        The calibrations.
    """

    experiment: OutlineExperiment = EXPERIMENT

    @property
    def name(self) -> str:
        """Its name on the command line."""
        return "bound"

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that decides a run beside its seed."""
        return self.experiment.settings

    def one_run(self, seed: np.random.SeedSequence) -> Record:
        """Return the errors of the fit of one session of every machine."""
        return self.experiment.judged(seed, self._errors)

    def is_record(self, found: Any) -> bool:
        """Return whether a document has the errors of a fit of every machine."""
        machines = set(self.experiment.machines)
        return has_keys(found, machines) and all(map(is_errors, found.values()))

    def summary(self, records: Iterable[Record]) -> BoundSummary:
        """Return the statistics of all runs."""
        noise, tallies = self.experiment.noise, {}
        for machine in self.experiment.machines:
            design = self.experiment.design(machine)
            tallies[machine] = Tally(machine, bound_of(design, noise.sigma_q, noise.radius_sigma))
        for record in records:
            for machine, tally in tallies.items():
                tally.add(run_errors(record[machine]))
        found = tuple(tally.statistics() for tally in tallies.values())
        return BoundSummary(found, self.experiment.readings)

    def _errors(self, design: OutlineDesign, session: OutlineSession) -> Record:
        """Return the errors of the fit of a session."""
        solution = one_fit(session, self.experiment.noise.radius_sigma)
        return errors_record(errors_of(design, session, solution))
