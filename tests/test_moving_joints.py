"""Joints at A that actuators move: no four steps, counts, ranks, and the scale."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from actuated_sessions import session
from staged_sessions import planned

from legcal.calibration.identify import identifiability
from legcal.calibration.identify.identifiability import Analysis, check_identifiable, is_scale_open
from legcal.calibration.identify.session import Session
from legcal.calibration.joint_fit.parameter_choices import Choices, Prior
from legcal.errors import NotIdentifiable
from legcal.machine.leg import Cylinder
from legcal.machine.parameters import parametrize
from legcal.paper.conditions import count_conditions

RANKS = {"hexaglide": 42, "6-rss": 54, "linear-delta": 36, "delta": 42, "3-prs": 21}
TURNING = ("6-rss", "delta")


def test_steps_of_machines_whose_joints_at_A_move_are_left_out() -> None:
    observed = planned(session("delta", images=6))
    with pytest.raises(NotIdentifiable, match="joints at the base that motors move, needed joints"):
        observed.run()


# Counts and ranks


def test_counts_by_analogy_are_those_written_out() -> None:
    """The base of a Delta whose one view shows two arms: 4 joints, 4 circles, 2 axes."""
    on = [((0, 1), True), ((2, 3), True), ((4, 5), True)]
    counts = count_conditions([(0, 1, 2, 3)], 6, actuators=on)
    points, axes = 4 + 4, 2
    products = points * (points - 1) // 2 + axes * (points - 1) + 1 - 4
    assert (counts[0].equations, counts[0].unknowns) == (products, 3 + 9 + 3 * 4)
    assert [c.by_analogy for c in counts] == [True, True, True, False]
    carriages = [((0, 1), False), ((2, 3), False), ((4, 5), False)]
    (eq12, *_) = count_conditions([(0, 1, 2, 3)], 6, actuators=carriages)
    assert (eq12.equations, eq12.unknowns) == (6 + 2 * 3 + 1, 3 + 9 + 3 * 2)


@pytest.mark.parametrize("name", ["hexaglide", "delta"])
def test_ranks_are_the_published_ones_and_radii_carry_the_scale_of_arms(name: str) -> None:
    analysis = Analysis(session(name))
    assert (analysis.full.rank, analysis.full.of) == (RANKS[name], RANKS[name])
    assert is_scale_open(analysis) == (name in TURNING)
    if name in TURNING:
        known = Choices(priors={"leg1.length": Prior(0.4, 5e-5)})
        assert not is_scale_open(Analysis(session(name), known))
        vague = Choices(priors={"leg1.length": Prior(0.4, 0.02)})  # radii would set the scale
        assert is_scale_open(Analysis(session(name), vague))
        rods = [
            replace(leg, cylinders=(Cylinder("rod", 0.008, "base", 0.0, leg.q0),))
            for leg in analysis.session.legs
        ]
        radius = Choices(priors={"leg1.radius.rod": Prior(0.008, 1e-5)})
        assert not is_scale_open(Analysis(replace(session(name), legs=tuple(rods)), radius))


def gained(name: str) -> Session:
    found = session(name)
    names = parametrize(found.leg_names, found.legs, found.frame_legs, twists=True)
    return replace(found, parametrization=names)


def test_a_free_gain_of_every_carriage_loses_the_scale_too() -> None:
    found = gained("hexaglide")
    gains = frozenset(x for x in found.parametrization.names if x.endswith(".gain"))
    assert len(gains) == 6
    assert not is_scale_open(Analysis(found))
    assert is_scale_open(Analysis(found, Choices(free=gains)))
    assert not is_scale_open(Analysis(found, Choices(free=gains - {"motor1.gain"})))


def test_an_unknown_scale_is_refused_with_what_would_fix_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        identifiability, "recorded_session", lambda dataset, twists: session("6-rss")
    )
    known = SimpleNamespace(
        readings_carry_length=False,
        length_option="--length leg1.base:leg1.platform=MEASURED±SIGMAmm",
    )
    dataset: Any = SimpleNamespace(folder="servo", machine=known)
    wanted = "=MEASURED.*--set.*board on base or platform"
    with pytest.raises(NotIdentifiable, match=wanted):
        check_identifiable(dataset)
