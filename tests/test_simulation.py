"""The simulator: poses, cameras, and noise of the spread that it claims."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform

from legcal.errors import DidNotConverge
from legcal.geometry.motions import look_at
from legcal.machine.feasibility import JITTER
from legcal.machine.loader import load_mechanism
from legcal.machine.parameters import to_vector
from legcal.simulation.hexapod import (
    extreme_poses,
    follow_from_home,
    hexapod_cameras,
    hexapod_session,
    paper_hexapod,
    perturb,
    poses_with_lengths,
    simulated_leg_vectors,
)
from legcal.simulation.observe import OutlineNoise, TableNoise


def test_the_hexapod_in_memory_is_the_shipped_one() -> None:
    shipped, machine = load_mechanism("hexapod"), paper_hexapod()
    assert tuple(machine.frame_legs) == tuple(shipped.frame_legs)
    assert np.all(shipped.sign == 1)
    found = to_vector(machine.parameters, machine.frame_legs)
    assert np.allclose(found, to_vector(shipped.parameters, shipped.frame_legs), rtol=0, atol=1e-15)
    home = shipped.home_of_frames
    assert np.allclose(machine.home.as_matrix(), home.as_matrix(), rtol=0.0, atol=2e-5)
    for j, leg in enumerate(shipped.legs):
        assert {cylinder.radius for cylinder in leg.cylinders} == {machine.radius[j]}
        lower, upper = machine.travel[j] - shipped.q0[j]
        assert leg.travel[0] <= lower < upper <= leg.travel[1]


@given(seed=st.integers(0, 10**6))
@settings(max_examples=10, deadline=None)
def test_forward_kinematics_returns_the_lengths_it_was_given(seed: int) -> None:
    rng = np.random.default_rng(seed)
    machine = perturb(paper_hexapod(), rng, 0.002)
    lengths = rng.uniform(0.40, 0.44, (1, 6))
    start = RigidTransform.concatenate([machine.home])
    pose = poses_with_lengths(machine.parameters, lengths, start)
    found = np.linalg.norm(simulated_leg_vectors(machine.parameters, pose), axis=-1)
    assert np.abs(found - lengths).max() < 1e-13


def test_extreme_poses_have_every_leg_near_an_end_of_its_travel() -> None:
    machine = paper_hexapod()
    poses = extreme_poses(machine, 10, np.random.default_rng(1))
    lengths = np.linalg.norm(simulated_leg_vectors(machine.parameters, poses), axis=-1)
    part = (lengths - machine.travel[:, 0]) / np.ptp(machine.travel, axis=1)
    assert np.all((part < JITTER + 1e-9) | (part > 1.0 - JITTER - 1e-9))
    assert np.any(part < JITTER)
    assert np.any(part > 1.0 - JITTER)
    assert np.all(poses.translation[:, 2] > 0.2)  # above the base: the assembly mode of home


def test_poses_followed_from_home_have_their_lengths_and_others_stay_on_the_way() -> None:
    machine = paper_hexapod()
    lengths = np.array([np.full(6, 0.42), [0.40, 0.41, 0.42, 0.43, 0.42, 0.41], np.full(6, 5.0)])
    lengths[2, ::2] = 0.01
    poses, reached = follow_from_home(machine, lengths)
    assert reached.tolist() == [True, True, False]
    found = np.linalg.norm(simulated_leg_vectors(machine.parameters, poses), axis=-1)
    assert np.abs(found - lengths)[:2].max() < 1e-13
    assert np.linalg.norm(poses[2].translation - machine.home.translation) < 0.2


def test_poses_solved_together_are_those_solved_alone() -> None:
    machine = perturb(paper_hexapod(), np.random.default_rng(4), 0.002)
    lengths = np.random.default_rng(1).uniform(0.40, 0.44, (5, 6))
    start = RigidTransform.concatenate([machine.home] * 5)
    together = poses_with_lengths(machine.parameters, lengths, start).as_matrix()
    for pose, row in zip(together, lengths, strict=True):
        alone = poses_with_lengths(machine.parameters, row[None], start[:1]).as_matrix()
        assert np.abs(pose - alone).max() < 1e-13
    lengths[3, 0] = 5.0
    with pytest.raises(DidNotConverge, match="A simulated pose was not found"):
        poses_with_lengths(machine.parameters, lengths, start)


@pytest.mark.parametrize("uniform", [True, False])
def test_errors_of_readings_have_their_standard_deviation_and_shape(uniform: bool) -> None:
    rng = np.random.default_rng(0)
    machine = paper_hexapod()
    session = hexapod_session(
        machine,
        hexapod_cameras(machine, rng),
        rng,
        noise=TableNoise(),
        sigma_q=1e-5,
        uniform_readings=uniform,
        n_poses=60,
    )
    m = session.measurements
    lengths = np.linalg.norm(simulated_leg_vectors(machine.parameters, session.T_Rb_Re), axis=-1)
    error = (m.q_of_poses - (lengths - machine.parameters.offsets)) / 1e-5
    assert error.std() == pytest.approx(1.0, rel=0.1)
    assert (np.abs(error).max() < np.sqrt(3.0) + 1e-6) == uniform


def test_a_machine_that_reaches_no_pose_of_its_travel_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("legcal.simulation.hexapod._MAX_ROUNDS", 20)
    machine = replace(paper_hexapod(), travel=np.tile([[0.1, 0.1], [0.9, 0.9]], (3, 1)))
    with pytest.raises(DidNotConverge, match="Only 0 of 2 random poses"):
        extreme_poses(machine, 2, np.random.default_rng(0))


def test_a_camera_sees_its_target_on_its_optical_axis_and_up_as_up() -> None:
    T = look_at(np.array([1.0, 0.2, 0.3]), np.zeros(3)).inv()
    assert np.allclose(T.apply(np.zeros(3))[:2], 0.0, atol=1e-12)
    assert T.apply(np.zeros(3))[2] > 0.0
    assert T.apply([0.0, 0.0, 0.1])[1] < 0.0


def test_the_covariance_of_an_outline_is_that_of_a_line_fitted_to_white_points() -> None:
    noise = OutlineNoise(sigma_px=0.2, n_points=50)
    rng = np.random.default_rng(0)
    t = np.linspace(0.0, 1.0, 50)
    fits = np.polyfit(t, rng.normal(scale=0.2, size=(50, 20000)), 1)
    ends = np.stack([fits[1], fits[0] + fits[1]])
    assert np.allclose(np.cov(ends), noise.covariance(0.0), rtol=0.1, atol=2e-4)
