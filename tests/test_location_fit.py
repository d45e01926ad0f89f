"""Robot-world and hand-eye calibration: geometry, starts, maximum likelihood, covariance."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from located import (
    BASE,
    SIGMA_ANGLE,
    SIGMA_POSITION,
    TOOL,
    frame_errors,
    frames_of,
    noisy,
    pairs_at,
    shipped,
    workspace_poses,
)
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.calibration.location import search as closed_form
from legcal.calibration.location.fit import Fit, fit
from legcal.calibration.location.frames import (
    Frames,
    Noise,
    PosePairs,
    jacobian,
    predicted,
    residuals,
)
from legcal.calibration.location.problem import PlatformMotions, motions_by_readings
from legcal.calibration.location.search import search
from legcal.geometry import rotation_matrices
from legcal.geometry.types import Array
from legcal.machine import forward_kinematics

STATED = (np.array([SIGMA_POSITION, SIGMA_ANGLE]), (True, True))
UNKNOWN = (np.array([1e-3, 1e-2]), (False, False))

unit = st.floats(-1.0, 1.0)
vectors = st.tuples(unit, unit, unit).map(np.array)
rotations = st.tuples(unit, unit, unit, unit).map(np.array).filter(
    lambda q: bool(np.linalg.norm(q) > 0.1)
).map(Rotation.from_quat)  # fmt: skip
half_turns = vectors.filter(lambda v: bool(np.linalg.norm(v) > 0.1)).map(
    lambda v: Rotation.from_rotvec(np.pi * v / np.linalg.norm(v))
)
motions = st.builds(RigidTransform.from_components, vectors, rotations | half_turns)


def of(noise: tuple[Array, tuple[bool, bool]], n: int) -> Noise:
    return Noise(np.ones((n, 2)), *noise)


def fitted(pairs: PosePairs, noise: tuple[Array, tuple[bool, bool]] = STATED) -> Fit:
    return fit(pairs, search(pairs, 3).frames.at(0), of(noise, len(pairs)))


def test_derivatives_of_predictions_are_those_of_differences() -> None:
    pairs, frames = pairs_at(BASE, TOOL), frames_of(BASE, TOOL)
    J = jacobian(frames, pairs)
    for i in range(12):
        step = np.zeros(12)
        step[i] = 1e-6
        M, p = predicted(frames.moved(step), pairs)
        M_back, p_back = predicted(frames.moved(-step), pairs)
        turn = Rotation.from_matrix(M @ np.swapaxes(M_back, 1, 2)).as_rotvec()
        np.testing.assert_allclose(J[:, :3, i], (p - p_back) / 2e-6, atol=1e-9)
        np.testing.assert_allclose(J[:, 3:, i], turn / 2e-6, atol=1e-9)


@settings(max_examples=8, deadline=None)
@given(base=motions, tool=motions)
def test_exact_poses_give_exact_frames_wherever_these_are(
    base: RigidTransform, tool: RigidTransform
) -> None:
    found = fitted(pairs_at(base, tool), UNKNOWN)
    assert np.abs(frame_errors(found.frames, base, tool)).max() < 1e-12


@settings(max_examples=5, deadline=None)
@given(base=motions, tool=motions)
def test_positions_alone_give_the_base_and_the_place_of_the_tool(
    base: RigidTransform, tool: RigidTransform
) -> None:
    pairs = pairs_at(base, tool)
    pairs = replace(
        pairs,
        oriented=np.zeros(len(pairs), dtype=np.bool_),
        M=np.tile(np.eye(3), (len(pairs), 1, 1)),
    )
    frames = search(pairs, 4).frames.at(0)
    assert np.abs(frame_errors(frames, base, tool)[:9]).max() < 1e-9


@settings(max_examples=5, deadline=None)
@given(base=motions, tool=motions)
def test_our_closed_form_is_that_of_opencv(base: RigidTransform, tool: RigidTransform) -> None:
    pairs = noisy(pairs_at(base, tool), np.random.default_rng(3))
    ours, theirs = closed_form.solve_by_kronecker(pairs), closed_form.solve_by_opencv(pairs)
    assert theirs is not None
    np.testing.assert_allclose(ours.R_base, theirs.R_base, atol=1e-9)
    np.testing.assert_allclose(ours.R_tool, theirs.R_tool, atol=1e-9)
    np.testing.assert_allclose(ours.t_base, theirs.t_base, atol=1e-3)
    np.testing.assert_allclose(ours.t_tool, theirs.t_tool, atol=1e-3)


def test_nothing_changes_where_opencv_has_no_solver(monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = noisy(pairs_at(BASE, TOOL), np.random.default_rng(4))
    before = fitted(pairs)
    monkeypatch.delattr("cv2.calibrateRobotWorldHandEye")
    assert closed_form.solve_by_opencv(pairs) is None
    apart = frame_errors(fitted(pairs).frames, *before.frames.transforms())
    assert np.abs(apart).max() < 1e-11


@settings(max_examples=4, deadline=None)
@given(world=motions)
def test_moving_the_world_moves_the_base_and_nothing_else(world: RigidTransform) -> None:
    pairs = noisy(pairs_at(BASE, TOOL), np.random.default_rng(5))
    R = world.rotation.as_matrix()
    moved = replace(pairs, p=world.apply(pairs.p), M=R @ pairs.M)
    before, after = fitted(pairs, UNKNOWN), fitted(moved, UNKNOWN)
    base, tool = before.frames.transforms()
    assert np.abs(frame_errors(after.frames, world * base, tool)).max() < 1e-9
    turn = np.kron(np.diag([1.0, 1.0, 0.0, 0.0]), R) + np.kron(np.diag([0, 0, 1.0, 1.0]), np.eye(3))
    np.testing.assert_allclose(turn @ before.information @ turn.T, after.information, rtol=1e-5,
                               atol=1e-5 * np.abs(after.information).max())  # fmt: skip
    assert after.chi2 == pytest.approx(before.chi2, rel=1e-6)


@settings(max_examples=4, deadline=None)
@given(base=motions, tool=motions)
def test_with_the_roles_of_base_and_tool_swapped_the_answer_is_the_inverse(
    base: RigidTransform, tool: RigidTransform
) -> None:
    pairs = pairs_at(base, tool)
    R, M = np.swapaxes(pairs.R, 1, 2), np.swapaxes(pairs.M, 1, 2)
    swapped = replace(
        pairs,
        R=R,
        t=-np.einsum("nij,nj->ni", R, pairs.t),
        M=M,
        p=-np.einsum("nij,nj->ni", M, pairs.p),
    )
    found = search(swapped, 3).frames.at(0)
    assert np.abs(frame_errors(found, tool.inv(), base.inv())).max() < 1e-9


def test_a_search_ends_at_most_rows_where_others_are_wrong() -> None:
    pairs = noisy(pairs_at(BASE, TOOL, 15), np.random.default_rng(6))
    p, M = pairs.p.copy(), pairs.M.copy()
    p[[1, 4, 5, 9, 12]] += 0.3
    M[[1, 4, 9]] = M[[4, 9, 1]]
    found = search(replace(pairs, p=p, M=M), 3).frames.at(0)
    assert np.abs(frame_errors(found, BASE, TOOL)).max() < 1e-3


@pytest.mark.parametrize("name", ["hexapod", "3-rps", "3-rpr"])
def test_errors_of_readings_move_the_tool_as_the_machine_does(name: str) -> None:
    machine, drawn = shipped(name), workspace_poses(name, 3)
    matrices = np.array([T.as_matrix() for T in drawn.poses])
    n = len(matrices)
    pairs = PosePairs(matrices[:, :3, :3], matrices[:, :3, 3], np.tile(np.eye(3), (n, 1, 1)),
                      np.zeros((n, 3)), np.ones(n, dtype=np.bool_), 0.1)  # fmt: skip
    h, frames = 1e-6, frames_of(BASE, TOOL)
    found = motions_by_readings(machine, drawn.poses, h).of_tool(frames, pairs)
    covariance = found @ np.swapaxes(found, 1, 2)
    for i, T in enumerate(drawn.poses):
        columns = []
        for j in machine.motors:
            q = drawn.readings[i].copy()
            q[j] += h
            M = BASE * forward_kinematics(machine, q, start=T) * TOOL
            true = BASE * T * TOOL
            turn = (M.rotation * true.rotation.inv()).as_rotvec()
            columns.append(np.concatenate([M.translation - true.translation, turn]))
        direct = np.array(columns).T
        np.testing.assert_allclose(
            covariance[i], direct @ direct.T, atol=1e-3 * np.abs(covariance[i]).max()
        )


def normalised_squares(
    noise: tuple[Array, tuple[bool, bool]], motions: PlatformMotions | None, runs: int
) -> tuple[float, Array]:
    """Return the mean of normalised squared errors, and of the factors that were found."""
    truth = frames_of(BASE, TOOL)
    exact = pairs_at(BASE, TOOL, 12)
    nse, factors = [], []
    for seed in range(runs):
        chance = np.random.default_rng(seed)
        pairs = noisy(exact, chance)
        if motions is not None:
            moved = motions.of_tool(truth, exact) @ chance.normal(size=motions.turn.shape[2])
            pairs = replace(
                pairs, p=pairs.p + moved[:, :3], M=rotation_matrices(moved[:, 3:]) @ pairs.M
            )
        found = fit(pairs, truth.moved(1e-3 * chance.normal(size=12)), of(noise, 12), motions)
        error = frame_errors(found.frames, BASE, TOOL) / pairs.scale
        nse.append(error @ found.information @ error / 12.0)
        factors.append(found.noise.factor)
    return float(np.mean(nse)), np.mean(factors, axis=0)


def test_errors_are_as_large_as_the_covariance_says() -> None:
    nse, _ = normalised_squares(STATED, None, 40)
    assert 0.85 < nse < 1.15  # 40 x 12: one sigma is 0.065


def test_unknown_scatter_is_found_without_bias() -> None:
    nse, factor = normalised_squares(UNKNOWN, None, 30)
    np.testing.assert_allclose(factor, STATED[0], rtol=0.06)
    assert 0.85 < nse < 1.3  # some 30 degrees of freedom a kind: 1.07 is expected


def test_errors_of_the_model_are_in_the_covariance() -> None:
    chance = np.random.default_rng(8)
    motions = PlatformMotions(
        1e-3 * chance.normal(size=(12, 3, 5)), 2e-4 * chance.normal(size=(12, 3, 5))
    )
    nse, _ = normalised_squares(STATED, motions, 40)
    assert 0.85 < nse < 1.15
    without = fit(pairs_at(BASE, TOOL, 12), frames_of(BASE, TOOL), of(STATED, 12))
    beside = fit(pairs_at(BASE, TOOL, 12), frames_of(BASE, TOOL), of(STATED, 12), motions)
    assert np.all(np.linalg.eigvalsh(without.information - beside.information) > -1e-6)


def test_residuals_are_zero_where_orientation_was_not_measured() -> None:
    pairs = noisy(pairs_at(BASE, TOOL), np.random.default_rng(9))
    some = replace(pairs, oriented=np.arange(len(pairs)) < 3)
    r = residuals(frames_of(BASE, TOOL), some)
    assert np.all(r[3:, 3:] == 0.0)
    assert np.all(np.any(r[:3, 3:] != 0.0, axis=1))


def test_frames_come_back_from_their_transforms() -> None:
    frames = frames_of(BASE, TOOL)
    again = frames_of(*frames.transforms())
    assert isinstance(again, Frames)
    np.testing.assert_allclose(again.R_tool, frames.R_tool, atol=1e-15)
