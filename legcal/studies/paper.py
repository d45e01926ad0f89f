"""Section 4.3: the paper's own evaluation, a hundred simulated calibrations of a 6-SPU."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import LegcalError
from legcal.geometry.types import Array
from legcal.mechanism.parameters import KinematicParameters, to_vector
from legcal.simulation.cameras import PAPER_VIEWS, cameras_around
from legcal.simulation.machine import Machine, perturb
from legcal.simulation.poses import random_poses
from legcal.simulation.table_noise import TableNoise
from legcal.studies.eq20 import expected_errors, platform_errors
from legcal.studies.estimators import ESTIMATORS, bound_covariance
from legcal.studies.paper_means import BOUND, INITIAL, means_of
from legcal.studies.paper_record import errors_record, has_keys, is_errors
from legcal.studies.paper_summary import PaperSummary
from legcal.studies.session import SimulatedSession, observe_session, simulate_session
from legcal.studies.study import Record
from legcal.studies.truths import RAISED, coplanar_hexapod, noncoplanar_hexapod
from legcal.studies.workers import failure_of

MACHINES = {"coplanar": coplanar_hexapod, "noncoplanar": noncoplanar_hexapod}


@dataclass(frozen=True)
class PaperStudy:
    """The simulation of section 4.3, for coplanar and for non-coplanar joints.

    Attributes
    ----------
    noise : TableNoise
        Noise of the axes; ``TableNoise.in_radians()`` reads Table 1 to the letter.
    initial_error : float
        Half width of the uniform errors of the initial parameters [m].
    reading_error : float
        Half width of the uniform errors of the readings [m].
    n_poses, n_images : int
        Extreme poses of each camera position, and images of each pose.
    n_checked : int
        Random poses of eq (20).
    estimators : tuple of str
        Which are compared, of ``ESTIMATORS``.
    """

    noise: TableNoise = field(default_factory=TableNoise)
    initial_error: float = 0.002
    reading_error: float = 3e-6
    n_poses: int = 15
    n_images: int = 3
    n_checked: int = 10
    estimators: tuple[str, ...] = tuple(ESTIMATORS)

    @property
    def name(self) -> str:
        """Its name on the command line."""
        return "paper"

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that decides a run beside its seed."""
        return {
            "radians": self.noise == TableNoise.in_radians(),
            **asdict(self),
            "raised": RAISED,
            "views": [[f"leg{leg + 1}" for leg in legs] for legs in PAPER_VIEWS],
            "estimators": [*self.estimators, BOUND],
        }

    def one_run(self, seed: np.random.SeedSequence) -> Record:
        """Return what every estimator finds on one session of either machine."""
        seeds = seed.spawn(len(MACHINES))
        return {
            name: self._calibrations(truth(), np.random.default_rng(child))
            for (name, truth), child in zip(MACHINES.items(), seeds, strict=True)
        }

    def is_record(self, found: Any) -> bool:
        """Return whether a document has the errors of every estimator on either machine."""
        wanted = {INITIAL, *self.estimators, BOUND}
        return has_keys(found, set(MACHINES)) and all(
            has_keys(of_machine, wanted) and all(map(is_errors, of_machine.values()))
            for of_machine in found.values()
        )

    def summary(self, records: Iterable[Record]) -> PaperSummary:
        """Return the means over all runs."""
        machines = {name: truth() for name, truth in MACHINES.items()}
        return PaperSummary(
            means_of(records, machines), in_radians=self.noise == TableNoise.in_radians()
        )

    def _calibrations(self, machine: Machine, rng: np.random.Generator) -> Record:
        """Return the errors of all estimators for one session of a machine."""
        nominal = perturb(machine, rng, self.initial_error)
        session = simulate_session(
            machine,
            cameras_around(machine, rng),
            rng,
            noise=self.noise,
            sigma_q=self.reading_error / np.sqrt(3.0),
            uniform_readings=True,
            n_poses=self.n_poses,
            n_images=self.n_images,
        )
        checked = random_poses(machine, self.n_checked, rng)
        covariance = self._bound_covariance(session)
        found = {INITIAL: _errors(machine, nominal.parameters, covariance, checked)}
        for name in self.estimators:
            try:
                parameters = ESTIMATORS[name](session, nominal)
            except LegcalError as error:
                found[name] = {"failure": failure_of(error)}
            else:
                found[name] = _errors(machine, parameters, covariance, checked)
        found[BOUND] = _expected(machine, covariance, checked)
        return found

    def _bound_covariance(self, session: SimulatedSession) -> Array:
        """Return the covariance of the Cramer-Rao bound of a session [m^2]."""
        _, exact = observe_session(
            session.machine,
            session.cameras,
            session.T_Rb_Re,
            session.measurements,
            self.noise,
            None,
        )
        return bound_covariance(session, exact)


def _errors(
    machine: Machine, parameters: KinematicParameters, covariance: Array, checked: RigidTransform
) -> Record:
    """Return the errors of eq (20) and those of every parameter, or the failure to compute them."""
    difference = to_vector(parameters, machine.frame_legs) - to_vector(
        machine.parameters, machine.frame_legs
    )
    squared = float(difference @ np.linalg.solve(covariance, difference)) / len(difference)
    try:
        errors = platform_errors(machine, parameters, checked)
    except LegcalError as error:
        return {"failure": failure_of(error)}
    return errors_record(errors, squared, np.abs(difference))


def _expected(machine: Machine, covariance: Array, checked: RigidTransform) -> Record:
    """Return the errors to expect at the Cramer-Rao bound."""
    sigma = np.sqrt(np.diagonal(covariance))
    return errors_record(
        expected_errors(machine, covariance, checked), 1.0, np.sqrt(2.0 / np.pi) * sigma
    )
