"""Random poses for predictions: closed, inside the travel, in the assembly mode of home."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from layouts import Layout, write_machine
from machines import MACHINES, of_types, ring

import legcal
from legcal.calibration.identify.planning import (
    default_cameras,
    planned_session,
)
from legcal.errors import DidNotConverge
from legcal.machine import (
    Demand,
    Leg,
    LegKind,
    Machine,
    forward_kinematics_many,
    geometries,
    linearize,
    pose_equations,
    random_poses,
)
from legcal.machine.configurations import _Drive

SHIPPED = sorted(path.stem for path in (Path(__file__).parents[1] / "models").glob("*.yaml"))


@cache
def written(name: str, folder: Path) -> Machine:
    return legcal.load_mechanism(write_machine(folder / "m", MACHINES[name](), Layout()))


@pytest.mark.parametrize("name", sorted(MACHINES))
def test_poses_close_every_leg_inside_its_travel(
    name: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    machine = written(name, tmp_path_factory.getbasetemp() / name.replace(" ", "_"))
    session = planned_session(machine, [range(machine.n_legs)], 12)
    assert len(session.t) == 12
    for j, (leg, drawn) in enumerate(zip(session.legs, machine.legs, strict=True)):
        found = linearize(leg, session.R, session.t)
        for demand, value in zip(found.demands, found.values.T, strict=True):
            if demand is not Demand.LENGTH or leg.kind is LegKind.CONSTANT:
                assert np.abs(value).max() < 1e-8
        if leg.kind is not LegKind.CONSTANT:
            q = drawn.sign * (session.length[:, j] - drawn.q0)
            slack = 0.06 * (drawn.travel[1] - drawn.travel[0]) + 1e-5
            assert drawn.travel[0] - slack < q.min()
            assert q.max() < drawn.travel[1] + slack
    assert np.ptp(session.u, axis=0).max() > 0.02


@pytest.mark.parametrize("name", SHIPPED)
def test_legs_close_at_home_in_the_frames_on_their_joints(name: str) -> None:
    machine = legcal.load_mechanism(name)
    home = machine.T_base_Rb.inv() * machine.home * machine.T_platform_Re
    for leg in geometries(machine):
        found = linearize(leg, home.rotation.as_matrix()[None], home.translation[None])
        np.testing.assert_allclose(found.values[0, 1:], 0.0, atol=1e-9)


@pytest.mark.parametrize("name", ["hexapod", "3-upu-tilted", "3-rpr", "3-spr", "tricept"])
def test_poses_are_those_of_forward_kinematics(
    name: str,
) -> None:
    """Pinocchio closes the loops of the nominal machine; ours is a micrometre away from it."""
    machine = legcal.load_mechanism(name)
    session = planned_session(machine, [range(machine.n_legs)], 4)
    q = machine.sign * (session.length - machine.q0)
    q[:, [leg.kind is LegKind.CONSTANT for leg in machine.legs]] = 0.0
    for T, R, t in zip(forward_kinematics_many(machine, q), session.R, session.t, strict=True):
        T_Rb_Re = machine.T_base_Rb.inv() * T * machine.T_platform_Re
        np.testing.assert_allclose(T_Rb_Re.translation, t, atol=1e-4)
        np.testing.assert_allclose(T_Rb_Re.rotation.as_matrix(), R, atol=1e-4)


def test_more_motors_than_freedoms_are_followed(tmp_path: Path) -> None:
    machine = legcal.load_mechanism(write_machine(tmp_path, of_types(["US"] * 7), Layout()))
    assert (machine.mobility, len(machine.motors)) == (6, 7)
    found = legcal.identifiability(machine, [machine.leg_names] * 2)
    assert (found.full.rank, found.full.of) == (37, 37)


def test_the_motors_that_draw_their_lengths_stand_far_from_each_other() -> None:
    angles = [15.0 * j for j in range(24)]
    A, B = ring(angles, 0.3), ring([a + 30.0 * (-1) ** j for j, a in enumerate(angles)], 0.15)
    legs = [Leg("S", "S", LegKind.ACTUATED, a, b, 0.0) for a, b in zip(A, B, strict=True)]
    R, t = np.eye(3)[None], np.array([[0.0, 0.0, 0.4]])
    all_of_them = np.linalg.cond(pose_equations(legs, R, t).by_pose[0])
    drive = _Drive(legs, (0, 8, 16), R, t)
    assert len(drive.driven) == 6
    assert np.linalg.cond(drive.slopes(R, t)[0]) < 2.0 * all_of_them


def test_a_machine_that_cannot_reach_its_travel_is_refused() -> None:
    machine = legcal.load_mechanism("hexapod")
    legs = geometries(machine)
    home = machine.T_base_Rb.inv() * machine.home * machine.T_platform_Re
    away = np.tile([5.0, 5.0], (6, 1))
    away[0] = [0.01, 0.01]
    with pytest.raises(DidNotConverge, match=r"found 0 of 3 random poses .* check the travel"):
        random_poses(legs, machine.frame_legs, home, away, 3, np.random.default_rng(0))


def test_no_two_cameras_stand_in_one_place_and_all_stand_outside() -> None:
    machine = legcal.load_mechanism("hexapod")
    views = [(0, 1, 2, 3), (0, 1, 2, 3), (0, 1, 2, 3, 4, 5), (0, 1, 2, 3, 4, 5), (3,)]
    session = planned_session(machine, views, 3)
    apart = np.linalg.norm(session.camera[:, None] - session.camera, axis=2)
    assert apart[~np.eye(5, dtype=bool)].min() > 0.01
    points = np.concatenate([session.A, (session.arm + session.t[:, None]).reshape(-1, 3)])
    reach = np.linalg.norm(points - points.mean(axis=0), axis=1).max()
    assert np.linalg.norm(session.camera - points.mean(axis=0), axis=1).min() > 2.0 * reach
    side = session.camera[4] - points.mean(axis=0)  # the camera of leg 4 stands on its side
    assert side @ (session.A[3] - session.A.mean(axis=0)) > 0.0


def test_planar_machines_are_seen_from_along_their_normal() -> None:
    A = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 0.8, 0.0]])
    cameras = default_cameras(A, 0.5 * A + 0.2, [(0, 1, 2)] * 3, False, np.random.default_rng(0))
    for place in cameras - A.mean(axis=0):
        assert place[2] / np.linalg.norm(place) > 0.7
        assert place[2] / np.linalg.norm(place) < 0.99


def test_machines_that_reach_few_drawn_poses_get_all_in_the_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    chance = np.random.default_rng(1)
    monkeypatch.setattr(
        "legcal.machine.configurations._Drive.is_regular",
        lambda _self, _R, t: chance.random(len(t)) < 0.75,  # in each of five steps
    )
    machine = legcal.load_mechanism("hexapod")
    assert len(planned_session(machine, [range(6)], 60).t) == 60
