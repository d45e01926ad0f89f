"""How camera poses agree with what pictures show, and what the model says of the legs in them."""

from dataclasses import replace

import leg_pictures as lp
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array
from legcal.machine import Cylinder
from legcal.perception.pair_matching import (
    PairMatches,
    Picture,
    Poses,
    _equations,
    _moved,
    distances,
    gauss_newton_step,
    leg_segments,
    match_pairs,
)

TIGHT = 2e-3


def _pose(T_base_camera: RigidTransform, n_legs: int, n: int = 1) -> Poses:
    T = T_base_camera.inv()
    R, t = np.tile(T.rotation.as_matrix(), (n, 1, 1)), np.tile(T.translation, (n, 1))
    return Poses.rigid(R, t, n_legs)


def _scene(seed: int, **difficulty: float) -> tuple[list[Picture], RigidTransform]:
    rng = np.random.default_rng(seed)
    T = lp.camera(rng)
    platforms = [lp.platform(rng) for _ in range(3)]
    return lp.pictures(lp.machine(6, rng), T, platforms, rng, **difficulty), T  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", range(3))
def test_the_true_pose_agrees_with_what_is_seen_and_others_do_not(seed: int) -> None:
    pictures, T = _scene(seed)
    true = _pose(T, 6)
    found = [match_pairs(picture, true, TIGHT) for picture in pictures]
    value = np.concatenate([f.score[0][f.visible[0] > 0.9] for f in found])
    assert np.median(value) > 0.9
    assert np.mean(value > 0.5) > 0.8  # bars of legs that cross in the picture may be pairs of both
    away = replace(true, t=true.t + np.array([0.05, 0.0, 0.0]))
    assert all(match_pairs(p, away, TIGHT).score.mean() < 0.2 for p in pictures)


def test_poses_are_judged_one_by_one_however_many_there_are() -> None:
    (picture, *_), T = _scene(0)
    poses = _pose(T, 6, 300)
    poses = replace(poses, t=poses.t + np.linspace(0.0, 0.1, 300)[:, None] * [1.0, 0.0, 0.0])
    together = match_pairs(picture, poses, 0.01)
    for i in (0, 127, 128, 299):
        alone = match_pairs(picture, poses.take(np.array([i])), 0.01)
        np.testing.assert_allclose(alone.score[0], together.score[i], atol=1e-6)
        np.testing.assert_array_equal(alone.visible[0], together.visible[i])


def test_it_does_not_matter_in_which_frame_the_machine_is_described() -> None:
    (picture, *_), T = _scene(1)
    G = RigidTransform.from_components([0.3, -0.2, 0.5], Rotation.from_rotvec([0.4, 1.0, -0.3]))
    ends = G.apply(picture.targets.ends.reshape(-1, 3)).reshape(-1, 2, 3)
    moved = replace(picture, targets=replace(picture.targets, ends=ends))
    one, two = match_pairs(picture, _pose(T, 6), 0.01), match_pairs(moved, _pose(G * T, 6), 0.01)
    np.testing.assert_allclose(one.score, two.score, atol=1e-4)


def test_pictures_of_cameras_that_are_fixed_to_each_other_are_judged_in_one_frame() -> None:
    (picture, *_), T = _scene(2)
    C = RigidTransform.from_components([0.1, 0.2, -0.1], Rotation.from_rotvec([0.2, -0.5, 0.3]))
    joined = replace(picture, R=C.rotation.as_matrix(), t=C.translation)
    one, two = match_pairs(picture, _pose(T, 6), 0.01), match_pairs(joined, _pose(T * C, 6), 0.01)
    np.testing.assert_allclose(one.score, two.score, atol=1e-4)


def test_a_picture_without_bars_or_legs_agrees_with_nothing() -> None:
    (picture, *_), T = _scene(0)
    empty = replace(picture, pairs=picture.pairs.take(np.zeros(0, dtype=np.intp)))
    found = match_pairs(empty, _pose(T, 6), 0.01)
    assert not found.score.any()
    assert found.visible.any()
    still = gauss_newton_step([empty], _pose(T, 6), [found], 0.01, 0.006)
    np.testing.assert_allclose(still.t, _pose(T, 6).t)


def test_legs_behind_the_camera_or_beside_the_picture_are_not_expected() -> None:
    (picture, *_), T = _scene(0)
    behind = T * RigidTransform.from_rotation(Rotation.from_euler("y", np.pi))
    assert not match_pairs(picture, _pose(behind, 6), 0.01).visible.any()
    aside = T * RigidTransform.from_rotation(Rotation.from_euler("y", 1.2))
    assert not match_pairs(picture, _pose(aside, 6), 0.01).visible.any()


def _shifted(poses: Poses, rng: np.random.Generator) -> Poses:
    return replace(poses, shift=rng.uniform(-5e-3, 5e-3, poses.shift.shape))


def _residual(picture: Picture, poses: Poses, found: PairMatches) -> Array:
    return np.asarray(_equations(picture, poses, found, 0.01)[2][0])


