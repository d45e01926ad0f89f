"""Wrong outlines do not bend the answer: they are rejected, with what they disagree by."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from machine_session import MachineSession, machine_session, shifted
from thinned import thinned

from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.solution import Solution
from legcal.geometry.types import Array, BoolArray

SHARE = 0.2
N_SEEDS = 2


def _session(name: str) -> MachineSession:
    return machine_session(name, n_poses=12)


def _errors(session: MachineSession, found: Solution) -> Array:
    """Return the errors of the kinematic parameters [m, rad]."""
    legs = session.legs
    return legs.vector(found.legs) - legs.vector(session.truth.legs)


@cache
def _clean(name: str, seed: int) -> Solution:
    session = _session(name)
    return refine(session.legs, *session.noisy(seed), session.start)


def single(session: MachineSession, rng: np.random.Generator) -> BoolArray:
    """Return outlines here and there."""
    return np.asarray(rng.random(len(session.outlines)) < SHARE)


def pairs(session: MachineSession, rng: np.random.Generator) -> BoolArray:
    """Return both edges of legs here and there."""
    return np.repeat(rng.random(len(session.outlines) // 2) < SHARE, 2)


def whole_legs(session: MachineSession, rng: np.random.Generator) -> BoolArray:
    """Return all outlines of whole legs in images."""
    key = session.outlines.row * session.legs.n_legs + session.outlines.leg
    return np.asarray((rng.random(key.max() + 1) < SHARE)[key])


CASES = [
    ("hexapod", single),
    ("3-rpr", single),
    ("3-upu-tilted", pairs),
    ("hexapod", whole_legs),
    ("tricept", whole_legs),
]


@pytest.mark.parametrize(("name", "which"), thinned(CASES, [CASES[2], CASES[4]]))
def test_a_fifth_of_the_outlines_wrong_costs_less_than_half_the_accuracy(
    name: str, which: Callable[[MachineSession, np.random.Generator], BoolArray]
) -> None:
    session = _session(name)
    of_sigma = []
    for seed in range(N_SEEDS):
        measurements, outlines = session.noisy(seed)
        rng = np.random.default_rng(100 + seed)
        wrong = which(session, rng)
        assert 0.1 < wrong.mean() < 0.3
        dirty = shifted(session, outlines, _shifts(session, wrong, rng, alone=which is single))
        found = refine(session.legs, measurements, dirty, session.start)
        clean = _clean(name, seed)
        sigma = np.sqrt(np.diag(clean.kinematic_covariance))
        free = sigma > 0.0  # all but twists
        of_sigma.append([_errors(session, s)[free] / sigma[free] for s in (clean, found)])
        assert not found.outlines.used[wrong].any()
        assert (~found.outlines.used[~wrong]).sum() <= 2
        assert all("px" in found.outlines.reason[i] for i in np.flatnonzero(wrong))
    of_clean, of_dirty = np.sqrt(np.mean(np.square(of_sigma), axis=(0, 2)))
    assert of_clean < 1.5
    assert of_dirty < 1.5 * of_clean


def _shifts(
    session: MachineSession, wrong: BoolArray, rng: np.random.Generator, *, alone: bool
) -> Array:
    """Return how far ends are moved, 2 to 30 px: edges of a leg in an image together or alone."""
    o = session.outlines
    group = np.arange(len(o)) if alone else o.row * session.legs.n_legs + o.leg
    n = int(group.max()) + 1
    size = rng.uniform(2.0, 30.0, n) * rng.choice([-1.0, 1.0], n)
    sign = np.where(o.edge == 1, 1.0, -1.0)
    return np.where(wrong, size[group] * sign, 0.0)[:, None] * np.ones(2)
