"""The same machine gives the same poses far from home, whatever its spanning tree."""

from pathlib import Path

import numpy as np
import pytest
from layouts import Layout, LegLayout, write_machine
from machines import of_types
from thinned import thinned

from legcal.calibration import evaluation
from legcal.errors import DidNotConverge
from legcal.geometry.types import Array
from legcal.machine import (
    Machine,
    follow,
    forward_kinematics,
    forward_kinematics_many,
    load_mechanism,
    random_configurations,
    slider_columns,
)
from legcal.machine.kinematics import MIN_STEP, follow_pose
from legcal.machine.mobility import determinant_sign
from legcal.machine.solver import walk_in_steps


def _square(seed: int, *, hung: str = "base", sphere: bool = True) -> Layout:
    """Return a layout whose spherical joints turn anywhere, with the same axes in every tree."""
    return Layout(
        tuple(
            LegLayout(seed=10 * seed + j, flip_axes=True, hung=hung, sphere=sphere)
            for j in range(6)
        )
    )


def _stops_on_the_chain(machine: Machine, readings: Array) -> bool:
    start = machine.home_configuration
    try:
        follow(machine, start, readings[list(machine.motors)], on_the_chain=True)
    except DidNotConverge:
        return True
    return False


@pytest.mark.parametrize(
    ("leg_type", "seed", "stops", "hung"),
    thinned(
        [
            (*machine, hung)
            for machine in (
                ("US", 1, True),
                ("US", 6, True),
                ("SU", 6, True),
                ("SU", 1, False),
                ("SS", 2, False),
            )
            for hung in ("base", "platform")
        ],
        [("US", 6, True, "platform"), ("SS", 2, False, "platform")],
    ),
)
def test_random_readings_give_the_same_poses_in_every_tree(
    leg_type: str, seed: int, stops: bool, hung: str, tmp_path: Path
) -> None:
    machine = of_types([leg_type] * 6, seed=seed)
    cut = load_mechanism(write_machine(tmp_path / "cut", machine, _square(seed)))
    layout = _square(seed, hung=hung, sphere=False)
    other = load_mechanism(write_machine(tmp_path / "other", machine, layout))
    drawn = random_configurations(cut, 20, 1)
    for q, T in zip(drawn.readings, drawn.poses, strict=True):
        found = forward_kinematics(other, q)
        np.testing.assert_allclose(found.as_matrix(), T.as_matrix(), atol=1e-9)
    assert stops == any(_stops_on_the_chain(other, q) for q in drawn.readings)


def test_where_the_chain_stops_it_is_closed_at_the_readings(tmp_path: Path) -> None:
    machine = of_types(["US"] * 6, seed=1)
    cut = load_mechanism(write_machine(tmp_path / "cut", machine, _square(1)))
    other = load_mechanism(write_machine(tmp_path / "other", machine, _square(1, sphere=False)))
    columns = slider_columns(other, other.motors)[0]
    for q in random_configurations(cut, 20, 1).readings:
        if _stops_on_the_chain(other, q):
            closed = follow(other, other.home_configuration, q)
            assert np.abs(other.chain.residual(closed)).max() < 1e-12
            np.testing.assert_allclose(closed[columns], q, rtol=0.0, atol=1e-12)


def test_revolutes_that_do_not_turn_so_far_are_refused(tmp_path: Path) -> None:
    machine = of_types(["US"] * 6, seed=1)
    cut = load_mechanism(write_machine(tmp_path / "cut", machine, Layout()))
    skew = Layout(tuple(LegLayout(sphere=False, seed=10 + j) for j in range(6)))
    other = load_mechanism(write_machine(tmp_path / "other", machine, skew))
    readings = random_configurations(cut, 20, 1).readings
    with pytest.raises(DidNotConverge, match=r"joints that were not closed there, .* right angles"):
        forward_kinematics_many(other, readings)


@pytest.mark.parametrize(
    "name", ["3-rpr", "3-rps", "3-spr", "3-upu", "tricept", "hexapod-rod", "hexapod-strut"]
)
def test_the_platform_alone_goes_where_the_chain_goes(name: str) -> None:
    machine = load_mechanism(name)
    motors = list(machine.motors)
    first = machine.home_configuration[slider_columns(machine, machine.motors)[0]]
    drawn = random_configurations(machine, 5, 3)
    for q, T in zip(drawn.readings, drawn.poses, strict=True):
        found, part = follow_pose(machine, machine.home, first, q[motors], MIN_STEP)
        assert part == 1.0
        np.testing.assert_allclose(found.as_matrix(), T.as_matrix(), atol=1e-9)


def test_the_platform_alone_crosses_no_singularity() -> None:
    machine = load_mechanism("nategh-agheli")
    motors = list(machine.motors)
    first = machine.home_configuration[slider_columns(machine, machine.motors)[0]]
    lower, upper = np.array([machine.legs[j].travel for j in motors]).T
    rng = np.random.default_rng(1)
    parts = []
    for _ in range(10):
        last = rng.uniform(lower, upper)
        T, part = follow_pose(machine, machine.home, first, last, 1.0 / 64.0)
        assert determinant_sign(machine, T) == determinant_sign(machine, machine.home)
        parts.append(part)
    assert min(parts) < 1.0


def test_a_way_is_walked_in_halved_steps_up_to_what_is_in_the_way() -> None:
    tried: list[float] = []

    def attempt(part: float) -> bool:
        tried.append(part)
        return part <= 0.6

    assert walk_in_steps(attempt, 0.01) == pytest.approx(0.6, abs=0.02)
    assert tried[:3] == [1.0, 0.5, 1.0]
    assert walk_in_steps(lambda _: True, 0.01) == 1.0


def test_machines_that_share_no_reading_are_given_up_early(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = []

    def never(*_: object) -> None:
        tried.append(1)
        raise DidNotConverge("not there")

    monkeypatch.setattr(evaluation, "forward_kinematics", never)
    with pytest.raises(DidNotConverge, match="only 0 of 100 random poses"):
        evaluation.evaluate("hexapod", "hexapod")
    assert len(tried) == 10
