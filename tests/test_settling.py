"""Fits whose rounds end before they settle: refused, or told."""

import numpy as np
import pytest
from hexapod_session import (
    PINHOLE,
    Session,
    disturbed_start,
    moved_outlines,
    noisy_outlines,
    noisy_readings,
    simulate,
)
from thinned import thinned

from legcal.calibration.joint_fit.factors import observed_outlines
from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.outline_errors import possible_biases
from legcal.calibration.joint_fit.rounds import NO_CHANGES, Changes, check_convergence
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.joint_fit.variables import DEFAULT_SETTINGS, RefinementSettings
from legcal.errors import DidNotConverge


@pytest.fixture(scope="module")
def session() -> Session:
    return simulate(10, legs_seen=5, sigma_px=0.05)


def _fit(session: Session, level: float, n_rounds: int) -> Solution:
    """Return a fit to outlines whose errors are shared by parts in views, in some rounds."""
    rng = np.random.default_rng(3)
    observed = observed_outlines(session.outlines, session.measurements, session.legs)
    possible = possible_biases(observed, session.legs.names)
    sigma = np.array([0.0, 0.0, level, level, 0.5 * level, 0.5 * level])
    values = sigma[possible.kind] * rng.standard_normal(len(possible))
    shift = np.einsum("nc,nce->ne", values[possible.index], possible.shift)
    outlines = moved_outlines(noisy_outlines(session, rng), PINHOLE, shift)
    measurements, start = noisy_readings(session, rng), disturbed_start(session)
    settings = RefinementSettings(noise_rounds=n_rounds)
    return refine(session.legs, measurements, outlines, start, settings)


def test_a_fit_that_still_changes_a_lot_is_refused(session: Session) -> None:
    with pytest.raises(DidNotConverge, match=r"could not settle.*needed hardly any change"):
        _fit(session, 0.2, 1)


def test_a_fit_that_still_changes_a_little_says_so(session: Session) -> None:
    (note,) = _fit(session, 0.2, 4).notes or ("",)
    assert "not quite settled" in note
    assert " px to 0." in note


@pytest.mark.parametrize("level", thinned([0.0, 0.03, 0.2], [0.0, 0.03]))
def test_a_fit_that_has_the_usual_rounds_settles(session: Session, level: float) -> None:
    assert _fit(session, level, DEFAULT_SETTINGS.noise_rounds).notes == ()


def test_outlines_that_come_and_go_are_not_settled() -> None:
    sizes, claimed = np.array([1.0, 0.0, 0.0]), np.broadcast_to(0.01 * np.eye(2), (100, 2, 2))
    assert check_convergence(Changes(sizes, sizes, 1, 100), claimed, DEFAULT_SETTINGS) == ()
    assert check_convergence(NO_CHANGES, claimed, DEFAULT_SETTINGS) == ()
    (note,) = check_convergence(Changes(sizes, sizes, 4, 100), claimed, DEFAULT_SETTINGS)
    assert "rejected 4 outlines anew, with 100 accepted" in note
    with pytest.raises(DidNotConverge, match="rejected 6 outlines anew"):
        check_convergence(Changes(sizes, sizes, 6, 100), claimed, DEFAULT_SETTINGS)
