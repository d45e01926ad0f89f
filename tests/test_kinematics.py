"""Kinematics of closed chains against closed forms, finite differences and another reader."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from layouts import Layout, LegLayout, write_machine
from machines import displaced, of_types
from scipy.spatial.transform import RigidTransform

from legcal.errors import DidNotConverge, NotIdentifiable, UsageError
from legcal.geometry.types import Array
from legcal.machine.configurations import Configurations, random_configurations
from legcal.machine.kinematics import (
    Follower,
    forward_kinematics,
    forward_kinematics_many,
    inverse_kinematics,
)
from legcal.machine.leg import LegKind
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine, slider_columns, vectors_A_to_B

machine_of = cache(load_mechanism)
DRAWN = 5
OF_EACH_KIND = ("hexapod-rod", "3-rpr", "3-rps", "3-upu", "tricept", "delta", "hexaglide")


@cache
def drawn_of(name: str) -> Configurations:
    return random_configurations(machine_of(name), DRAWN, 5)


@pytest.fixture(scope="module", params=OF_EACH_KIND)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def without_a_motor(name: str) -> Machine:
    machine = machine_of(name)
    legs = list(machine.legs)
    legs[1] = replace(legs[1], kind=LegKind.PASSIVE)
    return replace(machine, legs=tuple(legs), motor_rank=machine.motor_rank - 1)


# --- a shipped machine of each kind --------------------------------------------------------------


def test_random_configurations_are_closed_inside_the_travel_and_unflipped(name: str) -> None:
    machine, drawn = machine_of(name), drawn_of(name)
    lower, upper = np.array([leg.travel for leg in machine.legs]).T
    sliding = [j for j, leg in enumerate(machine.legs) if leg.prismatic is not None]
    columns = slider_columns(machine, sliding)[0]
    for configuration, q, T in zip(*drawn, strict=True):
        assert np.abs(machine.chain.residual(configuration)).max() < 1e-12
        assert np.all((q >= lower - 1e-9) & (q <= upper + 1e-9))
        np.testing.assert_allclose(configuration[columns], q[sliding], atol=1e-12)
        np.testing.assert_allclose(inverse_kinematics(machine, T), q, atol=1e-11)
        vectors = vectors_A_to_B(machine, T)
        lengths = machine.lengths_at(q)[sliding]
        assert lengths.min() > 0.0
        np.testing.assert_allclose(lengths, np.linalg.norm(vectors, axis=1)[sliding], atol=1e-11)
        for leg, u in zip(machine.legs, vectors, strict=True):
            if leg.platform_axis is not None and leg.type == "UP":
                assert T.rotation.apply(leg.platform_axis) @ u > 0.0
    assert np.ptp(drawn.readings[:, list(machine.motors)], axis=0).min() > 1e-3


def test_forward_kinematics_inverts_inverse_kinematics_from_any_start(name: str) -> None:
    machine, drawn = machine_of(name), drawn_of(name)
    backwards = forward_kinematics_many(machine, drawn.readings[::-1])[::-1]
    for T, found in zip(drawn.poses, backwards, strict=True):
        np.testing.assert_allclose(found.as_matrix(), T.as_matrix(), atol=1e-9)
    q, T = drawn.readings[0], drawn.poses[0]
    home = inverse_kinematics(machine, machine.home)
    follower = Follower(machine)
    poses = [follower.move_to(home + s * (q - home)) for s in np.linspace(0.0, 1.0, 12)]
    np.testing.assert_allclose(poses[0].as_matrix(), machine.home.as_matrix(), atol=1e-12)
    rounded = RigidTransform.from_matrix(np.round(poses[-2].as_matrix(), 4))
    for found in (
        poses[-1],
        forward_kinematics(machine, q),
        forward_kinematics(machine, q, start=poses[-2]),
        forward_kinematics(machine, q, start=rounded),
    ):
        np.testing.assert_allclose(found.as_matrix(), T.as_matrix(), atol=1e-9)


@pytest.mark.parametrize("name", ["hexapod", "3-upu"])  # closed by points, and by frames
def test_the_jacobian_of_the_closures_is_the_derivative_of_their_residual(name: str) -> None:
    chain = machine_of(name).chain
    turned = np.random.default_rng(2).uniform(-0.5, 0.5, chain.nv)
    configuration = chain.integrate(chain.neutral(), turned)  # far from closed
    residual, jacobian = chain.linearize(configuration)
    np.testing.assert_allclose(residual, chain.residual(configuration), atol=1e-15)
    assert np.abs(residual).max() > 0.1
    h = 1e-6
    ends = [
        [chain.residual(chain.integrate(configuration, s * h * e)) for e in np.eye(chain.nv)]
        for s in (1.0, -1.0)
    ]
    numeric = (np.array(ends[0]) - np.array(ends[1])).T / (2 * h)
    np.testing.assert_allclose(jacobian, numeric, atol=1e-8)


# --- the same machine in other trees, far from home ---------------------------------------------


def test_revolutes_that_do_not_turn_so_far_are_refused(tmp_path: Path) -> None:
    machine = of_types(["US"] * 6, seed=1)
    cut = load_mechanism(write_machine(tmp_path / "cut", machine, Layout()))
    skew = Layout(tuple(LegLayout(sphere=False, seed=10 + j) for j in range(6)))
    other = load_mechanism(write_machine(tmp_path / "other", machine, skew))
    readings = random_configurations(cut, 8, 1).readings
    with pytest.raises(DidNotConverge, match=r"joints that were not closed there, .* right angles"):
        forward_kinematics_many(other, readings)


# --- refusals -----------------------------------------------------------------------------------


def _with_reading(q: object) -> Array:
    return np.array([0.07, 0.07, 0.07, q, 0.07, 0.07])


@pytest.mark.parametrize(
    ("rows", "kind", "named"),
    [
        (np.zeros(5), UsageError, r"needed \(6,\)"),
        (_with_reading(np.nan), UsageError, "reading nan of leg 'leg4'"),
        (np.stack([np.full(6, 0.07), _with_reading(-0.4)]), UsageError, r"-0\.4 of leg 'leg4'"),
        (np.stack([np.full(6, 0.07), _with_reading(3.0)]), DidNotConverge, r"row 2 .*: at .* %"),
    ],
)
def test_readings_that_no_pose_has_are_refused(
    rows: Array, kind: type[Exception], named: str
) -> None:
    hexapod = machine_of("hexapod")
    with pytest.raises(kind, match=named):
        (forward_kinematics if rows.ndim == 1 else forward_kinematics_many)(hexapod, rows)


@pytest.mark.parametrize(
    ("name", "step", "found"),
    [
        ("hexapod-rod", (0, 0, 0, 0, 0, 0.02), r"leg '\w+' would be .* mm off its constant length"),
        ("3-rps", (0, 0, 0.1, 0, 0, 0), r"would be .* mm off the plane normal to its axis"),
        ("3-upu", (0, 0, 0.1, 0, 0, 0), r"would be .* mm twisted at its end"),
        ("3-rpr", (0, 0, 0, 0, 0, 0.002), r"the platform would be 2 mm out of its plane"),
        ("tricept", (0, 0.1, 0, 0, 0, 0), r"would be .* mm off the direction that it has in the"),
    ],
)
def test_poses_that_legs_forbid_are_refused(name: str, step: tuple[float, ...], found: str) -> None:
    machine = machine_of(name)
    there = displaced(machine.home, step)
    with pytest.raises(UsageError, match=f"The platform cannot take this pose: .*{found}"):
        inverse_kinematics(machine, there)
    if name == "3-rps":
        q = inverse_kinematics(machine, machine.home)
        with pytest.raises(UsageError, match=r"followed from its start: found leg .* mm off"):
            forward_kinematics(machine, q, start=displaced(machine.home, [0, 0, 0.3, 0, 0, 0]))


@pytest.mark.parametrize(("name", "found"), [("hexapod", "6 and 5"), ("3-rps", "3 and 2")])
def test_too_few_motors_are_refused_with_both_numbers(name: str, found: str) -> None:
    loose = without_a_motor(name)
    mobility, motors = found.split(" and ")
    with pytest.raises(NotIdentifiable, match=f"mobility {mobility} and {motors} motors"):
        forward_kinematics(loose, np.zeros(loose.n_legs))
    with pytest.raises(NotIdentifiable, match=f"mobility {mobility} and {motors} motors"):
        Follower(loose)


def test_a_travel_that_home_cannot_enter_is_refused_once() -> None:
    machine = machine_of("hexapod-strut")
    far = replace(machine.legs[6], travel=(5.0, 5.1))
    machine = replace(machine, legs=(*machine.legs[:6], far))
    with pytest.raises(DidNotConverge, match=r"found 0 of 3 inside the travel.*check legcal\.home"):
        random_configurations(machine, 3, 1)
