"""Camera poses that two bars and two legs suggest."""

from dataclasses import replace

import leg_pictures as lp
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array
from legcal.perception.pair_matching import Poses, match_pairs
from legcal.perception.pose_hypotheses import MAX_POSES, pose_hypotheses


def _turns(poses: Poses, T: RigidTransform) -> tuple[Array, Array]:
    """Return how far poses are from a true one: angles [rad], parts of the distance."""
    true = T.inv()
    trace = np.einsum("kij,ij->k", poses.R, true.rotation.as_matrix())
    middle = np.array([0.0, 0.0, 0.2])
    there = true.apply(middle)
    away = np.linalg.norm(poses.R @ middle + poses.t - there, axis=1) / np.linalg.norm(there)
    return np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0)), away


def test_one_of_the_starts_is_near_the_camera() -> None:
    near = []
    for seed in range(18):
        rng = np.random.default_rng(seed)
        made, T, where = lp.machine(3 + seed % 4, rng), lp.camera(rng), lp.platform(rng)
        joints = made.A, made.posed(where)
        picture = lp.picture(joints, joints, T, rng, missing=0.2, n_clutter=6, noise=0.4)
        poses = pose_hypotheses(picture, made.n_legs)
        assert len(poses) <= MAX_POSES
        assert not poses.shift.any()
        angle, away = _turns(poses, T)
        near.append(len(poses) > 0 and np.min(angle / np.deg2rad(16.0) + away / 0.16) < 1.0)
    assert np.mean(near) >= 0.88


def test_starts_are_rotations_that_put_the_legs_before_the_camera() -> None:
    rng = np.random.default_rng(3)
    made, T, where = lp.machine(6, rng), lp.camera(rng), lp.platform(rng)
    joints = made.A, made.posed(where)
    poses = pose_hypotheses(lp.picture(joints, joints, T, rng, n_clutter=4), 6)
    assert len(poses) > 50
    np.testing.assert_allclose(
        poses.R @ poses.R.swapaxes(1, 2), np.broadcast_to(np.eye(3), poses.R.shape), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(poses.R), 1.0, atol=1e-9)
    picture = lp.picture(joints, joints, T, rng)
    seen = match_pairs(picture, poses, 0.05).score
    assert np.mean((seen > 0.1).sum(axis=1) >= 2) > 0.5  # the two legs, mostly


def test_starts_move_with_the_frame_of_the_machine() -> None:
    rng = np.random.default_rng(4)
    made, T, where = lp.machine(5, rng), lp.camera(rng), lp.platform(rng)
    joints = made.A, made.posed(where)
    picture = lp.picture(joints, joints, T, rng)
    G = RigidTransform.from_components([0.3, -0.2, 0.5], Rotation.from_rotvec([0.4, 1.0, -0.3]))
    ends = G.apply(picture.targets.ends.reshape(-1, 3)).reshape(-1, 2, 3)
    moved = replace(picture, targets=replace(picture.targets, ends=ends))
    one, two = pose_hypotheses(picture, 5), pose_hypotheses(moved, 5)
    back = two.R @ G.rotation.as_matrix()
    score = [match_pairs(p, s, 0.05).score.sum(axis=1) for p, s in ((picture, one), (moved, two))]
    assert abs(len(one) - len(two)) <= 0.02 * len(one)
    assert abs(max(score[0]) - max(score[1])) < 0.05
    trace = np.einsum("kij,lij->kl", one.R[:200], back)
    assert np.mean(trace.max(axis=1) > 3.0 - 1e-3) > 0.9


def test_one_bar_or_one_leg_suggest_nothing() -> None:
    rng = np.random.default_rng(0)
    made, T, where = lp.machine(6, rng), lp.camera(rng), lp.platform(rng)
    joints = made.A, made.posed(where)
    picture = lp.picture(joints, joints, T, rng)
    one_bar = replace(picture, pairs=picture.pairs.take(np.array([0])))
    assert len(pose_hypotheses(one_bar, 6)) == 0
    one_leg = replace(picture, targets=lp.pieces(joints[0][:1], joints[1][:1]))
    assert len(pose_hypotheses(one_leg, 6)) == 0


def test_sets_of_poses_are_put_together() -> None:
    rng = np.random.default_rng(1)
    R = Rotation.random(5, rng=rng).as_matrix()
    poses = Poses.rigid(R, rng.normal(size=(5, 3)), 4)
    both = Poses.joined([poses.take(np.array([0, 1])), poses.take(np.array([4]))])
    np.testing.assert_array_equal(both.R, R[[0, 1, 4]])
    assert both.shift.shape == (3, 4, 2, 3)
