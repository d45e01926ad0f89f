"""The study of the classes: every shipped machine calibrated many times, by the steps and the fit.

The errors of the fit are judged by what it states of them and by the Cramer-Rao bound, on all that
is determined. What errors do to the platform tells of the rest, and compares the fit with the
nominal model and with the four steps, as printed and with legcal's criteria.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from legcal.errors import LegcalError
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.parametrization import vector_of
from legcal.refinement.solution import Solution
from legcal.stages.nominal import Criteria
from legcal.studies.bound import ERRORS
from legcal.studies.classes_record import FIT, NOMINAL, STEPS, FitErrors, fit_record, is_record
from legcal.studies.classes_statistics import ClassStatistics, ClassTally
from legcal.studies.outline_design import OutlineDesign
from legcal.studies.outline_determined import Determined, as_stated, at_best
from legcal.studies.outline_estimate import one_fit
from legcal.studies.outline_experiment import OutlineExperiment
from legcal.studies.outline_family import standing_where_held
from legcal.studies.outline_machines import SHIPPED
from legcal.studies.outline_platform import platform_errors
from legcal.studies.outline_session import Noise, OutlineSession
from legcal.studies.outline_steps import staged_legs
from legcal.studies.study import Record
from legcal.studies.workers import failure_of

if TYPE_CHECKING:
    from rich.console import RenderableType

EXPERIMENT = OutlineExperiment(ERRORS, SHIPPED, known=SHIPPED)


@dataclass(frozen=True)
class ClassesJudge:
    """Asks what steps and fit make of machines of every class."""

    name: str = "classes"

    def record(
        self, experiment: OutlineExperiment, design: OutlineDesign, session: OutlineSession
    ) -> Record:
        """Return errors of the platform by estimator, and of the parameters of the fit."""
        found: Record = {NOMINAL: _platform(design, session.nominal)}
        for criteria in STEPS:
            found[criteria] = _kept(partial(_steps, design, session, criteria))
        found[FIT] = _kept(partial(_fit, experiment, design, session))
        return found

    def is_record(self, found: Any) -> bool:
        """Return whether a document has errors or a failure of every estimator."""
        return is_record(found)

    def tally(self, experiment: OutlineExperiment, machine: str) -> ClassTally:
        """Return what takes the records of a machine."""
        return ClassTally(machine, len(experiment.design(machine).parametrization))

    def table(self, found: Sequence[ClassStatistics], readings: Sequence[str]) -> RenderableType:
        """Return two rows a machine: what the fit is worth, and errors of the platform."""
        from legcal.studies.classes_table import classes_table

        return classes_table(found, readings)

    def files(self, found: Sequence[ClassStatistics], readings: Sequence[str]) -> dict[str, bytes]:
        """Return the page with both tables."""
        from legcal.studies.classes_page import classes_page

        return {"classes.md": classes_page(found, readings).encode()}


def errors_of_fit(
    design: OutlineDesign, session: OutlineSession, solution: Solution, noise: Noise
) -> FitErrors:
    """Return the errors of a fit, judged on what is determined.

    Parameters
    ----------
    design : OutlineDesign
        The truth.
    session : OutlineSession
        What was measured: the solution counts axes from its nominal ones.
    solution : Solution
        What was found.
    noise : Noise
        What was measured how well.

    Raises
    ------
    DidNotConverge
        If the truth does not stand where the fit holds what is open.
    """
    parametrization, n_held = design.parametrization, len(solution.held_basis)
    there = standing_where_held(design, session, solution)
    best = _bound_of(there, noise, n_held) if n_held == 0 else _bound(there, noise, n_held)
    stated = as_stated(there, solution)
    values, true_values = (
        vector_of(parametrization, legs, session.nominal) for legs in (solution.legs, there.legs)
    )
    from_truth = vector_of(parametrization, solution.legs, there.legs)
    errors = dict(zip(parametrization.names, (values - true_values).tolist(), strict=True))
    sigma = dict(zip(solution.names, solution.sigma.tolist(), strict=True))
    return FitErrors(
        rank=stated.rank,
        nse=stated.nse(values - true_values),
        of_bound=best.nse(from_truth - vector_of(parametrization, there.legs, there.legs)),
        of_sigma=np.array([errors[name] / sigma[name] for name in errors if name in sigma]),
    )


def _bound(design: OutlineDesign, noise: Noise, n_held: int) -> Determined:
    """Return the bound of a machine."""
    return at_best(design, noise.sigma_q, noise.radius_sigma, n_held)


_bound_of = lru_cache(maxsize=32)(_bound)  # of the true machines, which are the same in all runs


def _steps(design: OutlineDesign, session: OutlineSession, criteria: Criteria) -> Record:
    """Return the record of the four steps on a session."""
    return _platform(design, staged_legs(session, criteria))


def _fit(experiment: OutlineExperiment, design: OutlineDesign, session: OutlineSession) -> Record:
    """Return the record of the fit of a session."""
    solution = one_fit(session, experiment.noise.radius_sigma)
    errors = errors_of_fit(design, session, solution, experiment.noise)
    return {**_platform(design, solution.legs), **fit_record(errors)}


def _platform(design: OutlineDesign, legs: Sequence[LegGeometry]) -> Record:
    """Return mean errors of the platform [m], [rad]."""
    shift, turn = platform_errors(design, legs)
    return {"dX": float(shift.mean()), "dE": float(turn.mean())}


def _kept(estimate: Callable[[], Record]) -> Record:
    """Return what an estimator finds, or how it fails."""
    try:
        return estimate()
    except LegcalError as error:
        return {"failure": failure_of(error)}