@pytest.mark.parametrize("joined", [False, True])
def test_derivatives_are_those_by_differences(joined: bool) -> None:
    (picture, *_), T = _scene(3)
    C = RigidTransform.identity()
    if joined:
        C = RigidTransform.from_components([0.1, 0.2, -0.1], Rotation.from_rotvec([0.2, 0.5, 0.3]))
        picture = replace(picture, R=C.rotation.as_matrix(), t=C.translation)
    poses = _shifted(_pose(T * C, 6), np.random.default_rng(0))
    found = match_pairs(picture, poses, 0.02)
    matched = found.score[0] > 0.3
    assert matched.sum() > 5
    J, J_leg, _, weight = _equations(picture, poses, found, 0.01)
    assert np.all(weight[0, matched] > 0.0)
    # Held while a piece moves are its place along the bar, which matters by the product of two
    # small residuals, and how obliquely its plane is seen, which matters for the width a little.
    step, centre = 1e-6, np.full((1, 3), 1e3)
    for k in range(6):
        xi = step * np.eye(6)[k][None]
        ahead, back = (
            _residual(picture, _moved(poses, sign * xi, poses.shift, centre), found)
            for sign in (1.0, -1.0)
        )
        change = ((ahead - back) / (2.0 * step))[matched]
        scale = np.abs(J[0, matched]).max()
        error = np.abs(change - J[0, matched, :, k])
        assert error[:, :2].max() < 0.03 * scale
        assert error[:, 2].max() < 0.6
        assert error[:, 3].max() < 1e-4 * scale
    for end in range(2):
        for axis in range(3):
            shift = poses.shift.copy()
            shift[0, :, end, axis] += step
            ahead = _residual(picture, replace(poses, shift=shift), found)
            change = ((ahead - _residual(picture, poses, found)) / step)[matched]
            mine = J_leg[0, matched, :2, 3 * end + axis]
            assert np.abs(change[:, :2] - mine).max() < 0.05 * np.abs(J_leg[0, matched]).max()
    assert not J_leg[0, :, 2:].any()  # neither width nor place tells where joints are


@pytest.mark.parametrize("seed", range(4))
def test_steps_lead_back_to_the_true_pose(seed: int) -> None:
    pictures, T = _scene(seed, noise=0.3)
    rng = np.random.default_rng(seed)
    off = RigidTransform.from_components(
        rng.uniform(-0.01, 0.01, 3), Rotation.from_rotvec(rng.uniform(-0.02, 0.02, 3))
    )
    poses = _pose(T * off, 6)
    before = lp.apart(T, T * off)
    for tolerance in (0.03, 0.02, 0.01, 0.006, 0.004):
        found = [match_pairs(picture, poses, tolerance) for picture in pictures]
        poses = gauss_newton_step(pictures, poses, found, tolerance)
    R = Rotation.from_matrix(poses.R[0])
    after = lp.apart(T, RigidTransform.from_components(poses.t[0], R).inv())
    assert after[0] < 0.025
    assert after[1] < 0.01 < before[1]
    np.testing.assert_allclose(poses.R[0] @ poses.R[0].T, np.eye(3), atol=1e-12)


def test_joints_that_are_elsewhere_are_found_in_the_picture() -> None:
    rng = np.random.default_rng(5)
    made, T, where = lp.machine(6, rng), lp.camera(rng), lp.platform(rng)
    A = made.A.copy()
    x = T.rotation.apply([1.0, 0.0, 0.0])
    A[2] = A[2] + 8e-3 * x
    picture = lp.picture((made.A, made.posed(where)), (A, made.posed(where)), T, rng)
    poses = _pose(T, 6)
    for tolerance in (0.02, 0.01, 0.005, 0.003):
        found = match_pairs(picture, poses, tolerance)
        poses = gauss_newton_step([picture], poses, [found], tolerance, 0.02)
    u = made.posed(where)[2] - A[2]
    sideways = np.cross(u / np.linalg.norm(u), T.rotation.apply([0.0, 0.0, 1.0]))
    sideways /= np.linalg.norm(sideways)
    moved = poses.shift[0, :, 0] @ sideways
    assert abs(moved[2]) > 0.5 * abs(8e-3 * x @ sideways)
    assert np.abs(np.delete(poses.shift[0], 2, axis=0)).max() < 3e-3


def test_distances_are_those_of_legs_beside_their_bars() -> None:
    (picture, *_), T = _scene(0)
    away = T * RigidTransform.from_translation([5e-3, 0.0, 0.0])
    found = match_pairs(picture, _pose(T, 6), TIGHT)
    sure = found.score[0] > 0.9
    assert np.median(distances(picture, _pose(T, 6), found)[0, sure]) < 2e-4
    off = distances(picture, _pose(away, 6), found)[0, sure]
    assert np.all(off < 6e-3)
    assert off.max() > 2e-3


def test_pieces_lie_on_their_legs_and_make_up_all_that_is_seen_of_them() -> None:
    rng = np.random.default_rng(0)
    made = lp.machine(6, rng)
    A, B = made.A, made.posed(lp.platform(rng))
    targets = lp.pieces(A, B)
    assert len(targets) == 12
    for leg in range(6):
        own = np.flatnonzero(targets.leg == leg)
        assert abs(targets.share[own].sum() - 1.0) < 1e-12
        u = (B[leg] - A[leg]) / np.linalg.norm(B[leg] - A[leg])
        for k in own:
            assert np.linalg.norm(np.cross(targets.ends[k] - A[leg], u)) < 1e-12
            at = A[leg] + targets.place[k][:, None] * (B[leg] - A[leg])
            np.testing.assert_allclose(targets.ends[k], at, atol=1e-12)
            assert 0.0 < targets.place[k, 0] < targets.place[k, 1] < 1.0
        assert set(targets.radius[own]) == {lp.TUBE, lp.ROD}


def test_legs_that_are_not_wanted_or_show_nothing_have_no_pieces() -> None:
    made = lp.machine(3)
    B = made.posed(lp.platform())
    cylinders: list[tuple[Cylinder, ...]] = [lp.CYLINDERS, (), lp.CYLINDERS]
    assert set(leg_segments(made.A, B, cylinders, np.arange(3)).leg) == {0, 2}
    assert set(leg_segments(made.A, B, cylinders, np.array([2])).leg) == {2}
    assert len(leg_segments(made.A, B, cylinders, np.array([1]))) == 0
