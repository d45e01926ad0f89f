"""What does not matter to a fit of any class: its start, names of legs, the unit of length."""

from dataclasses import replace

import numpy as np
import pytest
from machine_session import MachineSession, machine_session
from scipy.spatial.transform import RigidTransform
from thinned import thinned

from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.joint_fit.variables import FittedLegs, Start
from legcal.machine import Leg, moved_legs

MACHINES = ("3-rps", "tricept", "hexapod-rod", "3-rpr")
SCALE = 2.5


def noisy(name: str) -> MachineSession:
    session = machine_session(name)
    measurements, outlines = session.noisy(0)
    return replace(session, measurements=measurements, outlines=outlines)


def fitted(session: MachineSession) -> Solution:
    return refine(session.legs, session.measurements, session.outlines, session.start)


@pytest.mark.parametrize("name", thinned(MACHINES, ["tricept", "3-rpr"]))
def test_where_the_fit_starts_does_not_show_in_the_result(name: str) -> None:
    session = noisy(name)
    legs = session.legs
    one = fitted(session)
    units = np.array(legs.parametrization.units)
    step = np.random.default_rng(5).choice([-1.0, 1.0], len(units))
    step *= np.where(units == "m", 0.003, np.deg2rad(1.0))
    elsewhere = moved_legs(legs.nominal, legs.parametrization.place, step)
    other = fitted(replace(session, start=replace(session.start, legs=elsewhere)))
    assert len(one.names) >= len(units) - 1  # the twist of a Tricept is fixed
    away = np.array([other.values[n] - one.values[n] for n in one.names])
    assert np.abs(away / one.sigma).max() < 1e-3
    assert other.cost == pytest.approx(one.cost, rel=1e-6)


@pytest.mark.parametrize("name", thinned(MACHINES, ["3-rps", "3-rpr"]))
def test_relabelling_legs_relabels_the_result(name: str) -> None:
    session = noisy(name)
    found = fitted(session)
    legs, n = session.legs, session.legs.n_legs
    order = np.roll(np.arange(n), 1)  # new leg i is old leg order[i]
    new = np.argsort(order)
    relabelled = FittedLegs(
        tuple(legs.names[i] for i in order),
        tuple(legs.nominal[i] for i in order),
        legs.sign[order],
        tuple(int(new[i]) for i in legs.frame_legs),
        {(int(new[i]), part): r for (i, part), r in legs.radii.items()},
    )
    m, start = session.measurements, session.start
    again = refine(
        relabelled,
        replace(m, q=m.q[:, order]),
        replace(session.outlines, leg=new[session.outlines.leg]),
        replace(start, legs=tuple(start.legs[i] for i in order)),
    )
    assert set(again.names) == set(found.names)
    sigma = dict(zip(found.names, found.sigma.tolist(), strict=True))
    for parameter, s in zip(again.names, again.sigma.tolist(), strict=True):
        assert abs(again.values[parameter] - found.values[parameter]) < 1e-3 * s
        assert s == pytest.approx(sigma[parameter], rel=1e-4)


@pytest.mark.parametrize("name", thinned(MACHINES, ["hexapod-rod", "tricept"]))
def test_a_machine_in_another_size_gives_the_same_in_that_size(name: str) -> None:
    session = noisy(name)
    found, again = fitted(session), fitted(scaled(session))
    assert again.names == found.names
    unit = np.where([found.units[n] == "m" for n in found.names], SCALE, 1.0)
    values, others = (
        np.array([solution.values[n] for n in found.names]) for solution in (found, again)
    )
    assert np.abs((others / unit - values) / found.sigma).max() < 1e-3
    np.testing.assert_allclose(again.sigma / unit, found.sigma, rtol=1e-4)
    assert again.rms_px == pytest.approx(found.rms_px)


def scaled(session: MachineSession) -> MachineSession:
    """Return a session in which all lengths are larger; images stay as they are."""
    m, legs, start = session.measurements, session.legs, session.start

    def motion(T: RigidTransform) -> RigidTransform:
        return RigidTransform.from_components(SCALE * T.translation, T.rotation)

    return replace(
        session,
        measurements=replace(m, q=SCALE * m.q, sigma_q=SCALE * m.sigma_q),
        legs=replace(
            legs,
            nominal=larger(legs.nominal),
            radii={part: SCALE * r for part, r in legs.radii.items()},
        ),
        start=Start(
            larger(start.legs),
            tuple(map(motion, start.T_camera_Rb)),
            tuple(map(motion, start.T_Rb_Re)),
            start.label,
        ),
    )


def larger(legs: tuple[Leg, ...]) -> tuple[Leg, ...]:
    return tuple(replace(leg, A=SCALE * leg.A, B=SCALE * leg.B, q0=SCALE * leg.q0) for leg in legs)
