"""The camera pose on which pictures of a view agree, from edges of known legs."""

from dataclasses import replace

import leg_pictures as lp
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.perception.camera_search import (
    Candidates,
    _reversed,
    is_mirrored,
    may_be_mirrored,
    mirrored,
    place_camera,
    place_near,
)
from legcal.perception.pair_matching import Picture, Poses

HARD = {"missing": 0.2, "n_clutter": 8, "noise": 0.4}


def _pictures(
    seed: int, n_legs: int, n: int, *, joint_error: float = 2e-3, **difficulty: float
) -> tuple[list[Picture], RigidTransform]:
    rng = np.random.default_rng(seed)
    T, made = lp.camera(rng), lp.machine(n_legs, rng)
    platforms = [lp.platform(rng) for _ in range(n)]
    return lp.pictures(made, T, platforms, rng, joint_error=joint_error, **difficulty), T  # type: ignore[arg-type]


def _is_right(placed: Candidates, T: RigidTransform) -> bool:
    away, angle = lp.apart(T, placed.pose())
    return angle < np.deg2rad(5.0) and away < 0.1


@pytest.mark.parametrize(("n_legs", "error"), [(3, 2e-3), (4, 2e-3), (6, 10e-3)])
def test_cameras_are_placed_among_clutter_and_missing_legs(n_legs: int, error: float) -> None:
    """Errors of the nominal model [m] hardly matter."""
    pictures, T = _pictures(8, n_legs, 5, joint_error=error, **HARD)
    placed = place_camera(pictures, n_legs)
    assert placed.is_convincing
    away, angle = lp.apart(T, placed.pose())
    assert angle < np.deg2rad(6.0)
    assert away < 0.15
    assert placed.support.shape == placed.expected.shape == (len(placed.poses), 5)
    assert np.all(np.diff(placed.score) <= 0.0)


@pytest.mark.slow
def test_no_wrong_pose_is_convincing() -> None:
    right = []
    for seed in range(60):
        n_legs, n = 3 + seed % 4, 1 + seed % 5
        coarse = 10e-3 if seed % 7 == 0 else 2e-3
        pictures, T = _pictures(100 + seed, n_legs, n, joint_error=coarse, **HARD)
        placed = place_camera(pictures, n_legs)
        right.append(placed.is_convincing)
        if placed.is_convincing:
            assert _is_right(placed, T), seed
    assert np.mean(right) > 0.75


def test_views_that_know_how_they_stand_to_each_other_are_placed_together() -> None:
    rng = np.random.default_rng(5)
    made, joined = lp.machine(6, rng), []
    T_base_board = RigidTransform.from_components(
        [0.3, 0.4, 0.0], Rotation.from_rotvec([3.0, 0.2, 0.1])
    )
    for _ in range(4):  # one image each
        T = lp.camera(rng)
        [picture] = lp.pictures(made, T, [lp.platform(rng)], rng, joint_error=2e-3, noise=0.4)
        T_camera_board = T.inv() * T_base_board
        joined.append(
            replace(picture, R=T_camera_board.rotation.as_matrix(), t=T_camera_board.translation)
        )
    placed = place_camera(joined, 6)
    assert placed.is_convincing
    assert _is_right(placed, T_base_board)


def test_a_symmetric_machine_at_a_symmetric_reading_is_ambiguous_and_others_resolve_it() -> None:
    rng = np.random.default_rng(2)
    T, made = lp.camera(rng), lp.machine(3)
    home = lp.pictures(made, T, [lp.platform()] * 3, rng)
    placed = place_camera(home, 3)
    assert placed.is_enough
    assert not placed.is_convincing
    other = placed.pose(1).inv() * placed.pose(0)
    assert other.rotation.magnitude() == pytest.approx(2.0 * np.pi / 3.0, abs=0.05)
    more = lp.pictures(made, T, [lp.platform(rng) for _ in range(3)], rng)
    resolved = place_camera([*home, *more], 3)
    assert resolved.is_convincing
    assert _is_right(resolved, T)


def test_a_rough_pose_is_improved() -> None:
    pictures, T = _pictures(4, 6, 4, **HARD)
    off = RigidTransform.from_components(
        [0.02, -0.02, 0.03], Rotation.from_rotvec([0.03, -0.02, 0])
    )
    placed = place_near(pictures, T * off, 6)
    assert np.all(placed.leg_error[np.isfinite(placed.leg_error)] < 6e-3)  # from its edge pairs
    assert placed.hinted
    assert placed.is_convincing
    assert _is_right(placed, T)
    assert lp.apart(T, placed.pose())[1] < 0.5 * lp.apart(T, T * off)[1]


