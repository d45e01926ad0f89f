"""What the four steps take of shipped machines, and of hexapods of section 4.3."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from fit_sessions import MachineSession, machine_session
from hexapod_sessions import PaperSession, disturbed_hexapod, moved, paper_session
from scipy.spatial.transform import RigidTransform

from legcal.calibration.identify.session import Session
from legcal.data.measurements import Measurements
from legcal.data.outlines import LegAxes, axes_from_outlines
from legcal.geometry.types import Array, BoolArray
from legcal.machine.leg import Leg
from legcal.machine.model import Machine
from legcal.machine.parameters import (
    Parametrization,
    geometries,
    moved_legs,
    parametrize,
    to_vector,
    vector_of,
)
from legcal.paper.criteria import Criteria
from legcal.paper.four_steps import StagedResult, run_steps
from legcal.paper.unknowns import NominalMachine
from legcal.simulation.observe import OutlineNoise, TableNoise, noisy_outlines
from legcal.simulation.paper import PAPER_VIEWS


@dataclass(frozen=True, eq=False)
class Observed:
    """What the steps take, and the truth behind it."""

    nominal: NominalMachine
    axes: LegAxes
    measurements: Measurements
    true_legs: tuple[Leg, ...]
    T_camera_Rb: tuple[RigidTransform, ...]

    @property
    def A_Rb(self) -> Array:
        """True base joint centres [m]."""
        return np.array([leg.A for leg in self.true_legs])

    @property
    def is_angle(self) -> BoolArray:
        """Which parameters are angles."""
        return np.array([unit == "rad" for unit in self._parametrization().units])

    def run(self, criteria: Criteria = "default", **options: Any) -> StagedResult:
        """Run the four steps."""
        return run_steps(self.nominal, self.axes, self.measurements, criteria=criteria, **options)

    def known(self, part: float) -> "Observed":
        """Return the same with standard deviations that are smaller."""
        covariance, m = part**2 * self.axes.covariance, self.measurements
        axes = replace(self.axes, covariance=covariance)
        return replace(self, axes=axes, measurements=replace(m, sigma_q=part * m.sigma_q))

    def errors(self, legs: tuple[Leg, ...], *, twists: bool = False) -> Array:
        """Return the error of every parameter of legs [m, rad]."""
        parametrization, true = self._parametrization(twists=twists), self.true_legs
        return vector_of(parametrization, legs, true) - vector_of(parametrization, true, true)

    def _parametrization(self, *, twists: bool = False) -> Parametrization:
        nominal = self.nominal
        return parametrize(nominal.leg_names, self.true_legs, nominal.frame_legs, twists=twists)


@cache
def shipped(name: str, *, n_poses: int = 6, noise: float = 0.0, seed: int = 0) -> Observed:
    """Return a shipped model as seen by three cameras, nominal legs being 3 mm and 1 deg off.

    The noise counts in that of 0.2 px at the ends of an outline.
    """
    session = machine_session(name, n_poses=n_poses)
    if noise > 0.0:
        covariance = noise**2 * session.outlines.covariance
        session = replace(session, outlines=replace(session.outlines, covariance=covariance))
        measurements, outlines = session.noisy(seed)
        session = replace(session, measurements=measurements, outlines=outlines)
    return _observed(session)


def _observed(session: MachineSession) -> Observed:
    legs = session.legs
    radii = {part: radius for (_, part), radius in legs.radii.items()}
    return Observed(
        NominalMachine(legs.names, legs.nominal, legs.frame_legs),
        axes_from_outlines(session.outlines, session.measurements, radii),
        session.measurements,
        session.truth.legs,
        session.truth.T_camera_Rb,
    )


def planned(session: Session, *, noise: float = 0.0, seed: int = 0) -> Observed:
    """Return what a planned session will show, nominal legs being 3 mm and 1 deg off.

    The noise counts in standard deviations of 0.1 px at the ends of an outline, and in those of the
    readings; without it all is exact.
    """
    m, n = session.measurements, len(session.outlines)
    covariance = np.tile((0.1 * (noise or 1.0)) ** 2 * np.eye(2), (n, 1, 1))
    outlines = replace(session.outlines, covariance=covariance)
    if noise > 0.0:
        rng = np.random.default_rng(seed)
        outlines = noisy_outlines(outlines, m.views[0].camera, rng)
        read = rng.standard_normal(m.q.shape)
        same = session.carried_by[:, None] == session.carried_by  # rods on one motor
        carried = session.carried_by >= 0
        of_motor = np.where(carried, same.argmax(axis=1), np.arange(len(same)))
        m = replace(m, q=m.q + m.sigma_of(session.legs) * read[:, of_motor])
    units = np.array(session.parametrization.units)
    step = np.where(units == "m", 0.003, np.deg2rad(1.0) / np.sqrt(2.0))
    step *= np.random.default_rng(0).choice([-1.0, 1.0], len(step))
    away = moved_legs(session.legs, session.parametrization.place, step)
    radii = {part: radius for (_, part), radius in session.fitted.radii.items()}
    return Observed(
        NominalMachine(session.leg_names, away, session.frame_legs),
        axes_from_outlines(outlines, m, radii),
        m,
        session.legs,
        tuple(T.inv() for T in session.places),
    )


# Hexapods of section 4.3


@cache
def exact_session(
    seed: int = 0,
    *,
    coplanar: bool = False,
    noise: OutlineNoise | TableNoise | None = None,
    legs: tuple[tuple[int, ...], ...] = PAPER_VIEWS,
    n_poses: int = 6,
    share_poses: bool = False,
) -> PaperSession:
    """Return a session without noise of a hexapod 2 mm off its drawing."""
    return paper_session(
        disturbed_hexapod(seed, coplanar=coplanar),
        noise or OutlineNoise(),
        seed=seed,
        legs=legs,
        n_poses=n_poses,
        share_poses=share_poses,
    )


@cache
def noisy_session(
    seed: int, noise: OutlineNoise | TableNoise, *, coplanar: bool = False, n_poses: int = 15
) -> tuple[PaperSession, NominalMachine]:
    """Return a session with noise, and a nominal machine up to 2 mm wrong in every parameter."""
    machine = disturbed_hexapod(seed, coplanar=coplanar)
    session = paper_session(
        machine,
        noise,
        seed=seed,
        noisy=True,
        n_poses=n_poses,
        n_images=3 if isinstance(noise, TableNoise) else 1,
    )
    return session, moved(machine, np.random.default_rng(seed).uniform(-0.002, 0.002, 30))


def errors(legs: Sequence[Leg], machine: Machine | NominalMachine) -> Array:
    """Return the absolute error of every parameter [m]."""
    true = geometries(machine) if isinstance(machine, Machine) else machine.legs
    found, wanted = (to_vector(some, machine.frame_legs) for some in (legs, true))
    return np.asarray(np.abs(found - wanted))


def staged(
    session: PaperSession, nominal: NominalMachine, criteria: Criteria = "default"
) -> StagedResult:
    """Run the four steps on a session."""
    return run_steps(nominal, session.axes, session.measurements, criteria=criteria)
