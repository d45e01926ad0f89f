"""Random closed configurations: closed, inside the travel, unflipped, in one assembly mode."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from layouts import Layout, LegSpec, MachineSpec, write_machine
from machines import HOME, ring
from scipy.spatial.transform import RigidTransform
from thinned import thinned

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array
from legcal.machine import (
    Configurations,
    LegKind,
    Machine,
    forward_kinematics,
    leg_vectors,
    load_mechanism,
    random_configurations,
)


def _lines(machine: Machine, T: RigidTransform) -> float:
    """Return the determinant of the leg lines, written down once more."""
    u = leg_vectors(machine, T)
    arms = T.apply(machine.B_platform) - T.translation
    return float(np.linalg.det(np.hstack([np.cross(arms, u), u])))


def _check(machine: Machine, drawn: Configurations) -> None:
    lower, upper = np.array([leg.travel for leg in machine.legs]).T
    home = np.sign(_lines(machine, machine.home))
    for configuration, q, T in zip(*drawn, strict=True):
        assert np.abs(machine.chain.residual(configuration)).max() < 1e-12
        assert np.all((q >= lower) & (q <= upper))
        lengths = machine.sign * q + machine.q0
        assert lengths.min() > 0.0
        np.testing.assert_allclose(
            np.linalg.norm(leg_vectors(machine, T), axis=1), lengths, atol=1e-12
        )
        assert np.sign(_lines(machine, T)) == home


@pytest.mark.parametrize("n", thinned([400, 1000], [400]))
def test_hundreds_of_random_poses_of_the_hexapod_close_in_its_assembly_mode(n: int) -> None:
    machine = load_mechanism("hexapod")
    drawn = random_configurations(machine, n, 2026)
    assert len(drawn.poses) == len(drawn.readings) == len(drawn.configurations) == n
    _check(machine, drawn)
    lower, upper = np.array([leg.travel for leg in machine.legs]).T
    share = (drawn.readings - lower) / (upper - lower)
    assert np.abs(share.mean(axis=0) - 0.5).max() < 0.05  # none was drawn again
    assert share.min() < 0.01
    assert share.max() > 0.99


def test_the_same_seed_gives_the_same_poses_and_another_one_others() -> None:
    machine = load_mechanism("hexapod")
    one, same, rng = (
        random_configurations(machine, 5, chance).readings
        for chance in (3, 3, np.random.default_rng(3))
    )
    np.testing.assert_array_equal(one, same)
    np.testing.assert_array_equal(one, rng)
    assert np.abs(one - random_configurations(machine, 5, 4).readings).max() > 1e-3


def test_each_configuration_is_reached_from_home() -> None:
    machine = load_mechanism("hexapod-strut")
    drawn = random_configurations(machine, 10, 1)
    for q, T in zip(drawn.readings, drawn.poses, strict=True):
        assert np.isfinite(q).all()  # the passive strut too
        found = forward_kinematics(machine, q)
        np.testing.assert_allclose(found.as_matrix(), T.as_matrix(), atol=1e-10)


def test_long_travels_that_exclude_each_other_still_give_poses() -> None:
    machine = load_mechanism("nategh-agheli")
    drawn = random_configurations(machine, 15, 1)
    _check(machine, drawn)
    assert np.ptp(drawn.readings, axis=0).min() > 0.02


def _without_a_motor(name: str) -> Machine:
    machine = load_mechanism(name)
    passive = replace(machine.legs[1], kind=LegKind.PASSIVE)
    return replace(machine, legs=(machine.legs[0], passive, *machine.legs[2:]))


@pytest.mark.parametrize("name", ["hexapod", "6-sps", "3-rpr", "3-upu", "tricept"])
def test_without_enough_motors_home_wanders_inside_the_travel(name: str) -> None:
    machine = _without_a_motor(name)
    drawn = random_configurations(machine, 10, 1)
    lower, upper = np.array([leg.travel for leg in machine.legs]).T
    for configuration, q in zip(drawn.configurations, drawn.readings, strict=True):
        assert np.abs(machine.chain.residual(configuration)).max() < 1e-12
        assert np.all((q >= lower - 1e-9) & (q <= upper + 1e-9))
    assert np.ptp(drawn.readings, axis=0).min() > 1e-3
    middles: Array = np.array([T.translation for T in drawn.poses])
    assert np.ptp(middles, axis=0).max() > 5e-3


@pytest.mark.parametrize("motors", ["enough", "too few"])
def test_a_travel_that_home_cannot_enter_is_refused_once(motors: str) -> None:
    machine = load_mechanism("hexapod-strut")
    if motors == "too few":
        machine = _without_a_motor("hexapod-strut")
    far = replace(machine.legs[6], travel=(5.0, 5.1))
    machine = replace(machine, legs=(*machine.legs[:6], far))
    with pytest.raises(DidNotConverge, match=r"found 0 of 3 inside the travel.*check legcal\.home"):
        random_configurations(machine, 3, 1)


@pytest.mark.slow
def test_poses_are_drawn_where_home_is_nearly_singular(tmp_path: Path) -> None:
    chance = np.random.default_rng(3)
    A, B = ring(list(np.arange(6) * 60.0), 0.3), ring(list(np.arange(6) * 60.0 + 6.0), 0.15)
    A, B = A + chance.normal(0.0, 0.02, A.shape), B + chance.normal(0.0, 0.015, B.shape)
    legs = tuple(LegSpec("SU", a, HOME.apply(b)) for a, b in zip(A, B, strict=True))
    machine = load_mechanism(write_machine(tmp_path, MachineSpec(legs, HOME), Layout()))
    _check(machine, random_configurations(machine, 20, 1))