def test_a_rough_pose_of_another_place_is_not_believed() -> None:
    pictures, T = _pictures(4, 6, 4, **HARD)
    other = RigidTransform.from_rotation(Rotation.from_euler("z", 1.9)) * T
    placed = place_near(pictures, other, 6)
    assert not placed.is_clear


def test_pictures_of_nothing_give_no_pose() -> None:
    rng = np.random.default_rng(0)
    made, where = lp.machine(6, rng), lp.platform(rng)
    joints = made.A, made.posed(where)
    empty = lp.picture(joints, joints, lp.camera(rng), rng, missing=1.1)
    placed = place_camera([empty, empty], 6)
    assert len(placed.poses) == 0
    assert not any((placed.is_enough, placed.is_clear, placed.is_convincing))
    wild = lp.picture(joints, joints, lp.camera(rng), rng, missing=1.1, n_clutter=12)
    assert not place_camera([wild] * 2, 6).is_convincing


@pytest.mark.parametrize("missing", [pytest.param(0.2, marks=pytest.mark.slow), 0.45])
def test_mirrored_pictures_of_a_machine_without_symmetry_are_told_from_its_own(
    missing: float,
) -> None:
    pictures, _ = _pictures(20, 6, 4, **{**HARD, "missing": missing})
    own, other = place_camera(pictures, 6), place_camera(mirrored(pictures), 6)
    assert own.is_convincing
    assert may_be_mirrored(other)
    assert is_mirrored(other, own) or not other.is_convincing
    assert not is_mirrored(own, other)


def test_mirrored_pictures_of_a_planar_machine_are_believed() -> None:
    rng = np.random.default_rng(3)
    spatial, T = lp.machine(4, rng), lp.camera(rng)
    flat = np.array([1.0, 1.0, 0.0])
    made = lp.MachineSpec(flat * spatial.A, flat * spatial.B)
    steps = [
        RigidTransform.from_components([*rng.uniform(-0.05, 0.05, 2), 0.0], Rotation.identity())
        for _ in range(4)
    ]
    pictures = lp.pictures(made, T, steps, rng)
    own, other = place_camera(pictures, 4), place_camera(mirrored(pictures), 4)
    assert own.is_enough
    assert other.is_enough
    assert not is_mirrored(own, other)
    assert not is_mirrored(other, own)


def test_a_flat_machine_is_seen_alike_with_near_and_far_exchanged() -> None:
    rng = np.random.default_rng(4)
    joints = np.append(rng.uniform(-0.2, 0.2, (8, 2)), np.zeros((8, 1)), axis=1)
    targets = lp.pieces(joints[:4], joints[4:])
    nothing = lp.picture((joints[:4], joints[4:]), (joints[:4], joints[4:]), lp.camera(rng), rng)
    R = Rotation.random(5, rng=rng).as_matrix()
    middle = targets.ends.reshape(-1, 3).mean(axis=0)
    far = np.array([0.3, -0.2, 200.0])
    poses = Poses.rigid(R, far - R @ middle, 4)
    other = _reversed([nothing], poses)
    assert np.allclose(np.linalg.det(other.R), 1.0)
    for pose in range(5):
        here, there = (p.R[pose] @ targets.ends[..., None] for p in (poses, other))
        here, there = here[..., 0] + poses.t[pose], there[..., 0] + other.t[pose]
        assert np.abs(here[..., :2] / here[..., 2:] - there[..., :2] / there[..., 2:]).max() < 1e-5
        assert np.abs(here[..., 2] + there[..., 2] - 2.0 * far[2]).max() < 1e-3
    again = _reversed([nothing], other)
    assert np.allclose(again.R, poses.R)
    assert np.allclose(again.t, poses.t)


@pytest.mark.parametrize(("rival", "is_believed"), [(2.0, True), (2.6, False)])
def test_few_legs_are_believed_only_without_a_rival(rival: float, is_believed: bool) -> None:
    poses = Poses.rigid(np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), 6)
    support, expected = np.array([[0.9] * 4, [rival / 4] * 4]), np.full((2, 4), 6.0)
    placed = Candidates(poses, support, expected, support.sum(axis=1), np.zeros(6))
    assert 0.12 < placed.share < 0.2
    assert placed.is_convincing == is_believed
    assert not placed.is_clear


def test_a_single_image_of_three_legs_suffices_near_a_rough_pose() -> None:
    pictures, T = _pictures(11, 3, 1)
    assert not place_camera(pictures, 3).is_clear
    near = place_near(pictures, T, 3)
    assert near.is_convincing
    assert _is_right(near, T)
