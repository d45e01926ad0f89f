"""Simulated hexapods and disturbed nominal models, shared by the tests of the steps."""

from dataclasses import replace
from functools import cache

import numpy as np

from legcal.geometry import Array
from legcal.machine import KinematicParameters, from_vector, to_vector
from legcal.paper import Criteria, run_steps
from legcal.paper.four_steps import StagedResult
from legcal.simulation import (
    PAPER_VIEWS,
    HexapodSession,
    OutlineNoise,
    PaperHexapod,
    TableNoise,
    hexapod_cameras,
    hexapod_session,
    nominal_of,
    paper_hexapod,
    perturb,
)


@cache
def exact_session(
    seed: int = 0,
    *,
    coplanar: bool = False,
    noise: OutlineNoise | TableNoise | None = None,
    legs: tuple[tuple[int, ...], ...] = PAPER_VIEWS,
    n_poses: int = 6,
    share_poses: bool = False,
) -> HexapodSession:
    """Return a session without noise of a hexapod 2 mm off its drawing."""
    rng = np.random.default_rng(seed)
    machine = perturb(paper_hexapod(), rng, 0.002, coplanar=coplanar)
    return hexapod_session(
        machine,
        hexapod_cameras(machine, rng, legs=legs),
        rng,
        noise=noise or OutlineNoise(),
        noisy=False,
        n_poses=n_poses,
        share_poses=share_poses,
    )


@cache
def noisy_session(
    seed: int, noise: OutlineNoise | TableNoise, *, coplanar: bool = False, n_poses: int = 15
) -> tuple[HexapodSession, PaperHexapod]:
    """Return a session with noise, and a nominal machine up to 2 mm wrong in every parameter."""
    rng = np.random.default_rng(seed)
    machine = perturb(paper_hexapod(), rng, 0.002, coplanar=coplanar)
    nominal = perturb(machine, rng, 0.002)
    session = hexapod_session(
        machine,
        hexapod_cameras(machine, rng),
        rng,
        noise=noise,
        n_poses=n_poses,
        n_images=3 if isinstance(noise, TableNoise) else 1,
    )
    return session, nominal


def five_millimetres_away(machine: PaperHexapod, seed: int = 0) -> PaperHexapod:
    """Return the machine with every parameter exactly 5 mm wrong, z and offsets included."""
    vector = to_vector(machine.parameters, machine.frame_legs)
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], len(vector))
    parameters = from_vector(vector + 0.005 * signs, machine.n_legs, machine.frame_legs)
    return replace(machine, parameters=parameters)


def errors(parameters: KinematicParameters, machine: PaperHexapod) -> Array:
    """Return the absolute error of every parameter [m]."""
    difference = to_vector(parameters, machine.frame_legs) - to_vector(
        machine.parameters, machine.frame_legs
    )
    return np.asarray(np.abs(difference))


def staged(
    session: HexapodSession, nominal: PaperHexapod, criteria: Criteria = "default"
) -> StagedResult:
    """Run the four steps on a session."""
    return run_steps(nominal_of(nominal), session.axes, session.measurements, criteria=criteria)
