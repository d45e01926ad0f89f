"""Rigid motions, rotations, frames on joint centres, and oriented lines (eq 1)."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.files.motions import motion_from_xyz_quat, motion_to_xyz_quat
from legcal.geometry.lines import distance_to_line, moment, nearest_point_to_origin, normal_basis
from legcal.geometry.motions import (
    frame_on_points,
    motion_of,
    nearest_rotation,
    product,
    roll_pitch_yaw,
)
from legcal.geometry.types import Array

FAST = settings(deadline=None, max_examples=25)
SEEDS = st.integers(0, 2**32 - 1)
Z = np.array([0.0, 0.0, 1.0])


def motion(seed: int) -> RigidTransform:
    rng = np.random.default_rng(seed)
    return RigidTransform.from_components(rng.normal(size=3), Rotation.random(rng=rng))


def points(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    triangle = np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0], [0.1, 0.3, 0.0]])
    return triangle + rng.normal(scale=0.03, size=(3, 3))


def directions(seed: int, n: int) -> Array:
    u = np.random.default_rng(seed).normal(size=(n, 3))
    return np.asarray(u / np.linalg.norm(u, axis=1, keepdims=True))


@FAST
@given(SEEDS)
def test_motions_are_composed_and_rounded_as_scipy_does(seed: int) -> None:
    one, two, three = motion(seed), motion(seed + 1), motion(seed + 2)
    expected = (one * two * three).as_matrix()
    np.testing.assert_allclose(product(one, two, three).as_matrix(), expected, atol=1e-14)
    R = one.rotation.as_matrix() + 1e-9 * np.random.default_rng(seed).normal(size=(3, 3))
    found = motion_of(R, one.translation).as_matrix()
    np.testing.assert_allclose(found[:3, :3].T @ found[:3, :3], np.eye(3), atol=1e-15)
    exact = RigidTransform.from_components(one.translation, Rotation.from_matrix(R))
    np.testing.assert_allclose(found, exact.as_matrix(), atol=1e-15)
    np.testing.assert_allclose(nearest_rotation(R), found[:3, :3], atol=1e-14)


@FAST
@given(SEEDS)
def test_a_motion_is_read_as_it_was_written(seed: int) -> None:
    T = motion(seed)
    written = motion_to_xyz_quat(T)
    assert written["quat_xyzw"][3] >= 0.0
    again = motion_from_xyz_quat(written["xyz"], written["quat_xyzw"])
    np.testing.assert_allclose(again.as_matrix(), T.as_matrix(), atol=1e-14)


def test_a_written_quaternion_has_its_scalar_last() -> None:
    quarter_turn = motion_from_xyz_quat([0, 0, 0], [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    np.testing.assert_allclose(quarter_turn.apply([1.0, 0.0, 0.0]), [0.0, 1.0, 0.0], atol=1e-15)


@FAST
@given(SEEDS, st.sampled_from([0.0, np.pi / 2, -np.pi / 2, 1.0, -0.4]))
def test_roll_pitch_and_yaw_turn_about_fixed_axes_at_any_pitch(seed: int, pitch: float) -> None:
    roll, yaw = np.random.default_rng(seed).uniform(-np.pi, np.pi, 2)
    R = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
    again = Rotation.from_euler("xyz", roll_pitch_yaw(R)).as_matrix()
    np.testing.assert_allclose(again, R, atol=2e-15)


@FAST
@given(SEEDS, st.floats(1e-3, 1e3))
def test_a_frame_stands_on_its_points_and_moves_with_them(seed: int, scale: float) -> None:
    T, P = motion(seed), points(seed)
    frame = frame_on_points(P)
    first, second, third = frame.inv().apply(P)
    np.testing.assert_allclose([*first, *second[1:], third[2]], 0.0, atol=1e-12)
    assert second[0] > 0.0  # x axis towards the second point
    assert third[1] > 0.0
    moved = frame_on_points(T.apply(P))
    np.testing.assert_allclose(moved.as_matrix(), (T * frame).as_matrix(), atol=1e-12)
    scaled, axes = frame_on_points(scale * P).rotation, frame.rotation
    np.testing.assert_allclose(scaled.as_matrix(), axes.as_matrix(), atol=1e-9)


@FAST
@given(SEEDS)
def test_two_points_and_a_normal_make_a_frame_whatever_their_heights(seed: int) -> None:
    T, P = motion(seed), points(seed)[:2]
    frame = frame_on_points(P)
    np.testing.assert_allclose(frame.rotation.apply(Z), Z, atol=1e-12)
    first, second = frame.inv().apply(P)
    np.testing.assert_allclose(first, 0.0, atol=1e-12)
    across = np.hypot(*(P[1] - P[0])[:2])
    np.testing.assert_allclose(second, [across, 0.0, P[1, 2] - P[0, 2]], atol=1e-12)
    moved = frame_on_points(T.apply(P), T.rotation.apply(Z))
    np.testing.assert_allclose(moved.as_matrix(), (T * frame).as_matrix(), atol=1e-12)


def test_eq01_the_moment_has_the_sign_of_the_paper() -> None:
    x, y = np.eye(3)[:2]
    np.testing.assert_array_equal(moment(x, 2.0 * y), 2.0 * Z)


@FAST
@given(SEEDS)
def test_eq01_the_moment_belongs_to_the_line_and_its_norm_is_the_distance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    u, M, s = directions(seed, 6), rng.normal(size=(6, 3)), rng.normal(size=(6, 1))
    np.testing.assert_allclose(moment(u, M + s * u), moment(u, M), atol=1e-12)
    np.testing.assert_array_equal(moment(-u, M), -moment(u, M))
    foot = nearest_point_to_origin(u, M)
    sizes = np.linalg.norm(foot, axis=1)
    np.testing.assert_allclose(np.linalg.norm(moment(u, M), axis=1), sizes, atol=1e-12)
    np.testing.assert_allclose(np.sum(foot * u, axis=1), 0.0, atol=1e-12)
    np.testing.assert_allclose(distance_to_line(foot, u, M), 0.0, atol=1e-12)


@FAST
@given(SEEDS)
def test_a_normal_basis_is_right_handed_orthonormal_and_that_of_each_direction(seed: int) -> None:
    u = directions(seed, 4)
    basis = normal_basis(u)
    axes = np.concatenate([basis, u[:, None]], axis=1)
    np.testing.assert_allclose(axes @ axes.swapaxes(1, 2), np.eye(3) + 0.0 * axes, atol=1e-12)
    np.testing.assert_allclose(np.cross(basis[:, 0], basis[:, 1]), u, atol=1e-12)
    np.testing.assert_array_equal(basis[2], normal_basis(u[2]))
