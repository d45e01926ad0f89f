"""The experiment that the studies of outlines repeat: sessions of machines of several classes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from legcal.errors import LegcalError
from legcal.studies.outline_design import OutlineDesign, design_of
from legcal.studies.outline_machines import MACHINES, check_machines
from legcal.studies.outline_session import Noise, OutlineSession, StartErrors, draw_session
from legcal.studies.outline_text import IN_WORDS, SHIPPED_IN_WORDS, readings
from legcal.studies.study import Record
from legcal.studies.workers import failure_of

RecordOf = Callable[[OutlineDesign, OutlineSession], Record]
"""Says what an estimator makes of a session; raises a LegcalError where it makes nothing of it."""


@dataclass(frozen=True)
class OutlineExperiment:
    """Calibrations from outlines whose covariance is known.

    Attributes
    ----------
    errors : StartErrors
        How wrong the nominal model and the rough camera poses are.
    machines : tuple of str
        Which machines.
    noise : Noise
        What is measured how well.
    n_views, n_poses : int
        Cameras, and the poses that each of them sees; no two see the same.
    known : tuple of str
        The machines to choose from.

    Raises
    ------
    UsageError
        If there is no such machine.
    """

    errors: StartErrors
    machines: tuple[str, ...] = MACHINES
    noise: Noise = field(default_factory=Noise)
    n_views: int = 3
    n_poses: int = 15
    known: tuple[str, ...] = MACHINES

    def __post_init__(self) -> None:
        check_machines(self.machines, self.known)

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that decides a session beside its seed."""
        return {key: value for key, value in asdict(self).items() if key != "known"}

    @property
    def readings(self) -> tuple[str, ...]:
        """How it is made, one sentence each."""
        told = IN_WORDS if self.known == MACHINES else SHIPPED_IN_WORDS
        return (told, *readings(self.noise, self.errors, self.n_views, self.n_poses))

    def design(self, machine: str) -> OutlineDesign:
        """Return what is the same in all sessions of a machine."""
        return design_of(machine, self.n_views, self.n_poses, self.noise.sigma_px)

    def session(self, machine: str, rng: np.random.Generator) -> OutlineSession:
        """Return a session of a machine."""
        return draw_session(self.design(machine), self.noise, self.errors, rng)

    def judged(self, seed: np.random.SeedSequence, record_of: RecordOf) -> Record:
        """Return by machine what is to be kept of one session, or how the estimator failed.

        The session of a machine does not depend on which others there are.
        """
        seeds = dict(zip(self.known, seed.spawn(len(self.known)), strict=True))
        record: Record = {}
        for machine in self.machines:
            session = self.session(machine, np.random.default_rng(seeds[machine]))
            try:
                record[machine] = record_of(self.design(machine), session)
            except LegcalError as error:
                record[machine] = {"failure": failure_of(error)}
        return record
